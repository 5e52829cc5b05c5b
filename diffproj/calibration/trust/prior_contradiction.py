"""Whether the views contradict what was said of the camera beforehand.

A wrong prior, as of another camera or another image size, is met by the fit as far as it says to be sure, and bends
everything else: the residuals then look like those of another lens. With the poses eliminated the cost is nearly a
bowl, whose lowest place is what the views tell by themselves, and how surely. A prior mean that is further from that
than both deviations explain is wrong, or the lens model is.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.bowls import bowls
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.trust.dispersion import dispersion

DEVIATIONS = 6.0
"""Deviations from which on it is no chance. (They are those of a bowl, and the noise is estimated.)"""
NEARLY_NONE = 1e-8
"""Part of the priors' precision that stays, so that what the views do not tell stays near, and unknown."""
LEAST = 0.02
"""Part of the sum of squares that the bowl leaves at least: far from its lowest place it is only nearly one."""


class PriorContradiction(NamedTuple):
    """What the views of one camera say of the parameter that contradicts its prior most.

    Attributes:
        name: of the parameter.
        told: what the views tell by themselves.
        deviation: how surely.
        said: the prior's mean.
        sure: its deviation.
        far: how far apart these are, in deviations.
        saved: the part of the residuals' sum of squares that goes away without the priors.
    """

    name: str
    told: float
    deviation: float
    said: float
    sure: float
    far: float
    saved: float


def prior_contradictions(found: Fit, which: Tensor) -> dict[int, PriorContradiction]:
    """Those of cameras `(n,)` whose views contradict a prior, by their number."""
    measured = found.measured_precision()
    if measured is None or found.task.objective != "image" or found.task.free or len(which) == 0:
        return {}  # free points take up what a wrong prior bends
    with torch.no_grad():
        part, names = found.part(which), found.task.parameters.few_names
        prior, shared = part.task.prior, part.solution.shared
        known = measured[which]
        seen = bowls(part.task, shared, part.solution.local)
        T = part.task.basis
        T = torch.eye(shared.shape[-1], dtype=shared.dtype, device=shared.device).expand_as(known) if T is None else T
        # All but the priors stays: what keeps a lens from folding.
        rest = prior.whole - known + NEARLY_NONE * known  # type: ignore[union-attr]
        off = (shared - prior.mean).unsqueeze(-1)  # type: ignore[union-attr]
        H = seen.H.sum(1) + T.mT @ rest @ T
        g = seen.g.sum(1).unsqueeze(-1) + T.mT @ rest @ off
        scale = H.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt().unsqueeze(-1)
        inverse = torch.linalg.pinv((H * scale * scale.mT).nan_to_num(0.0, 0.0, 0.0), hermitian=True) * scale * scale.mT
        told = shared + (T @ (-inverse @ g)).squeeze(-1)
        before = seen.c.sum(-1)
        saved = ((g.mT @ inverse @ g).flatten() / 2 / before.clamp(min=1e-300)).clamp(0, 1 - LEAST)
        freedom = part.degrees_of_freedom().clamp(min=1)
        variance = 2 * before * (1 - saved) / freedom
        variance = variance.clamp(min=1.0) if found.knows_noise else variance
        # Views that a wrong prior bends contradict each other by that, too: without it they would less.
        phi = (dispersion(part) * (1 - saved)).clamp(min=1)
        spread = (variance * phi).unsqueeze(-1) * (T @ inverse @ T.mT).diagonal(dim1=-2, dim2=-1)
        precision = known.diagonal(dim1=-2, dim2=-1)
        said = precision > 0
        sure = torch.where(said, precision, 1.0).rsqrt()
        far = (told - prior.mean).abs() / (spread.clamp(min=0) + sure.square()).sqrt()  # type: ignore[union-attr]
        far = torch.where(said, far, 0.0)[:, : len(names)].nan_to_num(0.0)
    contradictions = {}
    for i in (far > DEVIATIONS).any(-1).nonzero().flatten().tolist():
        k = int(far[i].argmax())
        numbers = (told[i, k], spread[i, k].sqrt(), prior.mean[i, k], sure[i, k], far[i, k], saved[i])  # type: ignore[union-attr]
        contradictions[int(which[i])] = PriorContradiction(names[k], *(float(number) for number in numbers))
    return contradictions
