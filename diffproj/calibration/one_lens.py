"""A calibration with one lens: a start in closed form, refined, looked at twice, kept from folding, points freed."""

import torch

from diffproj.calibration import start
from diffproj.calibration.data import Data
from diffproj.calibration.free_points import with_free_points
from diffproj.calibration.options import Options
from diffproj.calibration.outcome import minimised, outcome
from diffproj.calibration.parametrisation import Parametrisation
from diffproj.calibration.restraint import restrained
from diffproj.calibration.result import Calibration
from diffproj.calibration.second_look import second_look
from diffproj.lens.models import LensModel, model_named
from diffproj.targets.target import Target
from diffproj.targets.views import Views


def calibrated(
    views: Views, target: Target, distortion: LensModel, chosen: Options, who: str = "calibrate"
) -> Calibration:
    """What `calibrate` promises, for one lens and checked options; errors name `who` was asked."""
    model = model_named(distortion)
    data = Data(views, target, chosen.weights)
    if views.size is None:
        raise ValueError("views: want the photographs' size, got None; give Views(..., size=(width, height))")
    parameters = Parametrisation(distortion, chosen.bow, chosen.skew)
    shared, local, straight = start.from_nothing(data, views.size, chosen.tied_focal, parameters)
    # The start is a guess from the corners; what is held, or known, is not.
    reference = shared.clone()
    reference[:, :2], reference[:, 4:] = torch.nan, 0.0
    near = None
    if model.count > 5:
        # The rational terms nearly cancel each other: from far off they lead into side valleys.
        early = chosen.but(
            fixed=(*chosen.fixed, *model.coefficient_names[5:]),
            objective="image",
            reject_outliers=False,
            loss=None if chosen.objective == "plane" else chosen.loss,  # its scale is in world units
        )
        poorer, _ = minimised(data, early, parameters, shared, local, reference)
        shared, local = near = poorer.solution.shared, poorer.solution.local
    found, prior = minimised(data, chosen, parameters, shared, local, reference)
    limits = {"max_iterations": chosen.max_iterations, "tolerance": chosen.tolerance}
    found = second_look(found, straight, reject=chosen.outlier_limit, **limits)
    if near is not None:
        found = restrained(found, *near, views.size, reject=chosen.outlier_limit, **limits)
    found, _ = with_free_points(found, data, chosen, prior)
    return outcome(who, data, found, views.size, chosen.throw)
