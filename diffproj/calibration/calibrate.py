"""`calibrate`: a camera from nothing but the corners of a target in photographs of known size.

A start in closed form is refined by the solver. It works for one camera, views `(V, N, 2)`, or for many side by side,
`(*B, V, N, 2)`, each with its own damping and its own end, and computes in float64.
"""

from typing import Literal, Unpack

from diffproj.calibration.circle_centres import with_true_centres
from diffproj.calibration.lens_choice import chosen_lens
from diffproj.calibration.one_lens import calibrated
from diffproj.calibration.options import CalibrationOptions, calibration_options
from diffproj.calibration.result import Calibration
from diffproj.lens.models import LensModel
from diffproj.targets.target import Target
from diffproj.targets.views import Views, as_views


def calibrate(
    views: Views,
    target: Target,
    distortion: LensModel | Literal["auto"] = "brown5",
    **options: Unpack[CalibrationOptions],
) -> Calibration:
    """Find intrinsics, lens and one pose per view that minimise the error of the corners.

    Args:
        views: corners `(*B, V, N, 2)` seen in photographs of known size. Views may miss any corners; one with fewer
            than 4 takes no part. Views that show the board alike count as one, and at least two must differ, unless
            `fixed` or `priors` hold the principal point and the lens.
        target: a board such as `Chessboard`, `Landmarks`, or anything with `.points (N, 3)`; its unit is the world's.
            Of a `CircleGrid`, `Calibration.views` holds where the centres are seen, not their images' middles.
        distortion: which lens to fit: `"none"`, `"brown4"`, `"brown5"`, `"brown8"`, `"brown12"`, `"brown14"` or
            `"fisheye"`. Or `"auto"`, for one camera: all of them but the longest are fitted side by side and compared
            by their errors on corners held out; the simplest that is no worse than the best, as far as the views can
            tell, is returned, and `Calibration.comparison` says how they fared.
        options: `objective`, `bow`, `skew`, `fixed`, `tied_focal`, `priors`, `weights`, `pixel_sigma`, `loss`,
            `reject_outliers`, `max_iterations`, `tolerance`, `progress` and `throw`: see `CalibrationOptions`.

    Returns:
        The calibration, in float64.

    Raises:
        TypeError: views are no `dp.Views`, or an option is unknown or of another type.
        ValueError: views, target and options do not fit together; or `"auto"` for many cameras, or with a held lens.
        CalibrationError: a camera did not converge, or its views do not determine it.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> print(f"{calibration.rms:.3f}", [round(f) for f in calibration.camera.K.diagonal()[:2].tolist()])
        0.158 [534, 534]
    """
    chosen = calibration_options("calibrate", options)
    as_views(views)

    def fit(views: Views) -> Calibration:
        if isinstance(distortion, str) and distortion == "auto":
            return chosen_lens(views, target, chosen)
        return calibrated(views, target, distortion, chosen)

    return with_true_centres(fit, views, target)
