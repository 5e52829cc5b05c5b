"""Whether the views fall into two groups that want different cameras.

Photographs of two cameras, or of one whose zoom, focus or raster changed, are fitted by a camera between the two, with
small error bars, for many corners agree on it. What gives them away is that the views of each group agree among
themselves. With the poses eliminated the cost of each view is nearly a bowl, so that the best two groups, each with
parameters of its own, are found as by k-means: each view goes to the group where it is lower, and each group to where
its sum of bowls is lowest, from several starts.

Views of one real camera contradict each other too, through a board that is not flat or a lens that the model does not
reach. On real photographs two groups then save at most a quarter of the sum of squares, half of what a camera for each
view would, and about three quarters of what is saved where each view has a place of its own on the line through both
cameras, for views are all along it. Of two cameras the views are at its ends: two groups save nine tenths of that. They
save a third and more of the sum of squares where the second camera is another one of the kind, or the first turned by
180 degrees, or zoomed by 5 %; and less where the corners' noise is most of it, as of four views of 13 that were cropped
by a thirtieth, or zoomed by 3 %, but then nearly all that there is to save. A board that is bent by a hundredth of its
length may look the same in few views.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.bowls import Bowls, bowls
from diffproj.calibration.fitting.fit import Fit

FEWEST = 6
"""Views from which on groups tell something: of fewer, two groups take what is chance."""
SAVED, OF_EACH, OF_LINE = (0.3, 0.15), (0.5, 0.75), (0.9, 0.95)
"""What two groups save, from which on they are told: as a part of the sum of squares, of what a camera of its own for
each view would save, and of what is saved where each view has its place on the line through both cameras. Two rules:
where they save much, and where they save most of what there is to save."""
BY_CHANCE = 1.85
"""Over the root of the number of views: what two groups save of what a camera for each view would, where the errors of
each view's corners go together, in one of 20 sets; what two cameras save is more."""
DIRECTIONS, ROUNDS = 6, 12
"""Main directions in which the views' pulls differ, from both sides of which groups are begun; and rounds of each."""
TINY = 1e-9
"""Added to a group's bowl, where all views together have 1, for directions of which it tells nothing."""


class TwoGroups(NamedTuple):
    """The two groups of one camera: which views are in the smaller one, and the part of the sum of squares saved."""

    smaller: list[int]
    saved: float


def two_groups(found: Fit, which: Tensor) -> dict[int, TwoGroups]:
    """Those of cameras `(n,)` whose views fall into two groups, by their number."""
    task = found.part(which).task if len(which) else found.task
    counted = task.used.any(-1).sum(-1) if task.shares is None else (task.shares * task.used.any(-1)).sum(-1)
    if len(which):
        enough = counted >= FEWEST
        which, counted = which[enough], counted[enough]
    if len(which) == 0 or task.free:
        return {}
    with torch.no_grad():
        part = found.part(which)
        seen = bowls(part.task, part.solution.shared, part.solution.local)
        if seen.g.shape[-1] == 0:
            return {}
        H, g = _whitened(seen)
        labels, saved = _best(H, g, part.task.used.any(-1))
        total, each, line = seen.c.sum(-1), _of_each(H, g), saved + _along_the_line(H, g, labels)
        told = torch.zeros_like(total, dtype=torch.bool)
        by_chance = BY_CHANCE / counted.to(each).sqrt()
        for of_total, of_each, of_line in zip(SAVED, OF_EACH, OF_LINE, strict=True):
            told |= (
                (saved > of_total * total) & (saved > by_chance.clamp(min=of_each) * each) & (saved > of_line * line)
            )
        told &= total.isfinite()
    groups = {}
    for i in told.nonzero().flatten().tolist():
        label = labels[i] if 2 * int(labels[i].sum()) <= int(part.task.used[i].any(-1).sum()) else ~labels[i]
        smaller = (label & part.task.used[i].any(-1)).nonzero().flatten().tolist()
        groups[int(which[i])] = TwoGroups(smaller, float(saved[i] / total[i]))
    return groups


