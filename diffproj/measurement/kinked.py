"""Intervals of any function of points, also of one that has a kink or turns back within the noise.

The difference of two sides without its sign, the longer of two lengths, a square near zero: the smallest value that
such a function takes where all errors together are as many deviations as the level allows may lie inside of that ball,
and slopes lead past it. What the slopes at random errors have in common tells the few directions that it depends on;
along these the ball is searched. Where it depends on more than one of them, as the longer of two lengths does where
they are nearly equal, the ball has to be larger to hold them all as often as the level says. Where there are more than
two, as in the spread of several lengths, no search is sure to find what lies in the ball: the bounds are then as far as
the steepest slope leads at most.
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.measurement.each import number_of_each
from diffproj.measurement.intervals import Function, curved_interval, extreme
from diffproj.measurement.propagation import Propagated
from diffproj.measurement.student import joint_reach, normal_reach

PAIRS = 32
"""Random errors at which slopes are asked for, each with its opposite."""
WIDER = 1.5
"""Their deviation: so that those near the rim of a 95 % interval count, too."""
STRAIGHT = 0.01
"""Part of the slopes' mean square that may not be that of their mean for a function to count as straight."""
HAIR = 1e-3
"""Deviations over which a function that does not change is level."""
DIRECTIONS = 4
"""How many directions are searched."""
SEARCHED = 2.5
"""Up to how many directions, counted by how much a function depends on each, the search is relied on."""
ROUNDS, SMALLER = 28, 0.7
"""Rounds of the search, each with steps shorter by this factor."""
MOST = 2_000_000
"""Numbers that are held at once for errors that are followed to points."""


@torch.no_grad()
def kinked_interval(
    spread: Propagated, function: Function, value: Tensor, lost: Tensor, kink: Tensor, level: float, reach: Tensor
) -> tuple[Tensor, Tensor]:
    """Bounds of a function of points: see `curved_interval`, which they are where the function is nearly straight."""
    low, high = curved_interval(spread, function, value, lost, kink, level, reach)
    if value.numel() == 0:
        return low, high
    reach = reach.masked_fill(lost, torch.inf)
    each = max(1, MOST * len(spread.index) // (2 * PAIRS * spread.rows().numel()))
    for rows in torch.arange(len(spread.index), device=value.device).split(each):
        found = _of_bent(_part(spread, rows), function, value[..., rows], level, reach[..., rows])
        if found is not None:
            which, bent, (least, most) = found
            rows = rows[which]
            low[..., rows] = torch.where(bent, least, low[..., rows])
            high[..., rows] = torch.where(bent, most, high[..., rows])
    return low, high


def _part(spread: Propagated, rows: Tensor) -> Propagated:
    """The errors of some of the vectors `(m,)`."""
    common, own = spread.common.index_select(-3, rows), spread.own.index_select(-4, rows)
    return replace(spread, index=spread.index[rows], common=common, own=own)


def _of_bent(
    spread: Propagated, function: Function, value: Tensor, level: float, reach: Tensor
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]] | None:
    """Bounds where the function is bent: in which rows `(m,)` it is anywhere, where in these, and both bounds."""
    slopes = _slopes(spread, function)
    unit = slopes / slopes.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    bent = 1 - unit.mean(-2).square().sum(-1) > STRAIGHT
    bent &= (unit != 0).any(-1).any(-1) & reach.isfinite()
    which = bent.reshape(-1, bent.shape[-1]).any(0).nonzero().squeeze(-1)
    if len(which) == 0:
        return None
    spread, value, reach, bent = _part(spread, which), value[..., which], reach[..., which], bent[..., which]
    slopes, unit = slopes.index_select(-3, which), unit.index_select(-3, which)
    sizes, vectors = torch.linalg.eigh(unit.mT @ unit)
    axes = vectors[..., -DIRECTIONS:].flip(-1).mT
    first = spread.rows().squeeze(-2)
    # At the bottom of a square, or of a length, `kink` tells how far noise reaches; not where all around is level.
    stationary = first.abs().amax(-1) == 0
    around = _values(spread, function, HAIR * axes[..., :1, :])[0].squeeze(-1)
    bent &= ~stationary | (around == value)
    many = sizes.sum(-1).square() / sizes.square().sum(-1).clamp(min=1e-300)
    wide = torch.where(bent, reach, 1.0) * joint_reach(level, many.clamp(min=1)) / normal_reach(level)
    farthest = torch.where(many > SEARCHED, slopes.norm(dim=-1).amax(-1) * wide, 0.0)
    found = []
    for side in (-1, 1):
        at_rim, where = extreme(spread, number_of_each(function), value, first, side, wide)
        inside = _searched(spread, function, value, axes, wide, where, side)
        inside = side * (side * inside).maximum(side * value + farthest)
        found.append(torch.where(at_rim.isinf(), at_rim, inside))
    return which, bent, (found[0], found[1])


