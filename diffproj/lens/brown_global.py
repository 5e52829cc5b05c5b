"""The globally convergent search for a solution of the Brown-Conrady equations, for the few points that need it."""

import math

import torch
from torch import Tensor

from diffproj.lens.brown_equations import Jacobian, Terms, tilted

Pair = tuple[Tensor, Tensor]

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


def global_newton(
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
