"""Joining estimates by their covariances, and whether they agree.

Estimates y_c `(*B, C, m)` of the same m numbers, of which each source c knows some, with covariances C_c. What a source
does not know has a unit variance in C_c, and no information.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

CHANCE = 1e-3
"""How likely a disagreement may be by chance, over all sources, before it is one."""
KNOWN = 1e8
"""Residuals from which on the scale that they tell counts as known."""


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


class Sources(NamedTuple):
    """What C sources say of the same numbers.

    Attributes:
        y: their estimates `(*B, C, m)`.
        C: the covariances of these `(*B, C, m, m)`.
        information: their inverses, 0 in what a source does not know.
        both: what each source knows `(*B, C, m)`; an even count, for points on a plane come with two coordinates.
        estimated: the part of the covariances whose scale was estimated `(*B, C, m, m)`.
        freedom: from how many residuals it was `(*B, C)`.
    """

    y: Tensor
    C: Tensor
    information: Tensor
    both: Tensor
    estimated: Tensor
    freedom: Tensor


def chances(sources: Sources) -> Tensor:
    """The logarithm of how likely each source differs from all others as much as it does, by chance `(*B, C)`."""
    return torch.stack([_judged(sources, c)[0] for c in range(sources.y.shape[-2])], dim=-1)


@torch.no_grad()
def _judged(sources: Sources, c: int) -> tuple[Tensor, Tensor]:
    """Source c against the estimate of all others: the logarithm of the chance that it differs as much `(*B,)`.

    The scale of the difference is known the better, the smaller the part of it that was estimated (Welch 1947,
    Satterthwaite 1946), all of which counts as estimated from as few residuals as that of any source. A scale that was
    estimated too small makes its part look small: of cameras located by four landmarks 0.5 % are named by chance, and
    1.3 % where clicks are five times surer than the landmarks. To count less on it hid most that were ten deviations of
    a pixel off.

    Returns:
        That, and one for comparing sources with each other, as if all scales were known alike.
    """
    others = [k for k in range(sources.y.shape[-2]) if k != c]
    information = sources.information[..., others, :, :]
    estimate, covariance, known = joined(information, sources.y[..., others, :])
    common = known & sources.both[..., c, :]
    off = torch.where(common, sources.y[..., c, :] - estimate, 0.0)
    weight = torch.linalg.solve(without(sources.C[..., c, :, :] + covariance, common), off.unsqueeze(-1))
    chi2, count = (weight.squeeze(-1) * off).sum(-1), common.sum(-1)
    # The variance of `weight . off` is chi2, to which each source adds that of its own numbers.
    back = information @ (covariance @ weight).unsqueeze(-3)
    ours, theirs = _form(sources.estimated[..., c, :, :], weight), _form(sources.estimated[..., others, :, :], back)
    share = (ours + theirs.sum(-1)) / torch.where(chi2 > 0, chi2, 1.0)
    least = sources.freedom.amin(-1).clamp(min=1)
    return log_tail(chi2, count, least / share.square().clamp(min=1e-300)), log_tail(chi2, count, least)


def disagreeing(
    sources: Sources, seen_by: Callable[[Tensor], Sources] | None = None, chance: Tensor | None = None
) -> Tensor:
    """Which sources disagree `(*B, C)`: the worst one, then the worst of the rest, as long as the rest disagree.

    Args:
        sources: all of them.
        seen_by: the sources linearised at the estimate of some `(*B, C)`; as they are if left out. One that is far off
            draws the estimate to where the others seem to disagree as well.
        chance: their `chances`, where these are known already.
    """
    count = sources.y.shape[-2]
    limit, kept = math.log(CHANCE / count), torch.ones_like(sources.freedom, dtype=torch.bool)
    doubtful = ((chances(sources) if chance is None else chance) < limit).any(-1, keepdim=True)
    if not bool(doubtful.any()):
        return ~kept
    certain = torch.zeros_like(sources.freedom[..., 0])  # the chance 1 of a source that is out
    for _ in range(count - 1):
        found = []
        for c in range(count):
            if not bool(kept[..., c].any()):
                found.append((certain, certain))
                continue
            others = kept.clone()
            others[..., c] = False
            rest = sources if seen_by is None else seen_by(others)
            known = kept[..., None] & sources.both
            information = rest.information * kept[..., None, None].to(rest.y)
            found.append(_judged(rest._replace(information=information, both=known), c))
        chance, alike = (torch.where(kept, torch.stack(one, -1), 0.0) for one in zip(*found, strict=True))
        beyond = doubtful & (chance.amin(-1, keepdim=True) < limit)
        now = beyond & (alike == alike.amin(-1, keepdim=True)) & kept
        now = now | (_pairs(kept[..., None] & sources.both) & now.unsqueeze(-2)).any(-1)
        if not bool(now.any()):
            break
        kept = kept & ~now
    return ~kept


def _pairs(both: Tensor) -> Tensor:
    """Which two sources have numbers in common with each other alone `(*B, C, C)`: which one is wrong nothing tells."""
    share = (both.unsqueeze(-2) & both.unsqueeze(-3)).any(-1)
    share = share & ~torch.eye(both.shape[-2], dtype=torch.bool, device=both.device)
    alone = share.sum(-1) == 1
    return share & alone.unsqueeze(-1) & alone.unsqueeze(-2)


def growth(sources: Sources, disagrees: Tensor) -> Tensor:
    """Chi-square over its degrees of freedom `(*B,)` (Birge 1932): the largest one, at least 1.

    That of all numbers, and for each source that disagrees that of the numbers that it knows: many on which all agree
    would hide how far it is off.
    """
    found = [torch.ones_like(disagrees[..., 0], dtype=sources.y.dtype)]
    everything = torch.ones_like(sources.both[..., 0, :])
    for c, numbers in ((None, everything), *enumerate(sources.both.unbind(-2))):
        where = disagrees.any(-1) if c is None else disagrees[..., c]
        if not bool(where.any()):
            continue
        both = sources.both & numbers.unsqueeze(-2)
        information = inverse(without(sources.C, both))[0]
        information = torch.where(both.unsqueeze(-1) & both.unsqueeze(-2), information, 0.0)
        estimate, _, known = joined(information, sources.y)
        spare = both.sum((-1, -2)) - known.sum(-1)
        chi2 = chi_square(information, sources.y - estimate.unsqueeze(-2)).sum(-1)
        found.append(torch.where(where & (spare > 0), chi2 / spare.clamp(min=1), 1.0))
    return torch.stack(found).amax(0)


def log_tail(chi2: Tensor, count: Tensor, freedom: Tensor) -> Tensor:
    """The logarithm of the probability of more than that chi-square.

    Of an even `count` of numbers Fisher's F and chi-square have a finite sum, which no size of `chi2` underflows.

    Args:
        chi2: of the numbers, 0 or more.
        count: of the numbers.
        freedom: how many residuals tell their scale, infinite where it is known.
    """
    j = torch.arange(max(1, int(count.max()) // 2 if count.numel() else 1), dtype=chi2.dtype, device=chi2.device)
    chi2, a = chi2.clamp(min=1e-300), freedom.clamp(max=KNOWN) / 2
    beyond = torch.log1p(chi2 / (2 * a))
    factors = torch.lgamma(a.unsqueeze(-1) + j) - torch.lgamma(a).unsqueeze(-1)
    power = chi2.log() - (2 * a).log() - beyond
    known = freedom > KNOWN
    first = torch.where(known, -chi2 / 2, -a * beyond)
    terms = torch.where(
        known.unsqueeze(-1), j * (chi2 / 2).log().unsqueeze(-1), factors + j * power.unsqueeze(-1)
    ) - torch.lgamma(j + 1)
    terms = torch.where(2 * j < count.unsqueeze(-1), terms, -torch.inf)
    return torch.where(count > 0, first + terms.logsumexp(-1), 0.0).clamp(max=0)


def _form(matrix: Tensor, vector: Tensor) -> Tensor:
    """`v^T M v` of vectors `(..., m, 1)`."""
    return (vector * (matrix @ vector)).sum((-1, -2))
