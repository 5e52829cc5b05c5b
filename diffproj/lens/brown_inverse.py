"""The inverse of the Brown-Conrady equations by Newton's method."""

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

from diffproj._numerics import readable
from diffproj.lens.brown_equations import Terms, bend, newton_direction
from diffproj.lens.compiling import coordinates
from diffproj.lens.plan import Plan
from diffproj.lens.table import InverseTable

Pair = tuple[Tensor, Tensor]

STEPS = {torch.float32: 3, torch.float64: 4}
"""Newton steps from the table's start to rounding, but for points next to a fold."""
PATIENCE = 120
"""Steps for those: near a fold each of them only halves the distance to the solution."""
BLIND_STEPS = 2
"""More steps for all, where it cannot be seen whether there are any."""
TOLERANCE = 2
"""How many roundings of the equations a solution may be off by."""
LENIENCE = 8
"""Where no one looks again, this many times as much is allowed."""
ROUNDING = {dtype: (4 * torch.finfo(dtype).eps) ** 2 for dtype in STEPS}
"""The squared relative size of a step that rounding alone explains, where next to a pole no tolerance would do."""


def squared_domain(plan: Plan) -> Tensor:
    """The squared radius of the domain as a column; negative where not even the centre is in it."""
    return torch.where(plan.domain > 0, plan.domain * plan.domain, -1).unsqueeze(-1)


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
    look_again = readable(points, coefficients)
    steps = STEPS[x.dtype] + (0 if look_again else BLIND_STEPS)
    x, y = newton(terms, target, x * ratio, y * ratio, steps=steps)
    limit = (plan.reach * plan.reach).clamp_max(torch.finfo(x.dtype).max).unsqueeze(-1)
    possible = rho_squared <= limit if possible is None else possible & (rho_squared <= limit)
    domain_squared = squared_domain(plan)
    tolerance = (TOLERANCE if look_again else LENIENCE * TOLERANCE) * torch.finfo(x.dtype).eps * plan.noise
    tolerance_squared = tolerance.square().unsqueeze(-1) * rho_squared
    solved = _solves(terms, target, x, y, domain_squared, tolerance_squared) & possible
    if not look_again:
        return x, y, solved
    left = (possible & ~solved).nonzero(as_tuple=True)
    if left[0].numel() == 0:
        return x, y, solved

    def chosen(column: Tensor) -> Tensor:
        return column.expand(x.shape)[left]

    terms = tree_map_only(Tensor, chosen, terms)
    answer = _search_patiently(
        terms, (chosen(target[0]), chosen(target[1])), chosen(domain_squared), chosen(tolerance_squared)
    )
    return tuple(whole.index_put(left, part) for whole, part in zip((x, y, solved), answer, strict=True))  # type: ignore[return-value]


def _solves(
    terms: Terms, target: Pair, x: Tensor, y: Tensor, domain_squared: Tensor, tolerance_squared: Tensor
) -> Tensor:
    """Whether `(x, y)` lies in the domain and goes to the target."""
    x_bent, y_bent = bend(terms, x, y)
    off_x, off_y = x_bent - target[0], y_bent - target[1]
    off_squared = torch.addcmul(off_x * off_x, off_y, off_y)
    return (off_squared <= tolerance_squared) & (torch.addcmul(x * x, y, y) <= domain_squared)


def _search_patiently(
    terms: Terms, target: Pair, domain_squared: Tensor, tolerance_squared: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Newton's method from the centre, with steps so short that they stay inside the domain and always gain.

    Everything is `(n,)`. Ends where all points are solved or gain no more.
    """
    x = y = x_next = y_next = step_x = step_y = torch.zeros_like(target[0])
    off = torch.full_like(x, torch.inf)
    share = torch.ones_like(x)
    for _ in range(PATIENCE):
        off_x, off_y, along_x, along_y, determinant = newton_direction(terms, target, x_next, y_next)
        off_next = torch.addcmul(off_x * off_x, off_y, off_y)
        gains = (off_next < (1 - share / 2) * off) & (torch.addcmul(x_next * x_next, y_next, y_next) <= domain_squared)
        x, y, off = torch.where(gains, x_next, x), torch.where(gains, y_next, y), torch.where(gains, off_next, off)
        step_x = torch.where(gains, along_x / determinant, step_x)
        step_y = torch.where(gains, along_y / determinant, step_y)
        share = torch.where(gains, 2 * share, share / 4).clamp_max(1)
        x_next, y_next = torch.addcmul(x, share, step_x), torch.addcmul(y, share, step_y)
        if not bool(((off > tolerance_squared) & (share > torch.finfo(x.dtype).eps)).any()):
            break
    step_squared = torch.addcmul(step_x * step_x, step_y, step_y)
    to_rounding = step_squared <= ROUNDING[x.dtype] * torch.addcmul(x * x, y, y)
    return x, y, (off <= LENIENCE**2 * tolerance_squared) | (to_rounding & (off < torch.inf))
