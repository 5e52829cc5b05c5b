"""Which corners of a rig a robust loss holds for wrong: as `trust/discounted.py`, by the noise of each camera."""

import torch
from torch import Tensor

from diffproj.calibration.least_squares.losses import slope_and_bend
from diffproj.calibration.rigs.fit import RigFit
from diffproj.calibration.rigs.uncertainty import CameraNoise, noisy_moments
from diffproj.calibration.trust.discounted import WRONG, held_for_wrong


@torch.no_grad()
def discounted(found: RigFit, noise: CameraNoise) -> dict[str, Tensor] | None:
    """Those of the used corners of each camera `(V_c, N)`; `None` without a loss."""
    if found.loss is None:
        return None
    views, wrong = found.views, {}
    variance = (noise.variance / noise.bend.square()).unsqueeze(-1) * noisy_moments(found, noise)
    for c, (name, residual) in enumerate(found.by_camera.items()):
        used, squared, weights = found.used[name], residual.square().sum(-1), views.data[name].weights
        slope, bend = slope_and_bend(found.loss, squared)
        of_view = variance[c, views.where[name]].unsqueeze(-1)
        squares = squared if weights is None else weights[0] * squared
        far = torch.where(of_view > 0, squares > WRONG**2 * of_view, squares > 0)
        wrong[name] = held_for_wrong(used, far, slope, slope + 2 * bend * squared)
    return wrong
