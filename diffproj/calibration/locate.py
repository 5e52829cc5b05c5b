"""`locate`: where a known camera stood, from the corners of a target in each view."""

import warnings
from typing import Unpack

import torch
from kornia.geometry.camera import PinholeCamera

from diffproj._core.warn import warn_caller
from diffproj.calibration import closed_form, start
from diffproj.calibration.ambiguity import AmbiguousPoseWarning
from diffproj.calibration.data import Data
from diffproj.calibration.fit import Fit, fit
from diffproj.calibration.mismatch import CameraMismatchWarning, described
from diffproj.calibration.options import LocateOptions, locate_options
from diffproj.calibration.outcome import outcome
from diffproj.calibration.result import Calibration
from diffproj.calibration.solver import Solution, Status, select
from diffproj.calibration.task import Task
from diffproj.geometry.camera import Camera, as_camera
from diffproj.targets.chessboard import Chessboard, origin_doubt
from diffproj.targets.target import Target
from diffproj.targets.views import Views

REMEDY = (
    "see alternatives and likelihood_ratio. A target that is larger in the image, more tilted, or with more corners "
    "tells them apart; a calibration in place of a camera brings the noise along, which few corners do not tell"
)
"""What to do about a view that is ambiguous."""


def locate(
    views: Views, target: Target, camera: Camera | PinholeCamera | Calibration, **options: Unpack[LocateOptions]
) -> Calibration:
    """Find the pose of each view with intrinsics and lens held, from at least 4 corners a view.

    A plane seen from afar has two poses that explain it almost equally well; both are refined and the better kept. The
    other is in `alternatives`, and the covariance holds the doubt; where it may well be the right one, the view is
    `ambiguous`, and an `AmbiguousPoseWarning` names it.
    A chessboard that looks the same when turned (`Chessboard.turns`) leaves open which corner is the origin: a warning
    says so.
    With a calibration in the place of a camera a `CameraMismatchWarning` names the views whose corners are not where it
    sees them, as photographs of another camera, zoom or focus: see `mismatch`.
    The board is taken to be flat, also where a calibration found a bow.

    Args:
        views: corners `(*B, V, N, 2)`.
        target: anything with `.points (N, 3)` on z = 0.
        camera: batch shape broadcasting to `*B`; its own pose does not matter. A calibration brings its uncertainty
            along, and the noise of its corners, which few corners do not tell.
        options: `weights`, `loss`, `max_iterations`, `tolerance`, `progress` and `throw`: see `LocateOptions`.

    Returns:
        A calibration with the given intrinsics and the poses found, in float64; where the image is turned, with those
        of the camera that is turned itself, which sees the same (`Camera.upright`). Its covariance holds the noise of
        the corners; and, where a calibration with a covariance was given, that of the intrinsics, which the poses
        follow.

    Raises:
        TypeError: views are no `dp.Views`, the camera has a lens of another library, or an option is unknown.
        ValueError: views, target and camera do not fit together, or the image is turned against a tilted sensor.
        CalibrationError: no pose explains a view.

    Example:
        >>> import diffproj as dp
        >>> views, board = dp.example_views("left"), dp.Chessboard()
        >>> camera = dp.calibrate(views[:8], board).camera
        >>> print(f"{dp.locate(views[8:], board, camera).rms:.2f}")
        0.16
    """
    found = located(views, target, camera, **options)
    if isinstance(target, Chessboard) and target.turns > 1:
        warn_caller(f"locate: {origin_doubt(target)}")
    if bool(found.ambiguous.any()):
        warnings.warn(f"locate: {found.ambiguity}; {REMEDY}", AmbiguousPoseWarning, stacklevel=2)
    if text := described(found.mismatch, views.names):
        warn_caller(f"locate: {text}", CameraMismatchWarning)
    return found


def located(
    views: Views, target: Target, camera: Camera | PinholeCamera | Calibration, **options: Unpack[LocateOptions]
) -> Calibration:
    """The same without a warning."""
    if isinstance(views, Camera | PinholeCamera | Calibration):
        raise TypeError("locate: want (views, target, camera) in this order, got the camera first")
    chosen = locate_options(options)
    loss = chosen.loss
    data = Data(views, target, chosen.weights)
    calibration = camera if isinstance(camera, Calibration) else None
    if isinstance(camera, Calibration):
        camera = camera.camera
    camera = as_camera(camera)
    skew = calibration is not None and calibration.skew
    shared, (R, t), parameters = start.from_camera(camera, data, bow=False, skew=skew, with_poses=False)
    # Each view is a problem of its own, with a step and an end of its own, from each of its two starts.
    V = len(views)
    single = Task(
        data.points,
        data.pixels.flatten(0, 1).unsqueeze(1),
        data.used.flatten(0, 1).unsqueeze(1),
        parameters.lens,
        skew=parameters.skew,
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
            max_iterations=chosen.max_iterations,
            tolerance=chosen.tolerance,
            progress=chosen.progress,
        ).solution
        for local in starts
    )
    better = torch.where(other.cost.isfinite(), other.cost, torch.inf) < torch.where(
        one.cost.isfinite(), one.cost, torch.inf
    )
    best = select(better.numpy(force=True), other, one)
    task = data.task(parameters.lens, skew=parameters.skew, loss=loss, basis=shared.new_zeros(*shared.shape, 0))
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
    return outcome("locate", data, found, camera.size or views.size, chosen.throw, calibration)
