"""`calibrate`: a camera from nothing but the corners of a target in photographs of known size.

A start in closed form is refined by the solver. It works for one camera, views `(V, N, 2)`, or for many side by side,
`(*B, V, N, 2)`, each with its own damping and its own end, and computes in float64.
"""

from typing import Unpack

import torch

from diffproj.calibration import start
from diffproj.calibration.data import Data
from diffproj.calibration.options import CalibrationOptions, calibration_options
from diffproj.calibration.outcome import minimised, outcome
from diffproj.calibration.result import Calibration
from diffproj.calibration.second_look import second_look
from diffproj.lens.models import LensModel, model_named
from diffproj.targets.target import Target
from diffproj.targets.views import Views


def calibrate(
    views: Views, target: Target, distortion: LensModel = "brown5", **options: Unpack[CalibrationOptions]
) -> Calibration:
    """Find intrinsics, lens and one pose per view that minimise the error of the corners.

    Args:
        views: corners `(*B, V, N, 2)` seen in photographs of known size. Views may miss any corners; one with fewer
            than 4 takes no part. Views that show the board alike count as one, and at least two must differ, unless
            `fixed` or `priors` hold the principal point and the lens.
        target: anything with `.points (N, 3)` on z = 0, such as `Chessboard`; its unit is the world's.
        distortion: which lens to fit: `"none"`, `"brown4"`, `"brown5"`, `"brown8"`, `"brown12"`, `"brown14"` or
            `"fisheye"`.
        options: `objective`, `bow`, `fixed`, `tied_focal`, `priors`, `weights`, `loss`, `reject_outliers`,
            `max_iterations`, `tolerance`, `progress` and `throw`: see `CalibrationOptions`.

    Returns:
        The calibration, in float64.

    Raises:
        TypeError: views are no `dp.Views`, or an option is unknown or of another type.
        ValueError: views, target and options do not fit together.
        CalibrationError: a camera did not converge, or its views do not determine it.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> print(f"{calibration.rms:.3f}", [round(f) for f in calibration.camera.K.diagonal()[:2].tolist()])
        0.177 [533, 533]
    """
    model = model_named(distortion)
    chosen = calibration_options("calibrate", options)
    data = Data(views, target, chosen.weights)
    if views.size is None:
        raise ValueError("views: want the photographs' size, got None; give Views(..., size=(width, height))")
    shared, local, straight = start.from_nothing(data, distortion, views.size, chosen.tied_focal, chosen.bow)
    # The start is a guess from the corners; what is held, or known, is not.
    reference = shared.clone()
    reference[:, :2], reference[:, 4:] = torch.nan, 0.0
    if model.count > 5:
        # The rational terms nearly cancel each other: from far off they lead into side valleys.
        early = chosen.but(
            fixed=(*chosen.fixed, *model.coefficient_names[5:]),
            objective="image",
            reject_outliers=False,
            loss=None if chosen.objective == "plane" else chosen.loss,  # its scale is in world units
        )
        near, _ = minimised(data, early, distortion, shared, local, reference)
        shared, local = near.solution.shared, near.solution.local
    found, _ = minimised(data, chosen, distortion, shared, local, reference)
    limits = {"max_iterations": chosen.max_iterations, "tolerance": chosen.tolerance}
    found = second_look(found, straight, reject=chosen.outlier_limit, **limits)
    return outcome("calibrate", data, found, views.size, chosen.throw)
