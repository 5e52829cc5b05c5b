"""`calibrate`: a camera from nothing but the corners of a target in photographs of known size.

A start in closed form is refined by the solver. It works for one camera, views `(V, N, 2)`, for many side by side,
`(*B, V, N, 2)`, each with its own damping and its own end, or for a list of cameras that differ; all in float64.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, Unpack, overload

from diffproj.calibration.circle_centres import with_true_centres
from diffproj.calibration.fitting.options import CalibrationOptions, Options, calibration_options
from diffproj.calibration.fleet import each_calibrated
from diffproj.calibration.lens_choice import chosen_lens
from diffproj.calibration.one_lens import calibrated
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.lens.models import LensModel
from diffproj.targets.target import Target
from diffproj.targets.views import Views, as_views


@overload
def calibrate(
    views: Views,
    target: Target,
    distortion: LensModel | Literal["auto"] = "brown5",
    **options: Unpack[CalibrationOptions],
) -> Calibration: ...


@overload
def calibrate(
    views: Sequence[Views],
    target: Target,
    distortion: LensModel | Literal["auto"] = "brown5",
    **options: Unpack[CalibrationOptions],
) -> list[Calibration | CalibrationError]: ...


def calibrate(
    views: Views | Sequence[Views],
    target: Target,
    distortion: LensModel | Literal["auto"] = "brown5",
    **options: Unpack[CalibrationOptions],
) -> Calibration | list[Calibration | CalibrationError]:
    """Find intrinsics, lens and one pose per view that minimise the error of the corners.

    Args:
        views: corners `(*B, V, N, 2)` seen in photographs of known size. Views may miss any corners; one with fewer
            than 4 takes no part. Views that show the board alike count as one, and at least two must differ, unless
            `fixed` or `priors` hold the principal point and the lens. Or a list with the views of one camera each, of
            any number and size: those of like cameras are solved side by side.
        target: a board such as `Chessboard`, `Landmarks`, or anything with `.points (N, 3)`; its unit is the world's.
            Of a `CircleGrid`, `Calibration.views` holds where the centres are seen, not their images' middles.
        distortion: which lens to fit: `"none"`, `"brown4"`, `"brown5"`, `"brown8"`, `"brown12"`, `"brown14"` or
            `"fisheye"`. Or `"auto"`, for one camera: `"none"`, `"brown5"`, `"fisheye"` and `"brown8"`, and the longer
            ones where all of these leave something over, are fitted side by side and compared by their errors on
            corners held out; the simplest that is no worse than the best, as far as the views can tell, is returned,
            and `Calibration.comparison` says how they fared.
        options: `objective`, `shape`, `skew`, `fixed`, `tied_focal`, `priors`, `weights`, `pixel_sigma`, `loss`,
            `reject_outliers`, `max_iterations`, `tolerance`, `progress` and `throw`: see `CalibrationOptions`. For a
            list of cameras, `weights` and `pixel_sigma` may be lists of as many, and `progress` counts cameras.

    Returns:
        The calibration, in float64. For a list of cameras a list in its order, with the calibration of each, the same
        as alone; where one failed, the `CalibrationError` that says why stands in its place, and the others go on.
        (With `throw=False` it is the calibration with its `status`, if there is one.)

    Raises:
        TypeError: views are no `dp.Views`, or an option is unknown or of another type.
        ValueError: views, target and options do not fit together; or `"auto"` for a batch of cameras, or with a held
            lens.
        CalibrationError: a camera did not converge, or its views do not determine it.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> print(f"{calibration.rms:.3f}", [round(f) for f in calibration.camera.K.diagonal()[:2].tolist()])
        0.158 [534, 534]

        A list of cameras, of which the last has one view alone, which is not enough:

        >>> left, right = dp.example_views("left"), dp.example_views("right")
        >>> found = dp.calibrate([left, right[:9], right[0]], dp.Chessboard())
        >>> [type(one).__name__ for one in found]
        ['Calibration', 'Calibration', 'CalibrationError']
    """
    chosen = calibration_options("calibrate", options)
    one_camera = _of_one_camera(target, distortion)
    if isinstance(views, list | tuple) and any(isinstance(one, Views) for one in views):
        return each_calibrated(views, target, distortion, chosen, one_camera)
    return one_camera(as_views(views), chosen)  # type: ignore[arg-type]


def calibrate_and_tell(
    cameras: Sequence[Views], target: Target, distortion: Any, **options: Unpack[CalibrationOptions]
) -> list[Calibration | CalibrationError]:
    """The same of a list of cameras, with the remarks on them, which cost less side by side than one by one."""
    chosen = calibration_options("calibrate", options)
    return each_calibrated(cameras, target, distortion, chosen, _of_one_camera(target, distortion), told=True)


def _of_one_camera(target: Target, distortion: LensModel | Literal["auto"]) -> Callable[[Views, Options], Calibration]:
    """What calibrates one camera, or a batch of them."""

    def one_camera(views: Views, chosen: Options) -> Calibration:
        def fit(views: Views) -> Calibration:
            if isinstance(distortion, str) and distortion == "auto":
                return chosen_lens(views, target, chosen)
            return calibrated(views, target, distortion, chosen)

        return with_true_centres(fit, views, target)

    return one_camera
