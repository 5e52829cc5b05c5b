"""`calibrate_rig`: cameras that look at one target together, with their places to each other.

Each camera is calibrated on its own, the best-connected pairs are chained, and all is refined together: intrinsics,
one pose a camera relative to the first, one pose of the target a moment. It computes in float64.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Unpack, overload

from diffproj.calibration.results.calibration import CalibrationError
from diffproj.calibration.rigs.fleet import each_rig
from diffproj.calibration.rigs.one import rig_calibrated, rig_task
from diffproj.calibration.rigs.options import RigOptions, rig_options
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.calibration.rigs.views import Moments
from diffproj.lens.models import LensModel
from diffproj.targets.target import Target
from diffproj.targets.views import Views


@overload
def calibrate_rig(
    views_by_camera: Mapping[str, Views],
    target: Target,
    distortion: LensModel | Mapping[str, LensModel] = "brown5",
    moments: Moments | None = None,
    cameras: Any = None,
    **options: Unpack[RigOptions],
) -> RigCalibration: ...


@overload
def calibrate_rig(
    views_by_camera: Sequence[Mapping[str, Views]],
    target: Target,
    distortion: LensModel | Mapping[str, LensModel] = "brown5",
    moments: Moments | Sequence[Moments | None] | None = None,
    cameras: Any = None,
    **options: Unpack[RigOptions],
) -> list[RigCalibration | CalibrationError]: ...


def calibrate_rig(
    views_by_camera: Mapping[str, Views] | Sequence[Mapping[str, Views]],
    target: Target,
    distortion: LensModel | Mapping[str, LensModel] = "brown5",
    moments: Moments | Sequence[Moments | None] | None = None,
    cameras: Any = None,
    **options: Unpack[RigOptions],
) -> RigCalibration | list[RigCalibration | CalibrationError]:
    """Find intrinsics, lenses and places of several cameras that minimise the error of the corners, all together.

    The first camera is the rig's frame: its axes and its centre. A view of a moment that no other camera shares tells
    of its own camera and so counts too. A view that contradicts the others at its moment, as of a board that was turned
    or a camera that was late, is left out, and `remarks` say so.

    Args:
        views_by_camera: corners `(V, N, 2)` by the camera's name. Cameras may miss any moments, and views any corners;
            a view with fewer than 4 takes no part. Sizes may differ. Or a list with those of one rig each: their
            cameras on their own are calibrated side by side, and so are rigs of as many cameras and about as many
            moments refined.
        target: a board, `Landmarks`, or anything with `.points (N, 3)`; its unit is the world's. The places of
            landmarks with a sigma are found along with the rig, for all cameras see them off in the same way.
        distortion: which lens to fit, as for `calibrate`; or one by camera.
        moments: by camera, the name or number of each view's moment. Left out, the views' names are the moments', with
            the camera's own name taken out where they would share none: `left03.jpg` and `right03.jpg` are `03.jpg`.
        cameras: known beforehand, by name: cameras, calibrations, or a rig that was calibrated before. Their intrinsics
            are what is started from, or held; their poses count where the rig is held, `fixed=("rig",)`. What is held
            of a calibration or a rig errs as it says; give its `camera` or `cameras` where it is to count as exact. For
            a list of rigs, moments, cameras and weights may be lists of as many.
        options: `fixed`, `shape`, `priors`, `weights`, `loss`, `reject_outliers`, `max_iterations`, `tolerance`,
            `progress` and `throw`: see `RigOptions`.

    Returns:
        The rig, in float64. For a list of rigs a list in its order, each the same as alone; where one failed, the
        `CalibrationError` that says why stands in its place, and the others go on. `progress` then counts rigs.

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
    who, chosen = "calibrate_rig", rig_options("calibrate_rig", options)
    if isinstance(views_by_camera, list | tuple) and views_by_camera:
        return each_rig(views_by_camera, target, distortion, moments, cameras, chosen, who)
    task = rig_task(views_by_camera, target, distortion, moments, cameras, chosen, who)  # type: ignore[arg-type]
    return rig_calibrated(task)
