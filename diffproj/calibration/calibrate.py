"""`calibrate`, `refine` and `locate`: from corners of a board to a `Calibration`.

`calibrate` finds a start in closed form and refines it; `refine` starts from a camera that is known roughly; `locate`
holds a known camera and finds poses alone. All work for one camera, views `(V, N, 2)`, or for many side by side,
`(*B, V, N, 2)`, each with its own damping and its own end. They compute in float64.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, get_args

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj.calibration import closed_form, start
from diffproj.calibration.constraints import Priors, free_basis, held_at, make_prior
from diffproj.calibration.covariance import Covariance, reshaped
from diffproj.calibration.data import Data
from diffproj.calibration.fit import Fit, Progress, Task, fit
from diffproj.calibration.implicit import differentiated
from diffproj.calibration.losses import Loss
from diffproj.calibration.parametrisation import Parametrisation
from diffproj.calibration.result import Calibration, CalibrationError, Objective
from diffproj.calibration.solver import Prior, Solution, Status, chosen
from diffproj.calibration.verdict import verdicts
from diffproj.geometry.camera import Camera, as_camera
from diffproj.lens.models import LensModel, model_named
from diffproj.targets.target import Target
from diffproj.targets.views import Views

REJECT = 5.0
"""Robust deviations beyond which a corner is an outlier: of Gaussian residuals, 4 in a million."""


def calibrate(
    views: Views,
    board: Target,
    distortion: LensModel = "brown5",
    *,
    objective: Objective = "image",
    bow: bool = False,
    fixed: Sequence[str] = (),
    tied_focal: bool = False,
    priors: Priors | None = None,
    weights: Tensor | None = None,
    loss: Loss | None = None,
    reject_outliers: bool | float = False,
    max_iterations: int = 300,
    tolerance: float = 3e-14,
    progress: Progress | None = None,
    throw: bool = True,
) -> Calibration:
    """Find intrinsics, lens and one pose a view that minimise the error of the corners.

    Args:
        views: corners `(*B, V, N, 2)` seen in photographs of known size. Views may miss any corners; one with fewer
            than 4 takes no part.
        board: anything with `.points (N, 3)` on z = 0, such as `Chessboard`; its unit is the world's.
        distortion: which lens to fit: `"none"`, `"brown4"`, `"brown5"`, `"brown8"`, `"brown12"`, `"brown14"` or
            `"fisheye"`.
        objective: `"image"` minimises pixels and is the statistically efficient one; `"plane"` minimises the distance
            on the board in world units, through `back_project`. It lowers that on the corners it is given; on others it
            was no better in trials on real views. Take it where the loss that matters is in world units.
        bow: fit the board's bow too, a paraboloid of two parameters. Not with the plane objective, for a bowed board
            has no plane.
        fixed: names of parameters or groups (`"principal_point"`, `"distortion"`, `"k3"`, ...) that keep their starting
            values: here the middle of the image, and 0 for the lens. (A known focal length is for `refine`.)
        tied_focal: `f_x : f_y` keeps the start's ratio: here 1.
        priors: what is known beforehand, by name or group: a standard deviation about the values that `fixed` would
            keep, or a tuple `(mean, deviation)`. It weighs against corners whose standard deviation is
            `1 / sqrt(weight)` px: give weights along with it, such as `torch.tensor(25.0)` for 0.2 px.
        weights: of the corners, broadcasting to `(*B, V, N)`: one over the variance of their coordinates, in px^-2 (for
            the plane objective in world units). A corner of weight 0 takes no part.
        loss: a robust loss such as `dp.Huber(0.5)`, its scale in pixels (in world units for the plane objective).
        reject_outliers: leave out corners whose residual exceeds 5 (or so many) robust standard deviations, and
            repeat; `Calibration.rejected` and the summary name them.
        max_iterations: steps of the solver.
        tolerance: it stops when what is left to gain falls below this part of the cost.
        progress: called as `progress(done, total)` after each step; work in two stages starts again once.
        throw: raise where a camera did not converge; if false, look at `Calibration.status`.

    Returns:
        The calibration, in float64.

    Raises:
        TypeError: views are no `dp.Views`.
        ValueError: views, board and options do not fit together.
        CalibrationError: a camera did not converge, or its views do not determine it.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> print(f"{calibration.rms:.3f}", [round(f) for f in calibration.camera.K.diagonal()[:2].tolist()])
        0.177 [533, 533]
    """
    model = model_named(distortion)
    data = Data(views, board, weights)
    if views.size is None:
        raise ValueError("views: want the photographs' size, got None; give Views(..., size=(width, height))")
    options = _Options(objective, bow, fixed, tied_focal, priors, loss, reject_outliers)
    shared, local = start.from_nothing(data, distortion, views.size, tied_focal, bow)
    steps = {"max_iterations": max_iterations, "tolerance": tolerance, "progress": progress}
    # The start is a guess from the corners; what is held, or known, is not.
    reference = shared.clone()
    reference[:, :2], reference[:, 4:] = torch.nan, 0.0
    if model.count > 5:
        # The rational terms nearly cancel each other: from far off they lead into side valleys.
        late = model.coefficient_names[5:]
        early = replace(options, fixed=(*fixed, *late), objective="image", reject_outliers=False)
        early = replace(early, loss=None if objective == "plane" else loss)  # its scale is in world units
        near, _ = _fitted(data, early, distortion, shared, local, reference, **steps)
        shared, local = near.solution.shared, near.solution.local
    found, _ = _fitted(data, options, distortion, shared, local, reference, **steps)
    return _result("calibrate", data, found, views.size, throw)


def refine(
    camera: Camera | PinholeCamera,
    views: Views,
    board: Target,
    *,
    objective: Objective = "image",
    bow: bool = False,
    fixed: Sequence[str] = (),
    tied_focal: bool = False,
    priors: Priors | None = None,
    weights: Tensor | None = None,
    loss: Loss | None = None,
    reject_outliers: bool | float = False,
    max_iterations: int = 300,
    tolerance: float = 3e-14,
    progress: Progress | None = None,
    throw: bool = True,
    differentiable: bool = False,
) -> Calibration:
    """Refine a camera on the corners of a board; the options are those of `calibrate`.

    Args:
        camera: the start: its lens says which lens is fitted, and fixed parameters keep its values. With a batch shape
            that broadcasts to `*B`, poses are found from the corners; with `(*B, V)`, its poses are the start, and its
            intrinsics are those of the first view.
        views: corners `(*B, V, N, 2)`.
        board: anything with `.points (N, 3)` on z = 0.
        objective: as in `calibrate`.
        bow: as in `calibrate`.
        fixed: as in `calibrate`.
        tied_focal: as in `calibrate`.
        priors: as in `calibrate`.
        weights: as in `calibrate`.
        loss: as in `calibrate`.
        reject_outliers: as in `calibrate`.
        max_iterations: as in `calibrate`.
        tolerance: as in `calibrate`.
        progress: as in `calibrate`.
        throw: as in `calibrate`.
        differentiable: carry gradients through the minimum: those of cameras and bow with respect to the views'
            pixels, the board's points, the weights and tensors among the priors are those of the minimiser (implicit
            function theorem, exact Hessian). To first order.

    Returns:
        The calibration, in float64.

    Raises:
        TypeError: views are no `dp.Views`, or the camera has a lens of another library.
        ValueError: views, board, camera and options do not fit together, or K has skew.
        CalibrationError: a camera did not converge, or its views do not determine it.

    Example:
        >>> import diffproj as dp
        >>> views, board = dp.example_views("left"), dp.Chessboard()
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
        >>> rough = dp.Camera(K, distortion=dp.BrownConrady(torch.zeros(5, dtype=torch.float64)), size=(640, 480))
        >>> print(f"{dp.refine(rough, views, board).rms:.3f}")
        0.177
    """
    data = Data(views, board, weights)
    camera = as_camera(camera)
    options = _Options(objective, bow, fixed, tied_focal, priors, loss, reject_outliers)
    shared, local, model = start.from_camera(camera, data, bow)
    steps = {"max_iterations": max_iterations, "tolerance": tolerance, "progress": progress}
    found, prior = _fitted(data, options, model, shared, local, shared, **steps)
    if differentiable:
        found = differentiated(found, data, prior)
    return _result("refine", data, found, camera.size or views.size, throw)


def locate(
    views: Views,
    board: Target,
    camera: Camera | PinholeCamera | Calibration,
    *,
    weights: Tensor | None = None,
    loss: Loss | None = None,
    max_iterations: int = 300,
    tolerance: float = 3e-14,
    throw: bool = True,
) -> Calibration:
    """Find the pose of each view with intrinsics and lens held, from at least 4 corners a view.

    A plane seen from afar has two poses that explain it almost equally well; both are refined and the better kept.
    The board is taken to be flat, also where a calibration found a bow.

    Args:
        views: corners `(*B, V, N, 2)`.
        board: anything with `.points (N, 3)` on z = 0.
        camera: batch shape broadcasting to `*B`; its own pose does not matter. A calibration brings its uncertainty
            along.
        weights: as in `calibrate`.
        loss: as in `calibrate`.
        max_iterations: as in `calibrate`.
        tolerance: as in `calibrate`.
        throw: as in `calibrate`.

    Returns:
        A calibration with the given intrinsics and the poses found, in float64. Its covariance holds the noise of the
        corners; and, where a calibration with a covariance was given, that of the intrinsics, which the poses follow.

    Raises:
        TypeError: views are no `dp.Views`, or the camera has a lens of another library.
        ValueError: views, board and camera do not fit together, or K has skew.
        CalibrationError: no pose explains a view.

    Example:
        >>> import diffproj as dp
        >>> views, board = dp.example_views("left"), dp.Chessboard()
        >>> camera = dp.calibrate(views[:8], board).camera
        >>> print(f"{dp.locate(views[8:], board, camera).rms:.2f}")
        0.18
    """
    _check_loss(loss)
    data = Data(views, board, weights)
    known = None
    if isinstance(camera, Calibration):
        known = camera.covariance if camera.has_covariance else None
        camera = camera.camera
    camera = as_camera(camera)
    if len(camera.batch_shape) > len(data.batch):
        raise ValueError(
            f"camera: want a batch shape that broadcasts to {tuple(data.batch)}, got {tuple(camera.batch_shape)}; "
            "index it, or take calibration.camera"
        )
    shared, (R, t), model = start.from_camera(camera, data, bow=False)
    # Each view is a problem of its own, with a step and an end of its own, from each of its two starts.
    V = len(views)
    single = Task(
        data.points,
        data.pixels.flatten(0, 1).unsqueeze(1),
        data.used.flatten(0, 1).unsqueeze(1),
        model,
        weights=None if data.weights is None else data.weights.flatten(0, 1).unsqueeze(1),
        loss=loss,
        basis=shared.new_zeros(len(shared) * V, shared.shape[-1], 0),
    )
    held = shared.repeat_interleave(V, dim=0)
    starts = (R, t), closed_form.other_pose(R, t, data.points)
    one, other = (
        fit(
            single,
            held,
            tuple(z.flatten(0, 1).unsqueeze(1) for z in local),
            max_iterations=max_iterations,
            tolerance=tolerance,
        ).solution
        for local in starts
    )
    better = torch.where(other.cost.isfinite(), other.cost, torch.inf) < torch.where(
        one.cost.isfinite(), one.cost, torch.inf
    )
    best = chosen(better.numpy(force=True), other, one)
    task = data.task(model, loss=loss, basis=shared.new_zeros(*shared.shape, 0))
    seen = data.used.any(-1)
    status = torch.where(seen, best.status.reshape(seen.shape), Status.CONVERGED)
    equations = best.equations
    joined = Solution(
        shared,
        tuple(z.squeeze(1).unflatten(0, seen.shape) for z in best.local),
        torch.where(seen, best.cost.reshape(seen.shape), 0.0).sum(-1),
        status.amax(-1),
        best.iterations.reshape(seen.shape).amax(-1),
        equations._replace(
            U=equations.U.unflatten(0, seen.shape).sum(1),
            E=equations.E.squeeze(1).unflatten(0, seen.shape),
            W=equations.W.squeeze(1).unflatten(0, seen.shape),
            g=equations.g.unflatten(0, seen.shape).sum(1),
            h=equations.h.squeeze(1).unflatten(0, seen.shape),
            c=equations.c.reshape(seen.shape),
        ),
    )
    found = Fit(task, joined, torch.zeros_like(data.used))
    return _result("locate", data, found, camera.size or views.size, throw, known)


def _check_loss(loss: object) -> None:
    if loss is not None and not isinstance(loss, Loss):
        raise TypeError(f"loss: want one such as dp.Huber(0.5), got {type(loss).__name__}")


@dataclass(frozen=True)
class _Options:
    """What is minimised, as the caller said it."""

    objective: Objective
    bow: bool
    fixed: Sequence[str]
    tied_focal: bool
    priors: Priors | None
    loss: Loss | None
    reject_outliers: bool | float

    def __post_init__(self) -> None:
        if self.objective not in get_args(Objective):
            raise ValueError(f"objective: want one of {', '.join(get_args(Objective))}, got {self.objective!r}")
        if self.bow and self.objective == "plane":
            raise ValueError("bow: want False with objective='plane', for a bowed board has no plane")
        if isinstance(self.fixed, str):
            raise TypeError(f"fixed: want several names, as in fixed=({self.fixed!r},), got a string")
        if self.priors is not None and not isinstance(self.priors, Mapping):
            raise TypeError(f"priors: want a mapping from names, got {type(self.priors).__name__}")
        _check_loss(self.loss)
        if not isinstance(self.reject_outliers, bool | np.bool_ | int | float) or not self.reject_outliers >= 0:
            raise ValueError(f"reject_outliers: want True or a number above 0, got {self.reject_outliers!r}")

    @property
    def reject(self) -> float | None:
        """Robust deviations beyond which a corner is an outlier."""
        if isinstance(self.reject_outliers, bool | np.bool_):
            return REJECT if self.reject_outliers else None
        return float(self.reject_outliers) or None


def _fitted(
    data: Data,
    options: _Options,
    model: LensModel,
    shared: Tensor,
    local: tuple[Tensor, ...],
    reference: Tensor,
    **steps: Any,
) -> tuple[Fit, Prior | None]:
    """Where the solver ends from that start, and the prior with its graph.

    `reference (P, s)` is what fixed parameters keep and priors without a mean are about; NaN where nothing is known.
    """
    parameters = Parametrisation(model, options.bow)
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
    return fit(task, shared, local, reject=options.reject, **steps), prior


def _result(
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
    status, causes = verdicts(found, data.views.names, data.board)

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
    )
    if throw and bool((status != Status.CONVERGED).any()):
        raise CalibrationError(f"{who}: {calibration.message}", calibration)
    return calibration


def _covariance(found: Fit, batch: tuple[int, ...], known: Covariance | None) -> Covariance:
    own = reshaped(found.covariance(), batch)
    return own if known is None else own.following(known)
