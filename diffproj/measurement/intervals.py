"""Intervals of measured quantities that follow the curve from pixels to the plane, and know that no length is negative.

Bounds are the smallest and the largest value that a quantity takes where all errors together are as many standard
deviations as the level allows. For a linear map that is `value -+ reach * deviation`. For a bent one, as the distance
to a point near the horizon, it is what the pixels tell (bounds of the profile likelihood; for a ratio, Fieller's).
Where such errors reach the horizon, there is no bound on that side.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from diffproj.measurement import folded
from diffproj.measurement.each import at_each, number_of_each
from diffproj.measurement.propagation import Propagated
from diffproj.measurement.quantity import Quantity
from diffproj.measurement.shapes import length
from diffproj.measurement.student import normal_reach

ROUNDS, TURNED = 8, 1e-4
"""How often the direction of the errors that change a quantity most is sought anew where the last ones lead, and by how
much less it has to turn for that to end: its error counts in square."""

Function = Callable[[Tensor], Tensor]
"""Of M sets of points `(*B, M, k, 3)` to M numbers."""
Interval = Callable[..., tuple[Tensor, Tensor]]
"""As `curved_interval`."""


@torch.no_grad()
def curved_interval(
    spread: Propagated, function: Function, value: Tensor, lost: Tensor, kink: Tensor, _level: float, reach: Tensor
) -> tuple[Tensor, Tensor]:
    """Bounds of a function of points.

    Args:
        spread: the errors.
        function: of the points.
        value: where they were measured `(*B, M)`.
        lost: where the calibration does not determine it.
        kink: the standard deviation that its slope lacks.
        reach: how many deviations the interval's level allows `(*B, M)`.
    """
    every, slopes = number_of_each(function), spread.rows().squeeze(-2)
    low, high = (extreme(spread, every, value, slopes, side, reach)[0] for side in (-1, 1))
    return torch.where(lost, -torch.inf, low - reach * kink), torch.where(lost, torch.inf, high + reach * kink)


@torch.no_grad()
def norm_interval(
    spread: Propagated,
    function: Callable[[Tensor], tuple[Tensor, Tensor]],
    vector: Tensor,
    supplement: Tensor,
    lost: Tensor,
    limit: float,
    level: float,
    reach: Tensor,
) -> tuple[Tensor, Tensor]:
    """Bounds of the length of a vector `(*B, M, 3)`, or of what it lacks to the limit, where it is the supplement.

    Along the curve the part of the vector in its measured direction is followed. Near zero, which is told by how many
    deviations of all errors it takes to get there, the bounds are those of `folded`.
    """
    z = normal_reach(level)
    w, C, r = vector.detach(), spread.covariance.detach(), length(vector.detach())
    largest, longest = folded.longest_first(C)
    tiny = r <= 1e-9 * largest.sqrt()
    u = torch.where(tiny.unsqueeze(-1), longest, w / torch.where(tiny, 1.0, r).unsqueeze(-1))
    Cu = (C @ u.unsqueeze(-1)).squeeze(-1)
    along = (u * Cu).sum(-1).clamp(min=0)
    s = along.sqrt()
    noisy = s > 0
    unit = torch.where(noisy, s, 1.0)
    across = (C.diagonal(dim1=-2, dim2=-1).sum(-1) - along).clamp(min=0) / unit.square()
    cross = (Cu - along.unsqueeze(-1) * u).square().sum(-1) / unit.square().square()

    def signed(points: Tensor) -> Tensor:
        there, turned = at_each(function)(points)
        there, turned = there.reshape(w.shape), turned.reshape(r.shape) ^ supplement
        along_u = (u * there).sum(-1)
        if limit == torch.inf:  # nothing turns, and the slope of what is infinite would be NaN
            return along_u
        size = length(there)
        beyond = limit / torch.where(size > 0, size, 1.0) - 1
        return along_u * torch.where(turned, beyond, 1.0)

    slopes = (u.unsqueeze(-1) * spread.rows()).sum(-2)
    smallest, down = extreme(spread, signed, r, slopes, -1, reach)
    greatest, _ = extreme(spread, signed, r, slopes, 1, reach)
    to_zero = _steps_to_zero(spread, signed, r, down, reach / z)
    inner = folded.lower_bound(to_zero, torch.ones_like(r), across, cross, largest / unit.square(), level, z)
    fold = (to_zero < folded.FAR) & noisy
    shorter, valid = spread.points(down * ((to_zero - inner) * reach / z).unsqueeze(-1))
    shorter = torch.where(valid & (inner > 0), signed(shorter), 0.0)
    low = torch.where(fold, shorter, smallest).clamp(min=0)
    step = torch.where(noisy, (greatest - r) / (z * unit), reach / z).clamp(min=0)
    wide = torch.where(step.isfinite(), step, 1.0).square()
    high = folded.upper_bound(w, C * wide[..., None, None], largest * wide, longest, z)
    low = torch.where(lost, 0.0, low)
    high = torch.where(lost | greatest.isinf(), torch.inf, high)
    low, high = torch.where(supplement, limit - high, low), torch.where(supplement, limit - low, high)
    return low.clamp(min=0), high.clamp(max=limit)


def angle_interval(arms: Sequence[Quantity], angle: Quantity, level: float, _reach: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of an angle: all that there are where one of its arms may have no length, and so no direction."""
    low, high = angle.interval(level)
    unclear = (arms[0].interval(level)[0] == 0) | (arms[1].interval(level)[0] == 0)
    return torch.where(unclear, 0.0, low), torch.where(unclear, torch.pi, high)


