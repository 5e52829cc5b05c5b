"""The inverse of the Brown-Conrady equations by Newton's method."""

import math
from typing import Any

import torch
from torch import Tensor

from diffproj._core.numerics import precise, readable
from diffproj.lens.brown_equations import Jacobian, Terms, bend, bend_off, newton_direction, term_growth, tilted
from diffproj.lens.compiling import coordinates, with_batch_in_front
from diffproj.lens.plan import Plan
from diffproj.lens.table import InverseTable

Pair = tuple[Tensor, Tensor]

STEPS = {torch.float32: 3, torch.float64: 4}
"""Newton steps from the table's start to rounding, but for points next to a fold."""
PATIENCE = 200
"""Steps for those: near a fold each of them only halves the distance to the solution."""
GAIN = 1e-4
"""The share of what Newton's method promises that a step has to gain, as is usual (Armijo 1966)."""
CLOSE = 1e-7
"""Nearer to the edge than this share of the radius a step may cross it."""
HALVINGS = 24
"""How often a start is halved in on along a ray."""
SHORTEST = 1e-9
"""The share of a step below which it is rounding that hinders."""
TOLERANCE = {torch.float32: 1.0, torch.float64: 2.0}
"""How many roundings of the equations a solution may be off by."""
TILTED = 0.5
"""The share of that in front of a tilt, which multiplies errors once more."""
LENIENCE = 4
"""The same after the patient search, with what rounding the solution itself costs counted in."""


def squared_domain(domain: Tensor) -> Tensor:
    """The squared radius of the domain as a column; negative where not even the centre is in it."""
    return torch.where(domain > 0, domain * domain, -1).unsqueeze(-1)


def untilted(terms: Terms, points: Tensor) -> Pair:
    """Distorted points before the tilt was applied."""
    x, y = points.unbind(-1)
    return (x, y) if terms.tilt is None else terms.tilt.undo(x, y)[:2]


def newton(terms: Terms, target: Pair, x: Tensor, y: Tensor, *, steps: int) -> Pair:
    """A number of Newton steps from `(x, y)`."""
    for _ in range(steps):
        _, _, step_x, step_y, determinant = newton_direction(terms, target, x, y)
        x, y = torch.addcdiv(x, step_x, determinant), torch.addcdiv(y, step_y, determinant)
    return x, y