def _whitened(seen: Bowls) -> tuple[Tensor, Tensor]:
    """Bowls in units in which all together have curvature 1, about their lowest place: `(P, V, q, q)`, `(P, V, q)`."""
    total = seen.H.sum(1)
    scale = total.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    values, vectors = torch.linalg.eigh((total * scale.unsqueeze(-1) * scale.unsqueeze(-2)).nan_to_num())
    known = values > 1e-10 * values[:, -1:]
    W = scale.unsqueeze(-1) * vectors * torch.where(known, values.clamp(min=1e-300).rsqrt(), 0.0).unsqueeze(-2)
    H = W.mT.unsqueeze(1) @ seen.H @ W.unsqueeze(1)
    g = (seen.g.unsqueeze(-2) @ W.unsqueeze(1)).squeeze(-2)
    return H, g - (H @ g.sum(1)[:, None, :, None]).squeeze(-1)


def _best(H: Tensor, g: Tensor, used: Tensor) -> tuple[Tensor, Tensor]:
    """The groups `(P, V)` that save most, and what they save `(P,)`."""
    main = torch.linalg.svd(g, full_matrices=False).Vh[:, :DIRECTIONS]
    along = torch.where(used.unsqueeze(-1), g @ main.mT, torch.nan).permute(2, 0, 1)  # (C, P, V)
    one = torch.cat([along > 0, along > along.nanmedian(-1, keepdim=True).values])
    best, saved = one[0], torch.zeros_like(g[:, 0, 0])
    for _ in range(ROUNDS):
        gain, costs = _gain(H, g, one)
        sound = ((one & used).sum(-1) >= 2) & ((~one & used).sum(-1) >= 2)
        gain, start = torch.where(sound, gain, 0.0).max(0)
        lower = gain > saved
        chosen = one.gather(0, start[None, :, None].expand(1, -1, one.shape[-1])).squeeze(0)
        best, saved = torch.where(lower.unsqueeze(-1), chosen, best), torch.where(lower, gain, saved)
        one = costs[0] < costs[1]
    return best, saved


def _gain(H: Tensor, g: Tensor, one: Tensor) -> tuple[Tensor, Tensor]:
    """What groups `(C, P, V)` save `(C, P)`, and what each view costs at the lowest place of either `(2, C, P, V)`."""
    gain, costs = torch.zeros_like(one[..., 0], dtype=g.dtype), []
    for x, saved in (_lowest(H, g, one), _lowest(H, g, ~one)):
        gain = gain + saved
        turned = torch.einsum("pvij,cpj->cpvi", H, x) / 2 + g
        costs.append((turned * x.unsqueeze(-2)).sum(-1))
    return gain, torch.stack(costs)


def _lowest(H: Tensor, g: Tensor, group: Tensor) -> tuple[Tensor, Tensor]:
    """The lowest places of groups `(C, P, V)` of views `(C, P, q)`, and what each saves there `(C, P)`."""
    A, b = torch.einsum("cpv,pvij->cpij", group.to(g), H), torch.einsum("cpv,pvi->cpi", group.to(g), g)
    x = -torch.linalg.solve_ex(A + _tiny(H), b.unsqueeze(-1))[0].squeeze(-1)
    return x, -(b * x).sum(-1) / 2


def _of_each(H: Tensor, g: Tensor) -> Tensor:
    """What a camera of its own for each view would save `(P,)`."""
    return (g * torch.linalg.solve_ex(H + _tiny(H), g.unsqueeze(-1))[0].squeeze(-1)).sum((-2, -1)) / 2


def _along_the_line(H: Tensor, g: Tensor, one: Tensor) -> Tensor:
    """What more is saved `(P,)` where each view has its place on the line through the cameras of two groups."""
    ends = [_lowest(H, g, group.unsqueeze(0))[0][0].unsqueeze(1) for group in (one, ~one)]
    start, direction = torch.where(one.unsqueeze(-1), *ends), (ends[1] - ends[0]).expand_as(g)
    slope = ((g + (H @ start.unsqueeze(-1)).squeeze(-1)) * direction).sum(-1)
    bend = ((H @ direction.unsqueeze(-1)).squeeze(-1) * direction).sum(-1)
    told = bend > 1e-12 * bend.amax(-1, keepdim=True)
    return torch.where(told, slope.square() / torch.where(told, 2 * bend, 1.0), 0.0).sum(-1)


def _tiny(H: Tensor) -> Tensor:
    return TINY * torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