def extreme(
    spread: Propagated, function: Function, value: Tensor, slopes: Tensor, side: int, reach: Tensor
) -> tuple[Tensor, Tensor]:
    """The largest value (side 1) or the smallest (-1) within reach, and the direction in which it lies `(*B, M, E)`.

    Infinite where the plane is left on the way. Each round goes where the slope at the last place points.
    """
    if value.numel() == 0:
        return value, slopes

    def total(errors: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        points, valid = spread.points(errors)
        there = function(points)
        return torch.where(valid, there, 0.0).sum(), (there, valid)

    best, where = value, side * _unit(slopes)
    direction, bounded = where, torch.ones_like(value, dtype=torch.bool)
    for _ in range(ROUNDS):
        slope, (there, valid) = torch.func.grad(total, has_aux=True)(reach.unsqueeze(-1) * direction)
        bounded = bounded & valid
        better = valid & (side * there > side * best)
        best, where = torch.where(better, there, best), torch.where(better.unsqueeze(-1), direction, where)
        moves = (slope.abs().amax(-1, keepdim=True) > 0) & slope.isfinite().all(-1, keepdim=True)
        following = torch.where(moves, side * _unit(slope), direction)
        if bool(((following - direction).abs() < TURNED).all()):
            break
        direction = following
    return torch.where(bounded, best, side * torch.inf), where


def _steps_to_zero(spread: Propagated, function: Function, value: Tensor, direction: Tensor, unit: Tensor) -> Tensor:
    """How many steps of `unit` it takes from a positive value to zero `(*B, M)`; `folded.FAR` where it is further."""

    def after(steps: Tensor) -> Tensor:
        points, valid = spread.points(direction * (steps * unit).unsqueeze(-1))
        return torch.where(valid, function(points), -torch.inf)

    far = torch.full_like(value, folded.FAR)
    low, high, below = torch.zeros_like(value), far, after(far)
    is_far, at_low, at_high = below > 0, value, below
    if bool(is_far.all()):
        return far
    for _ in range(12):
        secant = low + (high - low) * (at_low / (at_low - at_high).clamp(min=1e-300))
        middle = torch.where(at_high.isfinite(), secant, (low + high) / 2)
        there = after(middle)
        positive = there > 0
        low, at_low = torch.where(positive, middle, low), torch.where(positive, there, at_low)
        high, at_high = torch.where(positive, high, middle), torch.where(positive, at_high, there)
    return torch.where(
        is_far, far, low + (high - low) * (at_low / (at_low - at_high).clamp(min=1e-300)).nan_to_num(0.0)
    )


def _unit(rows: Tensor) -> Tensor:
    size = rows.norm(dim=-1, keepdim=True)
    return torch.where(size > 0, rows / torch.where(size > 0, size, 1.0), 0.0)
