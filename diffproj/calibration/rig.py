"""`calibrate_rig`: cameras that look at one target together, with their places to each other.

Each camera is calibrated on its own, the best-connected pairs are chained, and all is refined together: intrinsics,
one pose a camera relative to the first, one pose of the target a moment. It computes in float64.
"""

from collections.abc import Mapping
from typing import Any, Unpack

from torch import Tensor

from diffproj.calibration.parametrisation import Parametrisation
from diffproj.calibration.result import CalibrationError
from diffproj.calibration.rig_alone import alone, checked_cameras, lenses
from diffproj.calibration.rig_fit import rig_fit
from diffproj.calibration.rig_options import RigOptions, held, held_places, held_points, rig_options
from diffproj.calibration.rig_outcome import rig_outcome
from diffproj.calibration.rig_problem import RigParameters
from diffproj.calibration.rig_result import RigCalibration
from diffproj.calibration.rig_shape import with_bow, with_known_points, with_points
from diffproj.calibration.rig_start import rig_start
from diffproj.calibration.rig_views import Moments, rig_views
from diffproj.calibration.solver import Status
from diffproj.lens.models import LensModel
from diffproj.targets.target import Target
from diffproj.targets.views import Views


def calibrate_rig(
    views_by_camera: Mapping[str, Views],
    target: Target,
    distortion: LensModel | Mapping[str, LensModel] = "brown5",
    moments: Moments | None = None,
    cameras: Any = None,
    **options: Unpack[RigOptions],
) -> RigCalibration:
    """Find intrinsics, lenses and places of several cameras that minimise the error of the corners, all together.

    The first camera is the rig's frame: its axes and its centre. A view of a moment that no other camera shares tells
    of its own camera and so counts too. A view that contradicts the others at its moment, as of a board that was turned
    or a camera that was late, is left out, and `remarks` say so.

    Args:
        views_by_camera: corners `(V, N, 2)` by the camera's name. Cameras may miss any moments, and views any corners;
            a view with fewer than 4 takes no part. Sizes may differ.
        target: a board, `Landmarks` without sigma, or anything with `.points (N, 3)`; its unit is the world's.
        distortion: which lens to fit, as for `calibrate`; or one by camera.
        moments: by camera, the name or number of each view's moment. Left out, the views' names are the moments', with
            the camera's own name taken out where they would share none: `left03.jpg` and `right03.jpg` are `03.jpg`.
        cameras: known beforehand, by name: cameras, calibrations, or a rig that was calibrated before. Their intrinsics
            are what is started from, or held; their poses count where the rig is held, `fixed=("rig",)`.
        options: `fixed`, `shape`, `priors`, `weights`, `loss`, `reject_outliers`, `max_iterations`, `tolerance`,
            `progress` and `throw`: see `RigOptions`.

    Returns:
        The rig, in float64.

    Raises:
        TypeError: no mapping from names to views, or an option is unknown or of another type.
        ValueError: views, moments, target and options do not fit together.
        CalibrationError: nothing connects some cameras with the first, moments contradict each other, or the views do
            not determine a camera or the rig.

    Example:
        >>> import diffproj as dp
        >>> pair = {"left": dp.example_views("left"), "right": dp.example_views("right")}
        >>> rig = dp.calibrate_rig(pair, dp.Chessboard())
        >>> rig
        RigCalibration(2 cameras, 13 moments, baseline 83.2, RMS 0.1732 px, converged)
    """
    chosen = rig_options("calibrate_rig", options)
    return rig_calibrated(views_by_camera, target, distortion, moments, cameras, chosen, "calibrate_rig")


def rig_calibrated(
    views_by_camera: Mapping[str, Views],
    target: Target,
    distortion: LensModel | Mapping[str, LensModel],
    moments: Moments | None,
    cameras: Any,
    chosen: Any,
    who: str,
    moved: Tensor | None = None,
) -> RigCalibration:
    """What `calibrate_rig` promises, for checked options; errors name `who` was asked.

    With `moved (N, 3)` the target's points are known to lie so far from where it has them.
    """
    views = rig_views(views_by_camera, target, moments, chosen.weights, who)
    known = checked_cameras(cameras, views.names)
    lens = lenses(distortion, views.names)
    # What is held has to be known by camera before each is calibrated on its own; a known camera brings its lens.
    kinds = {name: Parametrisation.of(known[name]) if name in known else Parametrisation(lens[name]) for name in lens}
    parameters = RigParameters(views.names, tuple(kinds.values()))
    shaped = chosen.shape != "flat" or moved is not None
    if shaped and bool((views.data[views.names[0]].given_points.detach()[:, 2] != 0).any()):
        raise ValueError(f"shape: want 'flat' for points that are not all on z = 0, got {chosen.shape!r}")
    fixed, points = held_points(chosen.fixed, len(views.points))
    names, positions = held(parameters, fixed)
    own = alone(views, target, lens, known, names, chosen, who)
    seen = {name: one.seen for name, one in own.items()}
    start = rig_start(views, seen, held_places(parameters, positions, known), who)
    found = rig_fit(
        views,
        parameters,
        {name: one.shared for name, one in seen.items()},
        start,
        {name: one.used for name, one in seen.items()},
        positions,
        chosen,
    )
    if moved is not None:
        found = with_known_points(found, moved, chosen)
    elif chosen.shape == "bow":
        found = with_bow(found, chosen)
    elif chosen.shape == "free":
        found = with_points(found, points, chosen)
    rig = rig_outcome(found, own)
    if chosen.throw and rig.status != Status.CONVERGED:
        raise CalibrationError(f"{who}: {rig.message}", rig)
    return rig
