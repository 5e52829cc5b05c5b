"""The inverse of the Brown-Conrady equations by Newton's method, with a globally convergent search as fallback."""

import math
from typing import Any

import torch
from torch import Tensor

from diffproj._core.numerics import has_values, in_float64
from diffproj.lens.brown_equations import Jacobian, Terms, bend, bend_off, newton_direction, term_growth, tilted
from diffproj.lens.compiling import coordinates, length_of, with_batch_in_front
from diffproj.lens.plan import Plan
from diffproj.lens.table import InverseTable

Pair = tuple[Tensor, Tensor]

NEWTON_STEPS = {torch.float32: 2, torch.float64: 3}
"""Newton steps from the table's estimate to full precision, except for points next to a fold."""
MAX_STEPS = 200
"""Maximum number of steps of the global search: near a fold each step only halves the distance to the solution."""
SUFFICIENT_DECREASE = 1e-4
"""An accepted step lowers the squared residual by at least this part, times the step's fraction (Armijo 1966)."""
EDGE_MARGIN = 1e-7
"""Distance from the domain's edge, relative to its radius, below which a step may cross the edge."""
BISECTIONS = 24
"""Bisections along a ray for the start of the global search."""
MIN_STEP_FRACTION = 1e-9
"""Fraction of the Newton step below which the line search stops: rounding prevents any decrease."""
TOLERANCE = {torch.float32: 1.0, torch.float64: 2.0}
"""Largest residual of a solution, in units of the equations' rounding error."""
TILT_FACTOR = 0.5
"""Factor of this tolerance for lenses with tilt, which amplifies errors."""
GRAPH_STEPS = 8
"""Newton steps in float64 in an exported graph, which holds the same steps for all points."""
FINAL_TOLERANCE = 4
"""The same for `_solve_remaining`, whose rounding error includes that of storing the solution."""


def squared_domain(domain: Tensor) -> Tensor:
    """The squared radius of the domain as a column; negative for an empty domain."""
    return torch.where(domain > 0, domain * domain, -1).unsqueeze(-1)


def untilted(terms: Terms, points: Tensor) -> Pair:
    """Distorted points with the tilt inverted."""
    x, y = points.unbind(-1)
    return (x, y) if terms.tilt is None else terms.tilt.undo(x, y)[:2]


def newton(terms: Terms, target: Pair, x: Tensor, y: Tensor, *, steps: int) -> Pair:
    """Take a fixed number of Newton steps from `(x, y)`."""
    for _ in range(steps):
        _, _, step_x, step_y, determinant = newton_direction(terms, target, x, y)
        x, y = torch.addcdiv(x, step_x, determinant), torch.addcdiv(y, step_y, determinant)
    return x, y


