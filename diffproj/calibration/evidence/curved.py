"""How much further than to first order a weakly known camera may be off: along the curve that the evidence leaves open.

Where a camera is known to a few hundredths only, in natural units, as a focal length from four landmarks, the evidence
is not straight within its deviations: slopes at the minimum tell too little of one side. So in the direction that is
known worst, of those that evidence tells anything of, the minimum is followed, with that direction held and all else
free, to where it costs as much as two deviations should (the profile likelihood).
"""

import torch
from torch import Tensor

from diffproj.calibration.evidence.descent import Found, Task, profile

WEAK = 0.02
"""Deviation in units of `decisive` up to which evidence is straight enough."""
TOLD = 1e-6
"""Part that the evidence has in what is known of a direction, beside priors, from which on it tells anything of it."""
REACH = 2.0
"""Deviations after which the cost is looked at: it is the square of this over 2 where the evidence is straight."""
TIMES = (1.0, 1.5, 2.25, 3.5, 5.0)
"""The same at so many times of them; beyond the last nothing is looked at."""


@torch.no_grad()
def further(task: Task, found: Found, C: Tensor, unit: Tensor, told: Tensor, precision: Tensor) -> Tensor:
    """How far the parameters may lie beyond their covariance, as one more error of deviation 1 `(P, q)`.

    Args:
        task: of the adjustment.
        found: where it ended.
        C: the covariance of the unknowns `(P, r, r)`, to first order.
        unit: of the unknowns `(P, r)`: see `decisive`.
        told: what the evidence tells of them, its normal matrix `(P, r, r)`.
        precision: what priors do `(P, r, r)`.
    """
    none = torch.zeros_like(found.values)
    if C.shape[-1] == 0 or not task.pieces:
        return none
    variances, vectors = torch.linalg.eigh(C / unit.unsqueeze(-1) / unit.unsqueeze(-2))
    steps = unit.unsqueeze(-1) * vectors
    tells, known = ((steps * (part @ steps)).sum(-2) for part in (told, precision))
    # What priors alone tell is straight, and would hide what else is known badly.
    variances = torch.where(tells > TOLD * known, variances, 0.0)
    order = variances.argsort(-1)
    variances = variances.gather(-1, order)
    vectors = vectors.gather(-1, order.unsqueeze(-2).expand_as(vectors))
    spread = variances[:, -1].clamp(min=0).sqrt()
    if not bool((spread > WEAK).any()):
        return none
    axes = found.basis @ (unit.unsqueeze(-1) * vectors)
    step = axes[..., -1] * spread.unsqueeze(-1)
    factor = torch.ones_like(spread)
    for side in (-1, 1):
        far = torch.tensor(TIMES, dtype=step.dtype, device=step.device)
        starts = found.values + side * REACH * far[:, None, None] * step
        cost = profile(task, found, starts, axes[..., :-1]) - found.cost
        factor = factor.maximum(_where_it_costs(far, cost.clamp(min=0).sqrt(), REACH / 2**0.5))
    more = (factor.square() - 1).sqrt()
    return torch.where((spread > WEAK).unsqueeze(-1), more.unsqueeze(-1) * step, none)


def _where_it_costs(times: Tensor, root: Tensor, want: float) -> Tensor:
    """Where the root of the cost `(K, P)` at these times `(K,)` first is so much, `(P,)`; between them on a line."""
    found = torch.full_like(root[0], float(times[-1]))
    for k in range(len(times) - 1, -1, -1):
        before, at = (root[k - 1], float(times[k - 1])) if k else (torch.zeros_like(root[0]), 0.0)
        share = ((want - before) / (root[k] - before).clamp(min=1e-9)).clamp(0, 1)
        found = torch.where(root[k] >= want, at + share * (float(times[k]) - at), found)
    return found
