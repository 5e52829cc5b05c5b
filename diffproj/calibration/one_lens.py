"""A calibration with one lens: a start in closed form, refined, looked at twice, and kept from folding."""

import torch
from torch import Tensor

from diffproj.calibration import start
from diffproj.calibration.data import Data
from diffproj.calibration.fit import Fit
from diffproj.calibration.options import Options
from diffproj.calibration.outcome import minimised, outcome
from diffproj.calibration.own_frame import are_solid
from diffproj.calibration.parametrisation import Parametrisation, Pose
from diffproj.calibration.restraint import restrained
from diffproj.calibration.result import Calibration
from diffproj.calibration.second_look import lower_fit, second_look
from diffproj.calibration.space_start import space_starts
from diffproj.calibration.start import Straightened
from diffproj.lens.models import LensModel, model_named
from diffproj.targets.target import Target
from diffproj.targets.views import Views


def calibrated(
    views: Views, target: Target, distortion: LensModel, chosen: Options, who: str = "calibrate"
) -> Calibration:
    """What `calibrate` promises, for one lens and checked options; errors name `who` was asked."""
    model_named(distortion)
    data = Data(views, target, chosen.weights, chosen.pixel_sigma)
    data.check_options(chosen.objective, chosen.bow)
    if views.size is None:
        raise ValueError("views: want the photographs' size, got None; give Views(..., size=(width, height))")
    parameters = Parametrisation(distortion, chosen.bow, chosen.skew)
    if are_solid(data.points):
        starts, straight = space_starts(data, views.size, parameters)
    else:
        first, pose, straight = start.from_nothing(data, views.size, chosen.tied_focal, parameters)
        starts = [(first, pose)]
    found = _from_start(data, chosen, parameters, starts[0], straight)
    every = torch.arange(len(data.pixels), device=data.pixels.device)
    for other in starts[1:]:
        found = lower_fit(found, _from_start(data, chosen, parameters, other, straight), every, chosen.outlier_limit)
    return outcome(who, data, found, views.size, chosen.throw)


def _from_start(
    data: Data, chosen: Options, parameters: Parametrisation, begin: tuple[Tensor, Pose], straight: Straightened
) -> Fit:
    """The minimum from a start, looked at twice, and kept from folding."""
    shared, local = begin
    # The start is a guess from the corners; what is held, or known, is not.
    reference = shared.clone()
    reference[:, :2], reference[:, 4:] = torch.nan, 0.0
    near, model = None, model_named(parameters.lens)
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
    found, _ = minimised(data, chosen, parameters, shared, local, reference)
    limits = {"max_iterations": chosen.max_iterations, "tolerance": chosen.tolerance}
    if not found.task.solid:  # a plane's focal length and tilt go together; points in space have had other starts
        found = second_look(found, straight, reject=chosen.outlier_limit, **limits)
    if near is not None:
        found = restrained(found, *near, straight.size, reject=chosen.outlier_limit, **limits)
    return found
