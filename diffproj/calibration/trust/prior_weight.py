"""Whether priors would say something else if they weighed against the noise that the residuals tell.

Without `pixel_sigma` or `weights` a prior weighs against corners that are known to 1 px. If they are known to 0.2 px,
they count 25 times too little beside it. With x the minimum, m the prior's mean, Q its precision and S the normal
equations, all along the free parameters and with the poses eliminated, one Gauss-Newton step to the minimum of

    sum |e|^2 / (2 s^2) + (x - m)^T Q (x - m) / 2

tells where it would be with the noise's variance s^2 in the place of 1, and how well known.
"""

from typing import NamedTuple

import torch

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.least_squares.eliminated import inverse, reduced
from diffproj.calibration.trust.adequacy import EXACT_PX

NOTABLE = 0.5
"""Deviations by which a parameter must be elsewhere for a word."""


class Elsewhere(NamedTuple):
    """Where a parameter of one camera would be.

    Attributes:
        name: of that which would move most, in deviations.
        here: its value.
        there: what it would be.
        sigma: the noise of a corner's coordinate in pixels.
    """

    name: str
    here: float
    there: float
    sigma: float


def weighed_anew(found: Fit) -> dict[int, Elsewhere]:
    """The parameter that would move most, by the number of the camera, where it would by more than a little."""
    task, Q = found.task, found.measured_precision()
    if task.prior is None or Q is None or task.weights is not None or task.objective != "image":
        return {}
    shared = found.solution.shared.detach()
    sigma = found.pixel_sigma().detach()
    variance = sigma.square()[:, None, None]
    more = (variance - 1) * Q
    pull = more @ (shared - task.prior.mean).unsqueeze(-1)
    size = (found.solution.equations.U + more).diagonal(dim1=-2, dim2=-1)
    T = torch.eye(shared.shape[-1], dtype=shared.dtype, device=shared.device) if task.basis is None else task.basis
    S = reduced(found.solution.equations, task.basis, task.shares)[0] + T.mT @ more @ T
    known, unknown = inverse(S, (T.square() * size.unsqueeze(-1)).sum(-2))
    step = -(T @ known @ T.mT @ pull).squeeze(-1)
    deviations = (variance * (T @ known @ T.mT)).diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    off = torch.where(deviations > 0, step.abs() / deviations, 0.0).nan_to_num(0.0)
    off = torch.where((sigma > EXACT_PX) & ~unknown.any(-1), off.mT, 0.0).mT
    told = {}
    for p in (off.amax(-1) > NOTABLE).nonzero().flatten().tolist():
        k = int(off[p].argmax())
        here, move = float(shared[p, k]), float(step[p, k])
        told[p] = Elsewhere(task.names[k], here, here + move, float(sigma[p]))
    return told
