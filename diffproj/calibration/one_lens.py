"""A calibration with one lens: a start in closed form, refined, looked at twice, and kept from folding."""

import torch

from diffproj.calibration import start
from diffproj.calibration.data import Data
from diffproj.calibration.nested import Nested
from diffproj.calibration.options import Options
from diffproj.calibration.outcome import outcome
from diffproj.calibration.parametrisation import Parametrisation
from diffproj.calibration.result import Calibration
from diffproj.lens.models import LensModel, model_named
from diffproj.targets.target import Target
from diffproj.targets.views import Views


def calibrated(
    views: Views, target: Target, distortion: LensModel, chosen: Options, who: str = "calibrate"
) -> Calibration:
    """What `calibrate` promises, for one lens and checked options; errors name `who` was asked."""
    model_named(distortion)
    data = Data(views, target, chosen.weights)
    if views.size is None:
        raise ValueError("views: want the photographs' size, got None; give Views(..., size=(width, height))")
    parameters = Parametrisation(distortion, chosen.bow, chosen.skew)
    shared, local, straight = start.from_nothing(data, views.size, chosen.tied_focal, parameters)
    # The start is a guess from the corners; what is held, or known, is not.
    reference = shared.clone()
    reference[:, :2], reference[:, 4:] = torch.nan, 0.0
    found = Nested(data, chosen, parameters, shared, local, reference, straight, views.size).richest()
    return outcome(who, data, found, views.size, chosen.throw)
