"""Which corners a robust loss holds for wrong."""

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.trust.corner_scores import CornerScores
from diffproj.calibration.trust.noisy_views import noise_factor

HALF = 0.5
"""Weight below which a corner may be one of them."""
WRONG = 4.0
"""Deviations of the noise from which on it is: normal noise puts one of 3000 corners as far off."""
HARDLY = 0.25
"""Weight of most corners of a view below which a redescending loss is too narrow for it: that of Cauchy's loss, where
the noise is 1.5 times its scale."""
FALLING = -1e-3
"""Slope of a score along the residual by which a loss redescends."""


def discounted(found: Fit) -> Tensor | None:
    """Those of the used corners `(P, V, N)`; `None` without a loss, or where it does not judge pixels.

    Which these are `held_for_wrong` says.
    """
    if found.task.loss is None or found.task.objective != "image":
        return None
    with torch.no_grad():
        corners, used = CornerScores(found), found.task.used
        far = beyond_noise(found, corners) > WRONG**2
        return held_for_wrong(used, far, corners.slope, corners.slope + 2 * corners.bend * corners.squared)


def held_for_wrong(used: Tensor, far: Tensor, weight: Tensor, along: Tensor) -> Tensor:
    """Which of the corners of each view a loss holds for wrong `(*B, V, N)`.

    They count less than half, and are further off than noise puts one. Where a redescending loss is too narrow for a
    view, these are all that count less than half: such a fit has many minima, each at the corners that happen to agree.

    Args:
        used: the corners that count `(*B, V, N)`.
        far: those that are further off than noise puts one.
        weight: what the loss lets each count for, 1 at most.
        along: the slope of the score along the residual.
    """
    hardly = ((weight < HARDLY) & used).sum(-1) > used.sum(-1) / 2
    narrow = hardly & ((along < FALLING) & used).any(-1)
    return used & (weight < HALF) & (far | narrow.unsqueeze(-1))


def beyond_noise(found: Fit, corners: CornerScores) -> Tensor:
    """The squares of residuals `(P, V, N)` over the variance of the noise: that of all, or of their view if larger."""
    noise = corners.moments(corners.counted, found.degrees_of_freedom()).noise
    of_view = (noise.unsqueeze(-1) * noise_factor(found, noise)).unsqueeze(-1)
    squares = corners.weight * corners.squared
    return torch.where(of_view > 0, squares / of_view, torch.where(squares > 0, torch.inf, 0.0))