@torch.no_grad()
def search(coefficients: Tensor, plan: Plan, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Undistorted points without a tape.

    Args:
        coefficients: `(*B, k)`, detached.
        plan: the lens's.
        points: distorted points `(*B, N, 2)`, detached.

    Returns:
        `x`, `y` and whether they are the solution inside the domain; anything where they are not.
    """
    terms = Terms.of(coefficients)
    x, y = coordinates(points)
    possible = None
    if terms.tilt is not None:
        x, y, inverse_depth = terms.tilt.undo(x, y)
        possible = inverse_depth > 0
    target = x, y
    rho_squared = torch.addcmul(x * x, y, y)
    ratio = InverseTable(plan.rho_max, plan.ratio).ratio_at(x, y, rho_squared.sqrt())
    x, y = newton(terms, target, x * ratio, y * ratio, steps=STEPS[x.dtype])
    limit = (plan.reach * plan.reach).clamp_max(torch.finfo(x.dtype).max).unsqueeze(-1)
    possible = rho_squared <= limit if possible is None else possible & (rho_squared <= limit)
    domain_squared = squared_domain(plan.domain)
    share = 1 if terms.tilt is None else TILTED
    tolerance = share * TOLERANCE[x.dtype] * torch.finfo(x.dtype).eps * plan.noise
    tolerance_squared = tolerance.square().unsqueeze(-1) * rho_squared
    solved = _solves(terms, target, x, y, domain_squared, tolerance_squared) & possible
    batch = points.shape[:-2]
    lens = coefficients.expand(*batch, -1), plan.domain.expand(batch), plan.noise.expand(batch)
    again = look_again_at if readable(points, coefficients) else _look_again_at
    x, y, found = again(*lens, points, x, y, possible & ~solved)
    return x, y, solved | found


def _solves(
    terms: Terms, target: Pair, x: Tensor, y: Tensor, domain_squared: Tensor, tolerance_squared: Tensor
) -> Tensor:
    """Whether `(x, y)` lies in the domain and goes to the target."""
    x_bent, y_bent = bend(terms, x, y)
    off_x, off_y = x_bent - target[0], y_bent - target[1]
    off_squared = torch.addcmul(off_x * off_x, off_y, off_y)
    return (off_squared <= tolerance_squared) & (torch.addcmul(x * x, y, y) <= domain_squared)


def look_again_at(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor, left: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve what is left over, however long it takes, in float64.

    Args:
        coefficients: `(*B, k)`.
        domain: `(*B,)`, the plan's.
        noise: the same.
        points: distorted points `(*B, N, 2)`.
        x: `(*B, N)`, where the search has come so far.
        y: the same.
        left: which points are left over.

    Returns:
        `x`, `y`, and which of those left over are solved now.
    """
    index = left.nonzero(as_tuple=True)
    if index[0].numel() == 0:
        return x, y, left
    chosen = points[index]
    count = len(chosen)
    lens = coefficients[index[:-1]].expand(count, -1), domain[index[:-1]].expand(count), noise[index[:-1]].expand(count)
    found_x, found_y, solved = _solved_in_steps(*lens, chosen, x[index], y[index])
    hard = (~solved).nonzero(as_tuple=True)
    if hard[0].numel():
        answer = _solved_patiently(*(part[hard] for part in (*lens, chosen, found_x, found_y)))
        found_x, found_y, solved = (
            whole.index_put(hard, part) for whole, part in zip((found_x, found_y, solved), answer, strict=True)
        )
    return x.index_put(index, found_x), y.index_put(index, found_y), left.index_put(index, solved)


def _solved_in_steps(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Two more Newton steps: enough where only rounding was in the way. One lens for each of `n` points."""
    terms = Terms.of(precise(coefficients))
    target = untilted(terms, precise(points).unsqueeze(-2))
    start = precise(x).unsqueeze(-1), precise(y).unsqueeze(-1)
    found = newton(terms, target, *start, steps=2)
    x_found, y_found, solved = _judged(terms, target, domain, noise, x.dtype, *found)
    if found[0].dtype != x.dtype:  # what is rounded afterwards must not be off already
        off_x, off_y, _ = bend_off(terms, target, *found)
        limit = torch.finfo(x.dtype).eps / 2 * torch.hypot(*target)
        solved = solved & (torch.hypot(off_x, off_y) <= limit).squeeze(-1)
    return x_found, y_found, solved


def _solved_patiently(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """However long it takes. One lens for each of `n` points."""
    terms = Terms.of(precise(coefficients))
    goal_x, goal_y = precise(points).split(1, dim=-1)
    target = untilted(terms, precise(points).unsqueeze(-2))
    enough = (torch.finfo(goal_x.dtype).eps * torch.hypot(goal_x, goal_y)) ** 2
    start_x, start_y = (precise(part).unsqueeze(-1).nan_to_num(0.0, 0.0, 0.0) for part in (x, y))
    radius = precise(domain).unsqueeze(-1)
    found = _search_patiently(terms, (goal_x, goal_y), start_x, start_y, radius, enough)
    return _judged(terms, target, domain, noise, x.dtype, *found)


def _judged(
    terms: Terms, target: Pair, domain: Tensor, noise: Tensor, kind: torch.dtype, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Points `(n, 1)` rounded to their type, as `(n,)`, and whether they are solutions inside the domain."""
    x_rounded, y_rounded = x.to(kind), y.to(kind)
    x, y = precise(x_rounded), precise(y_rounded)
    off_x, off_y, slope = bend_off(terms, target, x, y)
    steepest = torch.hypot(torch.hypot(slope.xx, slope.xy), torch.hypot(slope.yx, slope.yy))
    distance = torch.hypot(x, y)
    growth = precise(noise).unsqueeze(-1).maximum(term_growth(terms, distance * distance))
    rounding = torch.finfo(kind).eps * (growth * torch.hypot(*target) + steepest * distance)
    radius = precise(domain).unsqueeze(-1)
    solved = (torch.hypot(off_x, off_y) <= LENIENCE * rounding) & (distance <= radius) & (radius > 0)
    return x_rounded.squeeze(-1), y_rounded.squeeze(-1), solved.squeeze(-1)


@torch.library.custom_op("diffproj::look_again_at", mutates_args=())
def _look_again_at(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor, left: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The same as one opaque operation, for graphs and transforms in which nobody sees whether any are left over."""
    x_found, y_found, found = look_again_at(coefficients, domain, noise, points, x, y, left)
    return (x.clone(), y.clone(), left.clone()) if x_found is x else (x_found, y_found, found)


@_look_again_at.register_fake
def _look_again_at_shapes(
    coefficients: Tensor,  # noqa: ARG001
    domain: Tensor,  # noqa: ARG001
    noise: Tensor,  # noqa: ARG001
    points: Tensor,  # noqa: ARG001
    x: Tensor,
    y: Tensor,
    left: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    return torch.empty_like(x), torch.empty_like(y), torch.empty_like(left)


@_look_again_at.register_vmap
def _look_again_at_batched(
    info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], tuple[int, int, int]]:
    return _look_again_at(*with_batch_in_front(info, in_dims, *tensors)), (0, 0, 0)


def _search_patiently(
    terms: Terms, goal: Pair, x: Tensor, y: Tensor, radius: Tensor, enough: Tensor
) -> tuple[Tensor, Tensor]:
    """Newton's method on the whole plane, from anywhere to the solution, if it lies in the disc.

    The lens is continued beyond its disc by `G(z) = F(p) + c (z - p)`, where `p` is the point of the disc next to `z`
    and `c` about as steep as the lens (Robinson 1992, the normal map of a variational inequality). In the disc the
    symmetric part of the Jacobian is positive definite, so `G` takes the plane to the plane one-to-one and its slope
    is nowhere singular: no start and no edge leads astray. A goal without a preimage in the disc has one under `G`
    outside.

    Args:
        terms: those of the lens, as columns that broadcast against the points.
        goal: distorted points, tilted if the lens is.
        x: where to start.
        y: the same.
        radius: of the disc.
        enough: squared distance from the goal at which to stop.

    Returns:
        The best `x` and `y` that were found.
    """
    x_next, y_next = _on_ray(terms, goal, x, y, radius)
    there = tilted(terms, x_next, y_next)
    xx, xy, yx, yy = there.jacobian
    stiffness = torch.hypot(torch.hypot(xx, xy), torch.hypot(yx, yy)) / (math.sqrt(2) * there.depth)
    step_x = step_y = torch.zeros_like(x)
    off = torch.full_like(x, torch.inf)
    share, going = torch.ones_like(x), torch.ones_like(x, dtype=torch.bool)
    settled = torch.finfo(x.dtype).eps ** 2
    for _ in range(PATIENCE):
        off_x, off_y, along_x, along_y = _continued(terms, goal, x_next, y_next, radius, stiffness)
        off_next = torch.addcmul(off_x * off_x, off_y, off_y)
        gains = off_next < (1 - GAIN * share) * off
        x, y, off = torch.where(gains, x_next, x), torch.where(gains, y_next, y), torch.where(gains, off_next, off)
        step_x, step_y = torch.where(gains, along_x, step_x), torch.where(gains, along_y, step_y)
        size = torch.addcmul(x * x, y, y)
        going = (off > enough) & (torch.addcmul(step_x * step_x, step_y, step_y) > settled * size) & (share > SHORTEST)
        if not bool(going.any()):
            break
        share = torch.where(gains, 2 * share, share / 4).clamp_max(1)
        x_next, y_next = _stepped(x, y, share * step_x, share * step_y, radius)
    return x, y


def _stepped(x: Tensor, y: Tensor, step_x: Tensor, step_y: Tensor, radius: Tensor) -> Pair:
    """A step on, along a circle sideways, and from inside the disc at most nine tenths of the way to its edge.

    Next to a pole the distance to the edge may be a millionth of the radius: a straight step sideways would leave it.
    """
    distance = torch.hypot(x, y)
    length = distance.clamp_min(torch.finfo(x.dtype).tiny)
    along, sideways = (x * step_x + y * step_y) / length, (x * step_y - y * step_x) / length
    circular = (sideways.abs() < distance / 2) & (along > -distance / 2)
    angle = torch.where(circular, sideways / length, 0)
    ahead = distance + along
    turned_x = torch.where(circular, ahead * (x * angle.cos() - y * angle.sin()) / length, x + step_x)
    turned_y = torch.where(circular, ahead * (x * angle.sin() + y * angle.cos()) / length, y + step_y)
    inside = radius - distance > CLOSE * radius
    most = torch.where(inside, distance + 0.9 * (radius - distance), torch.inf)
    shrink = (most / torch.hypot(turned_x, turned_y)).clamp_max(1).nan_to_num(1.0)
    return turned_x * shrink, turned_y * shrink


def _on_ray(terms: Terms, goal: Pair, x: Tensor, y: Tensor, radius: Tensor) -> Pair:
    """Where to start: on the ray towards the goal, as far as the goal is along it; or at `(x, y)` if that is nearer.

    Along a ray from the centre the lens carries points ever further in that direction.
    """
    size = torch.hypot(*goal)
    towards_x, towards_y = (part / size.clamp_min(torch.finfo(x.dtype).tiny) for part in goal)
    low, high = torch.zeros_like(size), torch.where(radius < torch.inf, radius, 0)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        there = tilted(terms, towards_x * middle, towards_y * middle)
        short = towards_x * there.x + towards_y * there.y < size
        low, high = torch.where(short, middle, low), torch.where(short, high, middle)
    shrink = (radius / torch.hypot(x, y)).clamp_max(1).nan_to_num(1.0)
    starts = (x * shrink, y * shrink), (towards_x * low, towards_y * low)
    there = [tilted(terms, *start) for start in starts]
    off, off_on_ray = (torch.hypot(goal[0] - place.x, goal[1] - place.y) for place in there)
    return torch.where(off < off_on_ray, starts[0][0], starts[1][0]), torch.where(
        off < off_on_ray, starts[0][1], starts[1][1]
    )


def _continued(
    terms: Terms, goal: Pair, x: Tensor, y: Tensor, radius: Tensor, stiffness: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What the lens, continued beyond its disc, lacks to the goal at `(x, y)`, and Newton's step there."""
    distance = torch.hypot(x, y)
    outside = distance > radius
    shrink = torch.where(outside, radius / distance, 1)
    x_in, y_in = x * shrink, y * shrink
    there = tilted(terms, x_in, y_in)
    off_x, off_y = goal[0] - there.x - stiffness * (x - x_in), goal[1] - there.y - stiffness * (y - y_in)
    # The slope of the nearest point is that of shrinking, without what goes along the radius.
    along_x, along_y = torch.where(outside, x / distance, 0), torch.where(outside, y / distance, 0)
    p_xx, p_xy, p_yy = (shrink * part for part in (along_y * along_y, -along_x * along_y, along_x * along_x))
    p_xx, p_yy = torch.where(outside, p_xx, 1), torch.where(outside, p_yy, 1)
    slope = Jacobian(*(part / there.depth for part in there.jacobian))
    xx = slope.xx * p_xx + slope.xy * p_xy + stiffness * (1 - p_xx)
    xy = slope.xx * p_xy + slope.xy * p_yy - stiffness * p_xy
    yx = slope.yx * p_xx + slope.yy * p_xy - stiffness * p_xy
    yy = slope.yx * p_xy + slope.yy * p_yy + stiffness * (1 - p_yy)
    determinant = xx * yy - xy * yx
    return off_x, off_y, (yy * off_x - xy * off_y) / determinant, (xx * off_y - yx * off_x) / determinant
