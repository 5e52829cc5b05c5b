"""The noise of corners: what the residuals of a fit tell of it, together with what a calibration before told."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.trust.discounted import discounted

CONTRADICTION = 0.01
"""Chance of residuals as large as the fit's under the noise that was known, below which that does not hold here."""
KNOWN = 1e9
"""Degrees of freedom that stand for a noise that is known."""


class Noise(NamedTuple):
    """The noise of corners, as residuals told it.

    Attributes:
        variance: of a coordinate in squared pixels `(P,)`; NaN where it is not known.
        freedom: how many degrees of freedom that is from `(P,)`.
    """

    variance: Tensor
    freedom: Tensor


def noise_of(calibration: Calibration, batch: Sequence[int]) -> Noise | None:
    """That in a calibration, for each of the cameras `*B` that are located with it, flattened; `None` if unknown."""
    if calibration.pixel_sigma is None or calibration.degrees_of_freedom is None:
        return None
    sigma, freedom = calibration.pixel_sigma.detach(), calibration.degrees_of_freedom
    return Noise(
        *(z.to(torch.float64).expand(tuple(batch)).reshape(-1) for z in (sigma.square(), freedom.clamp(1, KNOWN)))
    )


def level(found: Fit, known: Noise | None = None) -> Noise:
    """That of a corner's coordinate, with the degrees of freedom that the scale of all error bars has.

    Together with what was known, unless weights say what the noise is.
    """
    sigma, freedom = found.pixel_sigma(), found.degrees_of_freedom()
    own = Noise(sigma.square(), freedom.to(sigma))
    if found.knows_noise:
        return Noise(own.variance, torch.full_like(own.freedom, torch.inf))
    wrong = discounted(found)
    if wrong is not None:  # what the loss holds for wrong tells of the noise no more than what was rejected
        each = wrong.sum(-1) if found.task.shares is None else wrong.sum(-1) * found.task.shares
        own = own._replace(freedom=torch.minimum(own.freedom, (own.freedom - 2 * each.sum(-1)).clamp(min=1)))
    return with_known(own, known, found)


def with_known(own: Noise, known: Noise | None, found: Fit) -> Noise:
    """The noise of a fit together with what was known before, where that is in the same unit."""
    return own if known is None or found.task.weights is not None else pooled(own, known)


def own_noise(found: Fit) -> Noise:
    """That of the residuals alone; variance 0 and one degree of freedom where there is none."""
    variance = found.residual_variance().detach()
    freedom = found.degrees_of_freedom().clamp(min=1).to(variance)
    freedom = torch.full_like(freedom, KNOWN) if found.knows_noise else freedom
    return Noise(torch.where(variance.isfinite(), variance, 0.0), freedom)


def pooled(own: Noise, known: Noise) -> Noise:
    """Both together, each by its degrees of freedom; the fit's own where they contradict what was known."""
    squares = own.variance.nan_to_num(0.0) * own.freedom
    usual = known.variance > 0
    chance = torch.special.gammaincc(
        own.freedom.clamp(min=1) / 2, squares / (2 * torch.where(usual, known.variance, 1.0))
    )
    usual = usual & (chance > CONTRADICTION)
    both = torch.where(usual, own.freedom + known.freedom, own.freedom)
    return Noise(torch.where(usual, squares + known.variance * known.freedom, squares) / both, both)


def times_less_likely(more: Tensor, noise: Noise) -> Tensor:
    """How many times less likely what costs so much more is; by Student's distribution, for the noise is estimated."""
    excess = 2 * more.clamp(min=0) / (noise.variance * noise.freedom)
    return (noise.freedom / 2 * excess.log1p()).exp()
