"""`locate`: where a known camera stood, from the corners of a target in each view."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Unpack

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import flag, words
from diffproj._core.warn import warn_caller
from diffproj.calibration.circle_centres import with_true_centres
from diffproj.calibration.evidence.adjustment import Adjustment
from diffproj.calibration.fitting import start
from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.options import LocateOptions, Options, locate_options
from diffproj.calibration.fitting.second_look import lower_fit
from diffproj.calibration.known_poses import known_poses
from diffproj.calibration.least_squares.normal_equations import Equations
from diffproj.calibration.least_squares.solver import Solution, Status, equations_at
from diffproj.calibration.outcome import outcome
from diffproj.calibration.problem.constraints import Priors
from diffproj.calibration.problem.parametrisation import POSE, Parametrisation
from diffproj.calibration.results.ambiguity import AmbiguousPoseWarning
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.mismatch import CameraMismatchWarning, described
from diffproj.calibration.results.source import told_of_intrinsics
from diffproj.geometry.camera import Camera, as_camera
from diffproj.targets.boards import origin_doubt
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.circle_grid import CircleGrid
from diffproj.targets.one_camera import of_another_camera
from diffproj.targets.target import Target
from diffproj.targets.views import Views

SAME = 1e-9
"""Part of the target's size by which the points of two may differ and still be one target's."""
REMEDY = (
    "see alternatives and likelihood_ratio. A target that is larger in the image, more tilted, or with more corners "
    "tells them apart; a calibration in place of a camera brings the noise along, which few corners do not tell"
)
"""What to do about a view that is ambiguous."""


def locate(
    views: Views,
    target: Target,
    camera: Camera | PinholeCamera | Calibration,
    *,
    fixed: Sequence[str] = (),
    priors: Priors | None = None,
    same_target: bool = True,
    **options: Unpack[LocateOptions],
) -> Calibration:
    """Find the pose of each view with intrinsics and lens held, from at least 4 corners a view.

    A plane seen from afar has two poses that explain it almost equally well; both are refined and the better kept. The
    other is in `alternatives`, and the covariance holds the doubt; where it may well be the right one, the view is
    `ambiguous`, and an `AmbiguousPoseWarning` names it.
    A chessboard that looks the same when turned (`Chessboard.turns`) leaves open which corner is the origin: a warning
    says so.
    With a calibration in the place of a camera a `CameraMismatchWarning` names the views whose corners are not where it
    sees them, as photographs of another camera, zoom or focus; with a camera alone, those whose residuals other
    intrinsics would explain nearly all of: see `mismatch`.
    A calibration that fitted the target's shape brings that along, too, for the same target. `Landmarks` may lie
    anywhere; where they come with a sigma of their own, each view's pose carries it, found by that view alone, whatever
    else is in the batch. Views that share landmarks are off together, as the covariance between their poses says;
    `refine` with all parameters of the camera fixed finds poses and landmarks together, and is surer. With a
    calibration that was found on them landmarks are where that has them.

    Args:
        views: corners `(*B, V, N, 2)`.
        target: a board, `Landmarks`, or anything with `.points (N, 3)`.
        camera: batch shape broadcasting to `*B`; its own pose does not matter, but for what `fixed` and `priors` say. A
            calibration brings its uncertainty along, and the noise of its corners, which few corners do not tell.
        fixed: names of the pose that keep the camera's values in all views, as in `adjust`: `height`, `tilt`, `roll`,
            `heading`, `position`, and so on, in the world of `Camera.mounted`, z up.
        priors: what is known of the pose beforehand, by the same names, as in `adjust`: a standard deviation about the
            camera's own value, or a tuple `(mean, standard deviation)`; numbers or tensors `(*B, V)`. It weighs against
            the noise of the pixels: give `pixel_sigma` along with it.
        same_target: whether the views show the very target whose shape the calibration fitted, if it did and `target`
            has the same points: its corners then are where the calibration has them, as surely as it knows. Say False
            for another print of it.
        options: `weights`, `pixel_sigma`, `loss`, `reject_outliers`, `max_iterations`, `tolerance`, `progress` and
            `throw`: see `LocateOptions`.

    Returns:
        A calibration with the given intrinsics and the poses found, in float64; where the image is turned, with those
        of the camera that is turned itself, which sees the same (`Camera.upright`). Its covariance holds the noise of
        the corners; and, where a calibration with a covariance was given, that of the intrinsics, which the poses
        follow.

    Raises:
        TypeError: views are no `dp.Views`, the camera has a lens of another library, or an option is unknown.
        ValueError: views, target and camera do not fit together, the image is turned against a tilted sensor, or names
            or values of `fixed` and `priors` that cannot be.
        CalibrationError: no pose explains a view.

    Example:
        >>> import diffproj as dp
        >>> views, board = dp.example_views("left"), dp.Chessboard()
        >>> camera = dp.calibrate(views[:8], board).camera
        >>> print(f"{dp.locate(views[8:], board, camera).rms:.2f}")
        0.16
    """
    shaped = camera if flag("same_target", same_target) else None
    known = {"fixed": words("fixed", fixed, "several names"), "priors": priors}

    def find(moved: Views) -> Calibration:
        return located(moved, target, camera, shaped, **known, **options)

    found = with_true_centres(find, views, target)
    if isinstance(target, Chessboard | CircleGrid) and target.turns > 1:
        warn_caller(f"locate: {origin_doubt(target)}")
    if bool(found.ambiguous.any()):
        warn_caller(f"locate: {found.ambiguity}; {REMEDY}", AmbiguousPoseWarning)
    calibrated = found.lens_region is not None
    if text := described(found.mismatch, views.names, calibrated):
        if calibrated and found.landmarks is not None:
            text += " Pixels that were picked by hand are less exact than a detector's: pixel_sigma=0.5 says so"
        warn_caller(f"locate: {text}", CameraMismatchWarning)
    if isinstance(camera, Calibration) and (
        text := of_another_camera(told_of_intrinsics(camera), views.names, views.told)
    ):
        warn_caller(f"locate: {text}", CameraMismatchWarning)
    return found


def located(
    views: Views,
    target: Target,
    camera: Camera | PinholeCamera | Calibration,
    shaped: object = None,
    *,
    fixed: Sequence[str] = (),
    priors: Priors | None = None,
    **options: Unpack[LocateOptions],
) -> Calibration:
    """The same without a warning; `shaped` may be a calibration that fitted the shape of this target."""
    if isinstance(views, Camera | PinholeCamera | Calibration):
        raise TypeError("locate: want (views, target, camera) in this order, got the camera first")
    chosen = locate_options(options)
    if fixed or priors is not None:
        return _with_knowledge(views, target, camera, shaped, chosen, fixed, priors)
    data = Data(views, target, chosen.weights, chosen.pixel_sigma)
    calibration = camera if isinstance(camera, Calibration) else None
    if isinstance(camera, Calibration):
        camera = camera.camera
    camera = as_camera(camera)
    skew = calibration is not None and calibration.skew
    shared, _, parameters = start.from_camera(camera, data, bow=False, skew=skew, with_poses=False)
    shared = shared.detach()
    if isinstance(shaped, Calibration):
        shared, parameters = _with_shape(shared, parameters, data, shaped)
    model: dict[str, Any] = {"bow": parameters.bow, "skew": parameters.skew, "free": parameters.points > 0}
    # Each view is a problem of its own, with a step and an end of its own, from each of its starts.
    V = len(views)
    task = data.task(parameters.lens, **model, loss=chosen.loss, basis=shared.new_zeros(*shared.shape, 0))
    if parameters.points and isinstance(shaped, Calibration) and shaped.has_covariance:
        task = replace(task, spread=None)  # landmarks are where the calibration has them, as surely as it knows
    single = replace(
        task,
        pixels=data.pixels.flatten(0, 1).unsqueeze(1),
        used=data.used.flatten(0, 1).unsqueeze(1),
        weights=None if data.weights is None else data.weights.flatten(0, 1).unsqueeze(1),
        basis=shared.new_zeros(len(shared) * V, shared.shape[-1], 0),
    )
    held = shared.repeat_interleave(V, dim=0)
    steps = {name: getattr(chosen, name) for name in ("max_iterations", "tolerance", "progress")}
    fits = [
        fit(single, held, tuple(z.flatten(0, 1).unsqueeze(1) for z in pose), reject=chosen.outlier_limit, **steps)
        for pose in start.poses_from_camera(task, shared)
    ]
    best = fits[0]
    for other in fits[1:]:
        best = lower_fit(best, other, torch.arange(len(held), device=held.device), chosen.outlier_limit)
    seen = data.used.any(-1)
    used, rejected = (z.squeeze(1).unflatten(0, seen.shape) for z in (best.task.used, best.rejected))
    task = replace(task, used=used)
    if best.task.whitening is not None:
        task = replace(task, whitening=best.task.whitening.squeeze(1).unflatten(0, seen.shape))
    poses = tuple(z.squeeze(1).unflatten(0, seen.shape) for z in best.solution.local)
    status = torch.where(seen, best.solution.status.reshape(seen.shape), Status.CONVERGED)
    equations = _joined(best.solution.equations, seen)
    if parameters.points:
        with torch.no_grad():
            equations = equations_at(task.problem, shared, poses, POSE, task.weights, chosen.loss)
    joined = Solution(
        shared,
        poses,
        torch.where(seen, best.solution.cost.reshape(seen.shape), 0.0).sum(-1),
        status.amax(-1),
        best.solution.iterations.reshape(seen.shape).amax(-1),
        equations,
    )
    found = Fit(task, joined, rejected)
    return outcome("locate", data, found, camera.size or views.size, chosen.throw, calibration)


def _with_knowledge(
    views: Views,
    target: Target,
    camera: Camera | PinholeCamera | Calibration,
    shaped: object,
    chosen: Options,
    fixed: Sequence[str],
    priors: Priors | None,
) -> Calibration:
    """The poses with what is known of them, from those that the corners alone tell."""
    data = Data(views, target, chosen.weights, chosen.pixel_sigma)
    calibration = camera if isinstance(camera, Calibration) else None
    if isinstance(shaped, Calibration) and shaped.shape != "flat":
        raise ValueError(
            "fixed, priors: want a calibration with a flat target, got one that fitted the target's shape; pass "
            "same_target=False, or calibration.camera"
        )
    posed: Camera | PinholeCamera = camera.camera if isinstance(camera, Calibration) else camera
    if isinstance(camera, Adjustment):
        posed = camera.cameras[..., 0]
    options = vars(chosen.but(throw=False))
    alone = located(views, target, posed if calibration is None else calibration, **options)
    return known_poses(data, as_camera(posed).upright(), alone, calibration, chosen, fixed, priors)


def _joined(equations: Equations, seen: Tensor) -> Equations:
    """The equations of cameras with views `(P, V)`, from those of their views one by one."""
    return Equations(
        U=equations.U.unflatten(0, seen.shape).sum(1),
        E=equations.E.squeeze(1).unflatten(0, seen.shape),
        W=equations.W.squeeze(1).unflatten(0, seen.shape),
        g=equations.g.unflatten(0, seen.shape).sum(1),
        h=equations.h.squeeze(1).unflatten(0, seen.shape),
        c=equations.c.reshape(seen.shape),
    )


def _with_shape(
    shared: Tensor, parameters: Parametrisation, data: Data, known: Calibration
) -> tuple[Tensor, Parametrisation]:
    """Shared parameters with the shape of the target that a calibration found, where it is that target's."""
    same = known.nominal.shape == data.given_points.shape and bool(
        (known.nominal.to(data.points) - data.given_points.detach()).abs().amax() <= SAME * data.points.abs().amax()
    )
    if known.shape == "flat" or not same:
        return shared, parameters
    parts = known.bow
    if known.displacements is not None:
        parts = data.frame.turned(known.displacements.to(data.points)).flatten(-2)
    parts = parts.detach().to(shared).expand(*data.batch, -1).reshape(len(shared), -1)  # type: ignore[union-attr]
    points = len(data.points) if known.shape == "free" else 0
    return torch.cat([shared, parts], dim=-1), replace(parameters, bow=known.shape == "bow", points=points)
