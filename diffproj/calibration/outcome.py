"""What `calibrate`, `refine` and `locate` share: from a start to the minimum, and from there to a `Calibration`."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.surveyed import in_common
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.eliminated import local_inverse
from diffproj.calibration.least_squares.solver import Prior, Status
from diffproj.calibration.problem.constraints import free_basis, held_at, make_prior, of_camera, of_points
from diffproj.calibration.problem.parametrisation import SKEW, Parametrisation
from diffproj.calibration.results.ambiguity import OtherPoses
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.results.covariance import Covariance, points_turned, reshaped
from diffproj.calibration.results.mismatch import Mismatch
from diffproj.calibration.results.remark import Kind, Remark, Remarks
from diffproj.calibration.results.source import told_of_intrinsics
from diffproj.calibration.trust.adequacy import poses_only
from diffproj.calibration.trust.compatibility import mismatch
from diffproj.calibration.trust.discounted import discounted
from diffproj.calibration.trust.entangled import Entangled
from diffproj.calibration.trust.handedness import upside_down
from diffproj.calibration.trust.noise import Noise, level, noise_of
from diffproj.calibration.trust.other_intrinsics import mismatch_of_a_camera
from diffproj.calibration.trust.other_poses import other_poses
from diffproj.calibration.trust.remarks import remarks
from diffproj.calibration.trust.uncertainty import covariance_of
from diffproj.calibration.trust.verdict import verdicts
from diffproj.geometry.camera import Camera
from diffproj.targets.exif import Told
from diffproj.targets.landmarks import Landmarks
from diffproj.targets.one_camera import against_one_camera, of_another_camera
from diffproj.targets.views import Views

BELOW = (
    "in {} the camera is below the landmarks' plane, where z is smaller, and not upright if z is up: heights over the "
    "plane run along -z then, which is right where z points down; if z is to be up, as with x east and y north, x and "
    "y are exchanged, or one has the wrong sign"
)
"""What is said of views that see landmarks of a level plane from below."""


class Begun(NamedTuple):
    """What is to be minimised, and from where.

    Attributes:
        task: what; of a flat target if points are to be free.
        shared: where the shared parameters start `(P, s)`.
        local: where the poses start.
        prior: that of the task, with its graph.
    """

    task: Task
    shared: Tensor
    local: tuple[Tensor, ...]
    prior: Prior | None

    def minimum(self, options: Options) -> Fit:
        """Where the solver ends."""
        return fit(self.task, self.shared, self.local, reject=options.outlier_limit, **_steps(options))


def begun(
    data: Data,
    options: Options,
    parameters: Parametrisation,
    shared: Tensor,
    local: tuple[Tensor, ...],
    reference: Tensor,
    rows: Tensor | None = None,
) -> Begun:
    """What is to be minimised from that start.

    Skew that is not to be fitted is held. `reference (P, s)` is what fixed parameters keep and priors without a mean
    are about, by the graph that it carries; NaN where nothing is known. With `rows (n,)`, only of these cameras, which
    the start is then of.
    """
    fixed = tuple(name for name in options.fixed if not of_points(name))
    fixed = fixed if options.skew or not parameters.skew else (*fixed, SKEW)
    prior = make_prior(of_camera(options.priors), reference, parameters, data.batch, options.tied_focal)
    model = {"bow": parameters.bow, "skew": parameters.skew, "loss": options.loss}
    task = data.task(parameters.lens, **model, shares=data.shares)
    if rows is not None:
        reference, task = reference[rows], task.part(rows)
        prior = None if prior is None else prior.part(rows)
    shared = held_at(reference.detach(), shared, parameters, fixed)
    task = replace(
        task,
        prior=None if prior is None else Prior(prior.mean.detach(), prior.precision.detach()),
        basis=free_basis(shared, parameters, fixed, options.tied_focal),
    )
    if options.objective == "plane":
        # From a rough start a pixel may miss the board; the image objective bears that.
        near = fit(replace(task, loss=None), shared, local, **_steps(options)).solution
        shared, local, task = near.shared, near.local, replace(task, objective="plane")  # type: ignore[assignment]
    return Begun(task, shared, local, prior)


def _steps(options: Options) -> dict[str, Any]:
    return {name: getattr(options, name) for name in ("max_iterations", "tolerance", "progress")}


def outcome(
    who: str,
    data: Data,
    found: Fit,
    size: tuple[int, int] | None,
    throw: bool,
    known: Calibration | None = None,
) -> Calibration:
    """The calibration with the batch shape of the views.

    Where intrinsics were held, `known` is the calibration that they came from: its covariance, the noise of its corners
    and the region of the image where it knows the lens go along.
    """
    task, solution, batch = found.task, found.solution, data.batch
    few = task.parameters.few
    cameras = task.parameters.unpack(solution.shared, solution.local)
    status, causes = verdicts(found, data.views.names, data.target)
    before = None if known is None else noise_of(known, batch)
    noise = level(found, before)

    def shaped(tensor: Tensor) -> Tensor:
        return tensor.reshape((*batch, *tensor.shape[1:]))

    lens = cameras.distortion
    R, t = map(shaped, data.frame.world_pose(*solution.local))
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

    doubt = Entangled(found, status)
    wrong = discounted(found)
    landmarks = data.target.names if isinstance(data.target, Landmarks) else None
    calibration = Calibration(
        camera,
        posed,
        data.views.to(torch.float64),
        data.given_points if task.free and solution.shared.requires_grad else data.given_points.detach(),
        shaped(task.used),
        shaped(found.rejected),
        shaped(status),
        shaped(solution.iterations),
        shaped(solution.shared[:, few - 2 : few]) if task.bow else None,
        task.objective,
        causes,
        shaped(noise.variance.sqrt()),
        shares=None if task.shares is None else shaped(task.shares),
        skew=task.skew,
        displacements=shaped(data.frame.turned_back(solution.shared[:, few:].unflatten(-1, (-1, 3))))
        if task.free
        else None,
        degrees_of_freedom=shaped(noise.freedom),
        lens_region=None if known is None else known.region,
        rig=None if known is None else known.rig,
        calibrated_on=None if known is None else told_of_intrinsics(known),
        _covariance=partial(_covariance, found, data, before, known, doubt),
        _others=partial(_others, found, data, before),
        _remarks=partial(
            remarks_on,
            found,
            status,
            doubt,
            data,
            [data.views] * len(status),
            () if known is None else told_of_intrinsics(known),
        ),
        landmarks=landmarks,
        uncertain=data.uncertain,
        discounted=None if wrong is None else shaped(wrong),
        _mismatch=_mismatch(found, status, known, tuple(batch)),
    )
    if throw and bool((status != Status.CONVERGED).any()):
        raise CalibrationError(f"{who}: {calibration.message}", calibration)
    return calibration


def remarks_on(
    found: Fit,
    status: Tensor,
    doubt: Entangled,
    data: Data,
    views: Sequence[Views],
    before: Sequence[Told] = (),
) -> tuple[Remarks, ...]:
    """The remarks on each of P cameras, of its own views, and on how it stands to landmarks, if the target is that.

    `before` is what the files of the photographs tell that intrinsics which were held were calibrated on.
    """
    said = remarks(found, status, doubt, [own.names for own in views], [own.size for own in views], data.target)
    used, held = found.task.used.any(-1), poses_only(found.task)
    converged = (status == Status.CONVERGED).tolist()
    apart = [_told_apart(own, used[p], before, held) if converged[p] else () for p, own in enumerate(views)]
    said = tuple((*more, *one) for more, one in zip(apart, said, strict=True))
    if not isinstance(data.target, Landmarks) or found.task.solid:
        return said
    below = upside_down(data.frame, *_state(found)[1]) & found.task.used.any(-1)
    below &= (status == Status.CONVERGED).unsqueeze(-1)
    return tuple(
        (*one, Remark(BELOW.format(", ".join(own.names[v] for v in where)), Kind.BELOW)) if where else one
        for one, where, own in zip(said, (row.nonzero().flatten().tolist() for row in below), views, strict=True)
    )


def _told_apart(views: Views, used: Tensor, before: Sequence[Told], held: bool) -> Remarks:
    """What the files of those of one camera's views that were used tell against one camera with one zoom."""
    views = views[used[: len(views)]] if views.told else views  # a camera of several has fewer views than the others
    if held:
        sentence = of_another_camera(before, views.names, views.told)
        return (Remark(sentence, Kind.TOLD_APART, sentence),) if sentence else ()
    return tuple(
        Remark(sentence, Kind.TOLD_APART, reason) for sentence, reason in against_one_camera(views.names, views.told)
    )