@torch.no_grad()
def search(coefficients: Tensor, plan: Plan, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Undistort points, without autograd.

    Args:
        coefficients: `(*B, k)`, detached.
        plan: the lens's.
        points: distorted points `(*B, N, 2)`, detached.

    Returns:
        `x`, `y` and whether they are the solution inside the domain; where not, `x` and `y` are undefined.
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
    start_x, start_y = x * ratio, y * ratio
    x, y = newton(terms, target, start_x, start_y, steps=NEWTON_STEPS[x.dtype])
    limit = (plan.reach * plan.reach).clamp_max(torch.finfo(x.dtype).max).unsqueeze(-1)
    possible = rho_squared <= limit if possible is None else possible & (rho_squared <= limit)
    domain_squared = squared_domain(plan.domain)
    share = 1 if terms.tilt is None else TILT_FACTOR
    tolerance = share * TOLERANCE[x.dtype] * torch.finfo(x.dtype).eps * plan.noise
    tolerance_squared = tolerance.square().unsqueeze(-1) * rho_squared
    solved = _solves(terms, target, x, y, domain_squared, tolerance_squared) & possible
    batch = points.shape[:-2]
    lens = coefficients.expand(*batch, -1), plan.domain.expand(batch), plan.noise.expand(batch)
    left = possible & ~solved
    if torch.compiler.is_exporting():
        x_again, y_again, found = _solved_in_graph(*lens, points, start_x, start_y)
        return torch.where(solved, x, x_again), torch.where(solved, y, y_again), solved | (found & left)
    again = _solve_remaining if has_values(points, coefficients) else _solve_remaining_op
    x, y, found = again(*lens, points, x, y, left)
    return x, y, solved | found


def _solves(
    terms: Terms, target: Pair, x: Tensor, y: Tensor, domain_squared: Tensor, tolerance_squared: Tensor
) -> Tensor:
    """Whether `(x, y)` lies in the domain and is distorted to the target."""
    x_bent, y_bent = bend(terms, x, y)
    off_x, off_y = x_bent - target[0], y_bent - target[1]
    off_squared = torch.addcmul(off_x * off_x, off_y, off_y)
    return (off_squared <= tolerance_squared) & (torch.addcmul(x * x, y, y) <= domain_squared)


def _solve_remaining(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor, left: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve the points that have not converged, in float64: two Newton steps, then at most `MAX_STEPS` global ones.

    Args:
        coefficients: `(*B, k)`.
        domain: `(*B,)`, the plan's.
        noise: `(*B,)`, the plan's.
        points: distorted points `(*B, N, 2)`.
        x: `(*B, N)`, the current estimate.
        y: the same.
        left: which points remain to be solved.

    Returns:
        `x`, `y`, and which of the remaining points are solved now.
    """
    index = left.nonzero(as_tuple=True)
    if index[0].numel() == 0:
        return x, y, left
    chosen = points[index]
    count = len(chosen)
    lens = coefficients[index[:-1]].expand(count, -1), domain[index[:-1]].expand(count), noise[index[:-1]].expand(count)
    found_x, found_y, solved = _solved_by_newton(*lens, chosen, x[index], y[index])
    unsolved = (~solved).nonzero(as_tuple=True)
    if unsolved[0].numel():
        answer = _solved_globally(*(part[unsolved] for part in (*lens, chosen, found_x, found_y)))
        found_x, found_y, solved = (
            whole.index_put(unsolved, part) for whole, part in zip((found_x, found_y, solved), answer, strict=True)
        )
    return x.index_put(index, found_x), y.index_put(index, found_y), left.index_put(index, solved)


def _solved_in_graph(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve all points `(*B, N)` by `GRAPH_STEPS` steps in float64: plain operations that any runtime has.

    For some points within a hundredth of the radius of a fold they are too few, and these are not valid.
    """
    terms = Terms.of(in_float64(coefficients))
    target, radius = untilted(terms, in_float64(points)), in_float64(domain).unsqueeze(-1)
    kind, x, y = x.dtype, in_float64(x), in_float64(y)
    for _ in range(GRAPH_STEPS):
        inwards = (radius * (1 - EDGE_MARGIN) / length_of(x, y)).clamp_max(1).nan_to_num(1.0)
        x, y = ((part * inwards).nan_to_num(0.0, 0.0, 0.0) for part in (x, y))
        x, y = newton(terms, target, x, y, steps=1)
    return _rounded_and_checked(terms, target, domain, noise, kind, x, y)


def _solved_by_newton(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Two more Newton steps, enough where only rounding was in the way. One lens for each of `n` points."""
    terms = Terms.of(in_float64(coefficients))
    target = untilted(terms, in_float64(points).unsqueeze(-2))
    start = in_float64(x).unsqueeze(-1), in_float64(y).unsqueeze(-1)
    found = newton(terms, target, *start, steps=2)
    x_found, y_found, solved = _one_by_one(_rounded_and_checked(terms, target, domain, noise, x.dtype, *found))
    if found[0].dtype != x.dtype:  # before rounding, the error must be below it
        off_x, off_y, _ = bend_off(terms, target, *found)
        limit = torch.finfo(x.dtype).eps / 2 * torch.hypot(*target)
        solved = solved & (torch.hypot(off_x, off_y) <= limit).squeeze(-1)
    return x_found, y_found, solved


def _solved_globally(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The global search, of at most `MAX_STEPS` steps. One lens for each of `n` points."""
    terms = Terms.of(in_float64(coefficients))
    goal_x, goal_y = in_float64(points).split(1, dim=-1)
    target = untilted(terms, in_float64(points).unsqueeze(-2))
    enough = (torch.finfo(goal_x.dtype).eps * torch.hypot(goal_x, goal_y)) ** 2
    start_x, start_y = (in_float64(part).unsqueeze(-1).nan_to_num(0.0, 0.0, 0.0) for part in (x, y))
    radius = in_float64(domain).unsqueeze(-1)
    found = _global_newton(terms, (goal_x, goal_y), start_x, start_y, radius, enough)
    return _one_by_one(_rounded_and_checked(terms, target, domain, noise, x.dtype, *found))


def _one_by_one(columns: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """`(n, 1)` as `(n,)`."""
    x, y, solved = (column.squeeze(-1) for column in columns)
    return x, y, solved


def _rounded_and_checked(
    terms: Terms, target: Pair, domain: Tensor, noise: Tensor, kind: torch.dtype, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Points `(*B, N)` rounded to dtype `kind`, and whether they are solutions inside the domain."""
    x_rounded, y_rounded = x.to(kind), y.to(kind)
    x, y = in_float64(x_rounded), in_float64(y_rounded)
    off_x, off_y, slope = bend_off(terms, target, x, y)
    steepest = length_of(length_of(slope.xx, slope.xy), length_of(slope.yx, slope.yy))
    distance = length_of(x, y)
    growth = in_float64(noise).unsqueeze(-1).maximum(term_growth(terms, distance * distance))
    rounding = torch.finfo(kind).eps * (growth * length_of(*target) + steepest * distance)
    radius = in_float64(domain).unsqueeze(-1)
    solved = (length_of(off_x, off_y) <= FINAL_TOLERANCE * rounding) & (distance <= radius) & (radius > 0)
    return x_rounded, y_rounded, solved


@torch.library.custom_op("diffproj::solve_remaining_brown_conrady", mutates_args=())
def _solve_remaining_op(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor, left: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`_solve_remaining` as one opaque operation, for graphs and transforms where `left` cannot be read."""
    x_found, y_found, found = _solve_remaining(coefficients, domain, noise, points, x, y, left)
    return (x.clone(), y.clone(), left.clone()) if x_found is x else (x_found, y_found, found)


@_solve_remaining_op.register_fake
def _solve_remaining_shapes(
    coefficients: Tensor,  # noqa: ARG001
    domain: Tensor,  # noqa: ARG001
    noise: Tensor,  # noqa: ARG001
    points: Tensor,  # noqa: ARG001
    x: Tensor,
    y: Tensor,
    left: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    return torch.empty_like(x), torch.empty_like(y), torch.empty_like(left)


@_solve_remaining_op.register_vmap
def _solve_remaining_batched(
    info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor
) -> tuple[tuple[Tensor, Tensor, Tensor], tuple[int, int, int]]:
    return _solve_remaining_op(*with_batch_in_front(info, in_dims, *tensors)), (0, 0, 0)


def _global_newton(
    terms: Terms, goal: Pair, x: Tensor, y: Tensor, radius: Tensor, enough: Tensor
) -> tuple[Tensor, Tensor]:
    """Damped Newton's method with line search on the lens extended to the whole plane, of at most `MAX_STEPS` steps.

    The lens is extended beyond its disc by `G(z) = F(p) + c (z - p)`, where `p` is the point of the disc closest to
    `z` and the stiffness `c` is about the lens's magnification (Robinson 1992, the normal map of a variational
    inequality). In the disc the symmetric part of the Jacobian is positive definite, so `G` maps the plane one-to-one
    onto itself and its Jacobian is singular nowhere: the residual has no other local minimum, whatever the start. A
    goal without a preimage in the disc has one under `G` outside.

    Args:
        terms: those of the lens, as columns that broadcast against the points.
        goal: distorted points, with tilt if the lens has one.
        x: initial estimate.
        y: the same.
        radius: of the disc.
        enough: squared residual at which to stop.

    Returns:
        The last accepted `x` and `y`.
    """
    x_next, y_next = _on_ray(terms, goal, x, y, radius)
    there = tilted(terms, x_next, y_next)
    xx, xy, yx, yy = there.jacobian
    stiffness = torch.hypot(torch.hypot(xx, xy), torch.hypot(yx, yy)) / (math.sqrt(2) * there.depth)
    step_x = step_y = torch.zeros_like(x)
    off = torch.full_like(x, torch.inf)
    share, going = torch.ones_like(x), torch.ones_like(x, dtype=torch.bool)
    settled = torch.finfo(x.dtype).eps ** 2
    for _ in range(MAX_STEPS):
        off_x, off_y, along_x, along_y = _extended_step(terms, goal, x_next, y_next, radius, stiffness)
        off_next = torch.addcmul(off_x * off_x, off_y, off_y)
        accepted = off_next < (1 - SUFFICIENT_DECREASE * share) * off
        x, y, off = (
            torch.where(accepted, x_next, x),
            torch.where(accepted, y_next, y),
            torch.where(accepted, off_next, off),
        )
        step_x, step_y = torch.where(accepted, along_x, step_x), torch.where(accepted, along_y, step_y)
        size = torch.addcmul(x * x, y, y)
        going = (
            (off > enough)
            & (torch.addcmul(step_x * step_x, step_y, step_y) > settled * size)
            & (share > MIN_STEP_FRACTION)
        )
        if not bool(going.any()):
            break
        share = torch.where(accepted, 2 * share, share / 4).clamp_max(1)
        x_next, y_next = _stepped(x, y, share * step_x, share * step_y, radius)
    return x, y


def _stepped(x: Tensor, y: Tensor, step_x: Tensor, step_y: Tensor, radius: Tensor) -> Pair:
    """The point after a step: its tangential part follows the circle, and it goes at most 0.9 of the way to the edge.

    Next to a pole the distance to the edge may be a millionth of the radius; a straight tangential step would cross
    the edge. A point within `EDGE_MARGIN` of the edge or outside is not limited.
    """
    distance = torch.hypot(x, y)
    length = distance.clamp_min(torch.finfo(x.dtype).tiny)
    along, sideways = (x * step_x + y * step_y) / length, (x * step_y - y * step_x) / length
    circular = (sideways.abs() < distance / 2) & (along > -distance / 2)
    angle = torch.where(circular, sideways / length, 0)
    ahead = distance + along
    turned_x = torch.where(circular, ahead * (x * angle.cos() - y * angle.sin()) / length, x + step_x)
    turned_y = torch.where(circular, ahead * (x * angle.sin() + y * angle.cos()) / length, y + step_y)
    inside = radius - distance > EDGE_MARGIN * radius
    most = torch.where(inside, distance + 0.9 * (radius - distance), torch.inf)
    shrink = (most / torch.hypot(turned_x, turned_y)).clamp_max(1).nan_to_num(1.0)
    return turned_x * shrink, turned_y * shrink


def _on_ray(terms: Terms, goal: Pair, x: Tensor, y: Tensor, radius: Tensor) -> Pair:
    """Start of the global search: a point on the ray towards the goal, or `(x, y)` if its residual is smaller.

    Along a ray from the centre the component of the distorted point in the ray's direction is increasing, so bisection
    finds where it equals the goal's distance.
    """
    size = torch.hypot(*goal)
    towards_x, towards_y = (part / size.clamp_min(torch.finfo(x.dtype).tiny) for part in goal)
    low, high = torch.zeros_like(size), torch.where(radius < torch.inf, radius, 0)
    for _ in range(BISECTIONS):
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


def _extended_step(
    terms: Terms, goal: Pair, x: Tensor, y: Tensor, radius: Tensor, stiffness: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Residual of the extended lens `G` at `(x, y)`, and the Newton step there."""
    distance = torch.hypot(x, y)
    outside = distance > radius
    shrink = torch.where(outside, radius / distance, 1)
    x_in, y_in = x * shrink, y * shrink
    there = tilted(terms, x_in, y_in)
    off_x, off_y = goal[0] - there.x - stiffness * (x - x_in), goal[1] - there.y - stiffness * (y - y_in)
    # Jacobian of the closest point of the disc: a scaling, without the radial component.
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