def _slopes(spread: Propagated, function: Function) -> Tensor:
    """The derivative by the errors `(*B, M, 2 PAIRS, E)` at as many random ones; 0 where there is none."""
    count = spread.rows().shape[-1]
    draws = WIDER * torch.randn(
        PAIRS, count, generator=torch.Generator("cpu").manual_seed(0), dtype=torch.float64, device="cpu"
    )
    errors = torch.cat([draws, -draws]).to(spread.own.device)
    shape = (*spread.own.shape[:-4], len(spread.index), *errors.shape)

    def total(at: Tensor) -> Tensor:
        there, valid = _values(spread, function, at)
        return torch.where(valid, there, 0.0).sum()

    return torch.func.grad(total)(errors.expand(shape)).nan_to_num(0.0, 0.0, 0.0)


def _values(spread: Propagated, function: Function, errors: Tensor) -> tuple[Tensor, Tensor]:
    """The function `(*B, M, P)` after P errors each `(*B, M, P, E)`, and whether there is one."""
    many = errors.shape[-2]
    repeated = replace(spread, index=spread.index.repeat_interleave(many, 0))
    points, valid = repeated.points(errors.flatten(-3, -2))
    there = number_of_each(function)(points)
    return tuple(z.unflatten(-1, (-1, many)) for z in (there, valid & there.isfinite()))  # type: ignore[return-value]


def _searched(
    spread: Propagated, function: Function, value: Tensor, axes: Tensor, reach: Tensor, rim: Tensor, side: int
) -> Tensor:
    """The largest value (side 1) or the smallest (-1) in the ball: from the best of a few places by ever smaller steps.

    Args:
        spread: the errors.
        function: of the points.
        value: where they were measured `(*B, M)`.
        axes: the directions of the errors that are searched `(*B, M, d, E)`.
        reach: the radius of the ball `(*B, M)`.
        rim: a direction in which it is large `(*B, M, E)`.
        side: which.
    """
    d = axes.shape[-2]
    radius = reach[..., None, None]

    def best(at: Tensor, errors: Tensor, found: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The best of these errors and what was found at others, and how much the next differ from it."""
        inside = errors * (radius / errors.norm(dim=-1, keepdim=True).clamp(min=1e-300)).clamp(max=1)
        there, valid = _values(spread, function, inside)
        signed = torch.where(valid, side * there, -torch.inf)
        top, which = signed.max(-1)
        better = top > found
        chosen = inside.gather(-2, which[..., None, None].expand(*which.shape, 1, inside.shape[-1])).squeeze(-2)
        now = torch.where(better, top, found)
        step = torch.where(valid, (side * there - now.unsqueeze(-1)).abs(), 0.0).amax(-1)
        return torch.where(better.unsqueeze(-1), chosen, at), now, step

    generator = torch.Generator("cpu").manual_seed(1)
    places = torch.cat([axes, -axes, rim.unsqueeze(-2)], dim=-2)
    at, found = torch.zeros_like(rim), side * value
    at, found, rest = best(at, torch.cat([part * radius * places for part in (0.5, 1.0)], dim=-2), found)
    size = radius / 2
    for _ in range(ROUNDS):
        # Kinks may run along any direction, so that steps along the same ones could end on each of them.
        turned = torch.linalg.qr(torch.randn(d, d, generator=generator, dtype=torch.float64, device="cpu"))[0].to(axes)
        steps = size * (turned @ axes)
        at, found, rest = best(at, at.unsqueeze(-2) + torch.cat([steps, -steps], dim=-2), found)
        size = SMALLER * size
    return side * (found + rest)
