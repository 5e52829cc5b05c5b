"""What `calibrate`, `refine` and `locate` share: from a start to the minimum, and from there to a `Calibration`."""

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffproj.calibration.adequacy import remarks
from diffproj.calibration.constraints import free_basis, held_at, make_prior
from diffproj.calibration.covariance import Covariance, reshaped
from diffproj.calibration.data import Data
from diffproj.calibration.fit import Fit, fit
from diffproj.calibration.options import Options
from diffproj.calibration.parametrisation import Parametrisation
from diffproj.calibration.result import Calibration, CalibrationError
from diffproj.calibration.solver import Prior, Status
from diffproj.calibration.verdict import verdicts
from diffproj.geometry.camera import Camera
from diffproj.lens.models import LensModel


def minimised(
    data: Data,
    options: Options,
    model: LensModel,
    shared: Tensor,
    local: tuple[Tensor, ...],
    reference: Tensor,
) -> tuple[Fit, Prior | None]:
    """Where the solver ends from that start, and the prior with its graph.

    `reference (P, s)` is what fixed parameters keep and priors without a mean are about; NaN where nothing is known.
    """
    parameters = Parametrisation(model, options.bow)
    steps = {name: getattr(options, name) for name in ("max_iterations", "tolerance", "progress")}
    prior = make_prior(options.priors, reference, parameters, data.batch)
    shared = held_at(reference, shared, parameters, options.fixed)
    task = data.task(
        model,
        bow=options.bow,
        loss=options.loss,
        prior=None if prior is None else Prior(prior.mean.detach(), prior.precision.detach()),
        basis=free_basis(shared, parameters, options.fixed, options.tied_focal),
    )
    if options.objective == "plane":
        # From a rough start a pixel may miss the board; the image objective bears that.
        near = fit(replace(task, loss=None), shared, local, **steps).solution
        shared, local, task = near.shared, near.local, replace(task, objective="plane")  # type: ignore[assignment]
    return fit(task, shared, local, reject=options.outlier_limit, **steps), prior


def outcome(
    who: str,
    data: Data,
    found: Fit,
    size: tuple[int, int] | None,
    throw: bool,
    known: Covariance | None = None,
) -> Calibration:
    """The calibration with the batch shape of the views."""
    task, solution, batch = found.task, found.solution, data.batch
    cameras = task.parameters.unpack(solution.shared, solution.local)
    status, causes = verdicts(found, data.views.names, data.target)

    def shaped(tensor: Tensor) -> Tensor:
        return tensor.reshape((*batch, *tensor.shape[1:]))

    lens = cameras.distortion
    R, t = (shaped(z) for z in solution.local)
    if lens is not None:
        lens = type(lens)(shaped(solution.shared[:, 4 : 4 + lens.coefficients.shape[-1]]))  # type: ignore
    camera = Camera.unchecked(shaped(cameras.K[:, 0]), R[..., 0, :, :], t[..., 0, :], lens, size).without_pose()
    posed = Camera.unchecked(
        camera.K.unsqueeze(-3).expand(*batch, len(data.views), 3, 3),
        R,
        t,
        None if lens is None else lens[..., None].expand(*batch, len(data.views)),
        size,
    )

    calibration = Calibration(
        camera,
        posed,
        data.views.to(torch.float64),
        data.points,
        shaped(task.used),
        shaped(found.rejected),
        shaped(status),
        shaped(solution.iterations),
        shaped(solution.shared[:, -2:]) if task.bow else None,
        task.objective,
        causes,
        shaped(found.pixel_sigma()),
        partial(_covariance, found, tuple(batch), known),
        partial(remarks, found, status),
    )
    if throw and bool((status != Status.CONVERGED).any()):
        raise CalibrationError(f"{who}: {calibration.message}", calibration)
    return calibration


def _covariance(found: Fit, batch: tuple[int, ...], known: Covariance | None) -> Covariance:
    own = reshaped(found.covariance(), batch)
    return own if known is None else own.following(known)
