"""Joining estimates by their covariances, and whether they agree.

Estimates y_c `(*B, C, m)` of the same m numbers, of which each source c knows some, with covariances C_c. What a source
does not know has a unit variance in C_c, and no information.
"""

import math

import torch
from torch import Tensor

CHANCE = 1e-3
"""How likely a disagreement may be by chance, over all sources, before it is one."""


def without(C: Tensor, known: Tensor) -> Tensor:
    """A covariance with unit variances, and no covariances, in the places of what is not known."""
    kept = torch.where(known.unsqueeze(-1) & known.unsqueeze(-2), C, 0.0)
    return kept + torch.diag_embed(torch.where(known, 0.0, 1.0).to(kept))


def inverse(C: Tensor) -> tuple[Tensor, Tensor]:
    """The inverses of covariances `(*B, C, m, m)`, and which sources `(*B, C)` have one."""
    scale = C.diagonal(dim1=-2, dim2=-1).sqrt()
    exact = (scale.detach() == 0).any(-1)
    unit = torch.where(scale > 0, scale, 1.0)
    factor, failed = torch.linalg.cholesky_ex(C / unit.unsqueeze(-1) / unit.unsqueeze(-2))
    sound = ~exact & (failed == 0)
    factor = torch.where(sound[..., None, None], factor, torch.eye(C.shape[-1], dtype=C.dtype, device=C.device))
    found = torch.cholesky_inverse(factor) / unit.unsqueeze(-1) / unit.unsqueeze(-2)
    return found, sound


def joined(information: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The best estimate `(*B, m)`, its covariance, and which numbers anybody knows.

    Args:
        information: the inverse covariance of each source `(*B, C, m, m)`, 0 in what it does not know.
        y: their estimates `(*B, C, m)`.
    """
    total = information.sum(-3)
    known = total.diagonal(dim1=-2, dim2=-1) > 0
    total = without(total, known)
    scale = total.diagonal(dim1=-2, dim2=-1).sqrt()
    unit = torch.linalg.inv(total / scale.unsqueeze(-1) / scale.unsqueeze(-2))
    covariance = unit / scale.unsqueeze(-1) / scale.unsqueeze(-2)
    estimate = (covariance @ (information @ y.unsqueeze(-1)).sum(-3)).squeeze(-1)
    return estimate, (covariance + covariance.mT) / 2, known


def chi_square(information: Tensor, difference: Tensor) -> Tensor:
    """`d^T C^-1 d` of each source's difference d `(*B, C, m)`."""
    return ((information @ difference.unsqueeze(-1)).squeeze(-1) * difference).sum(-1)


@torch.no_grad()
def chances(information: Tensor, y: Tensor, C: Tensor, both: Tensor, freedom: Tensor) -> Tensor:
    """How likely each source differs from the estimate of all others as much as it does, by chance `(*B, C)`.

    Args:
        information: as `joined` takes it.
        y: too.
        C: the covariances `(*B, C, m, m)`.
        both: what each source knows `(*B, C, m)`.
        freedom: how many residuals tell the scale of its covariance `(*B, C)`.
    """
    found = []
    for c in range(y.shape[-2]):
        others = [k for k in range(y.shape[-2]) if k != c]
        estimate, covariance, known = joined(information[..., others, :, :], y[..., others, :])
        common = known & both[..., c, :]
        off = torch.where(common, y[..., c, :] - estimate, 0.0)
        S = without(C[..., c, :, :] + covariance, common)
        chi2 = (torch.linalg.solve(S, off.unsqueeze(-1)).squeeze(-1) * off).sum(-1)
        found.append(_tail(chi2, common.sum(-1), freedom.amin(-1)))
    return torch.stack(found, dim=-1)


def disagreeing(information: Tensor, y: Tensor, C: Tensor, both: Tensor, freedom: Tensor) -> Tensor:
    """Which sources disagree `(*B, C)`: the worst one, then the worst of the rest, as long as the rest disagree."""
    sources = y.shape[-2]
    kept = torch.ones(*y.shape[:-2], sources, dtype=torch.bool, device=y.device)
    for _ in range(sources - 1):
        mask = kept[..., None] & both
        chance = chances(information * kept[..., None, None].to(y), y, C, mask, freedom)
        chance = torch.where(kept, chance, 1.0)
        worst = chance.amin(-1, keepdim=True)
        beyond = worst < CHANCE / sources
        pair = kept.sum(-1, keepdim=True) == 2  # nothing tells which of two it is
        now = beyond & torch.where(pair, kept, chance == worst) & kept
        if not bool(now.any()):
            break
        kept = kept & ~now
    return ~kept


def _tail(chi2: Tensor, count: Tensor, freedom: Tensor) -> Tensor:
    """The probability of more than that chi-square, of `count` numbers whose scale is known to `freedom` residuals.

    By Paulson's approximation of F's distribution, the cube root of which is nearly normal (1942).
    """
    n = count.clamp(min=1).to(chi2)
    F = (chi2 / n).clamp(min=0)
    ours, theirs = 2 / (9 * n), 2 / (9 * freedom.clamp(min=1))
    z = ((1 - theirs) * F ** (1 / 3) - (1 - ours)) / (theirs * F ** (2 / 3) + ours).sqrt()
    return torch.where(count > 0, 0.5 * torch.erfc(z / math.sqrt(2)), 1.0)