def _mismatch(
    found: Fit, status: Tensor, known: Calibration | None, batch: tuple[int, ...]
) -> Callable[[], Mismatch] | None:
    """How to compare located views with what is known of their camera; `None` where intrinsics were found."""
    if known is None or known.pixel_sigma is None:
        return (
            partial(mismatch_of_a_camera, found, status == Status.CONVERGED, batch) if poses_only(found.task) else None
        )
    return partial(mismatch, found, known, batch)


def _covariance(found: Fit, data: Data, noise: Noise | None, known: Calibration | None, doubt: Entangled) -> Covariance:
    batch = tuple(data.batch)
    before = None if known is None or not known.has_covariance else known.covariance_of_kept_poses
    own = covariance_of(found, noise, None if before is None else before.dispersion.expand(batch).reshape(-1))
    own = doubt.widened(own)
    own = own if data.frame.axes is None else points_turned(own, data.frame.axes.mT, found.task.parameters.few)
    R, _ = data.frame.world_pose(*(z.detach() for z in found.solution.local))
    arm = (R @ data.middle).reshape(*batch, -1, 3)
    common = in_common(found.task, *_state(found), local_inverse(found.solution.equations.W)[0])
    common = None if common is None else common.detach().reshape(*batch, *common.shape[1:])
    own = replace(reshaped(own, batch), middle=data.middle, _arm=arm, _common=common)
    return own if before is None else own.following(before)


def _state(found: Fit) -> tuple[Tensor, tuple[Tensor, ...]]:
    return found.solution.shared.detach(), tuple(z.detach() for z in found.solution.local)


def _others(found: Fit, data: Data, noise: Noise | None) -> OtherPoses:
    others = other_poses(found, noise)
    parts = *data.frame.world_pose(others.R, others.t), others.ratio
    return OtherPoses(*(part.reshape(*data.batch, *part.shape[1:]) for part in parts))
