"""A calibration with one lens: a start in closed form, refined, looked at twice, kept from folding, points freed."""

from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting import start
from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.free_points import with_free_points
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.own_frame import are_solid
from diffproj.calibration.fitting.second_look import lower_fit
from diffproj.calibration.fitting.space_start import space_starts
from diffproj.calibration.fitting.start import Straightened
from diffproj.calibration.nested.restraint import unfolded
from diffproj.calibration.nested.richest import Nested
from diffproj.calibration.outcome import outcome
from diffproj.calibration.problem.parametrisation import Parametrisation, Pose
from diffproj.calibration.results.calibration import Calibration
from diffproj.lens.models import LensModel, model_named
from diffproj.targets.target import Target
from diffproj.targets.views import Views


def calibrated(
    views: Views, target: Target, distortion: LensModel, chosen: Options, who: str = "calibrate"
) -> Calibration:
    """What `calibrate` promises, for one lens and checked options; errors name `who` was asked."""
    data, found = fitted(views, target, distortion, chosen)
    return outcome(who, data, found, views.size, chosen.throw)


def fitted(views: Views, target: Target, distortion: LensModel, chosen: Options) -> tuple[Data, Fit]:
    """The minimum alone, with what it is of; nothing is said of it yet."""
    model_named(distortion)
    data = Data(views, target, chosen.weights, chosen.pixel_sigma)
    data.check_options(chosen.objective, chosen.shape, (*chosen.fixed, *(chosen.priors or ())))
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
    flat = found
    found, _ = with_free_points(flat, data, chosen, None)
    if found is not flat:
        limits: dict[str, Any] = {name: getattr(chosen, name) for name in ("max_iterations", "tolerance")}
        found = unfolded(found, flat, views.size, reject=chosen.outlier_limit, **limits)
    return data, found


def _from_start(
    data: Data, chosen: Options, parameters: Parametrisation, begin: tuple[Tensor, Pose], straight: Straightened
) -> Fit:
    """The minimum from a start."""
    shared, local = begin
    # The start is a guess from the corners; what is held, or known, is not.
    reference = shared.clone()
    reference[:, :2], reference[:, 4:] = torch.nan, 0.0
    return Nested(data, chosen, parameters, shared, local, reference, straight, straight.size).richest()
