"""The inverse of the Brown-Conrady equations by Newton's method, with a globally convergent search as fallback.

Of few points on a CPU the first try is made in NumPy: there a step costs about half of what it does in PyTorch.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffproj._core.numerics import all_true, arrays_of, has_values, in_float64, is_short
from diffproj._core.torch_private import in_forward_mode
from diffproj.lens.brown_equations import (
    UNTILTED,
    Terms,
    Values,
    bend_off,
    newton_direction,
    residual,
    term_growth,
)
from diffproj.lens.brown_global import EDGE_MARGIN, Pair, global_newton
from diffproj.lens.compiling import coordinates, length_of, with_batch_in_front
from diffproj.lens.domain import library_of
from diffproj.lens.plan import Plan
from diffproj.lens.polynomial import minus_product, plus_product, plus_quotient, polynomial
from diffproj.lens.table import InverseTable

NEWTON_STEPS = {torch.float32: 1, torch.float64: 2}
"""Newton steps from the start to full precision, except next to a fold or where tangential terms are strong."""
MOST_OUTWARD = 0.5
"""Largest share of the squared radius by which the start takes the tangential and prism terms to move a point."""
MOST_STRETCHED = 4.0
"""Largest factor that the start takes from the squared radius to the undistorted one to find these terms."""
MANY = 0.125
"""Share of all points above which those that have not converged are many."""
TOLERANCE = {torch.float32: 1.0, torch.float64: 2.0}
"""Largest residual of a solution, in units of the equations' rounding error."""
TILT_FACTOR = 0.5
"""Factor of this tolerance for lenses with tilt, which amplifies errors."""
GRAPH_STEPS = 8
"""Newton steps in float64 in an exported graph, which holds the same steps for all points."""
FINAL_TOLERANCE = 4
"""The same for `_solve_remaining`, whose rounding error includes that of storing the solution."""


def squared_domain(domain: Values) -> Values:
    """The squared radius of the domain as a column; negative for an empty domain.

    (Here and below an axis is added to what was computed: of a constant alone Inductor cannot make a column.)
    """
    return library_of(domain).where(domain > 0, domain * domain, -1)[..., None]


def untilted(terms: Terms, points: Tensor) -> Pair:
    """Distorted points with the tilt inverted."""
    x, y = points.unbind(-1)
    return (x, y) if terms.tilt is None else terms.tilt.undo(x, y)[:2]


def newton(terms: Terms, target: Any, x: Values, y: Values, *, steps: int) -> Any:
    """Take a fixed number of Newton steps from `(x, y)`."""
    for _ in range(steps):
        _, _, step_x, step_y, determinant = newton_direction(terms, target, x, y)
        x, y = plus_quotient(x, step_x, determinant), plus_quotient(y, step_y, determinant)
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
    readable = has_values(points, coefficients, plan.domain) and not in_forward_mode()
    if readable and is_short(points) and coefficients.shape[-1] <= UNTILTED:
        _, (numbers, places, *parts) = arrays_of(coefficients, points, *plan)
        with np.errstate(all="ignore"):
            tried = _tried(numbers, places, Plan(*parts), points.dtype)
        x, y, start_x, start_y, possible, solved = map(torch.from_numpy, tried)
    else:
        x, y, start_x, start_y, possible, solved = _tried(coefficients, points, plan, points.dtype)
    if all_true(solved):  # the usual case
        return x, y, solved
    batch = points.shape[:-2]
    lens = coefficients.expand(*batch, -1), plan.domain.expand(batch), plan.noise.expand(batch)
    left = possible & ~solved
    if torch.compiler.is_exporting():
        x_again, y_again, found = _solved_in_graph(*lens, points, start_x, start_y)
        return torch.where(solved, x, x_again), torch.where(solved, y, y_again), solved | (found & left)
    again = _solve_remaining if has_values(points, coefficients) else _solve_remaining_op
    x, y, found = again(*lens, points, x, y, left)
    return x, y, solved | found


def _tried(coefficients: Values, points: Values, plan: Plan, dtype: torch.dtype) -> tuple[Values, ...]:
    """From the start by a fixed number of Newton steps: tensors, or arrays of NumPy.

    Returns:
        `x` and `y`, those of the start, whether there may be a solution, and whether this is it: each `(*B, N)`.
    """
    terms = Terms.of(coefficients)
    x, y = coordinates(points)
    ahead = None
    if terms.tilt is not None:
        x, y, inverse_depth = terms.tilt.undo(x, y)
        ahead = inverse_depth > 0
    target = x, y
    rho_squared = plus_product(x * x, y, y)
    start_x, start_y = _start(terms, target, rho_squared, InverseTable(plan.rho_max, plan.ratio))
    x, y = newton(terms, target, start_x, start_y, steps=NEWTON_STEPS[dtype])
    possible = rho_squared <= (plan.reach * plan.reach).clip(None, torch.finfo(dtype).max)[..., None]
    possible = possible if ahead is None else possible & ahead
    solved = _solves(terms, target, rho_squared, plan.domain, plan.noise, x, y, dtype) & possible
    return x, y, start_x, start_y, possible, solved


def _start(terms: Terms, target: Any, rho_squared: Values, table: InverseTable) -> Any:
    """The inverse of the radial terms, with the tangential and prism ones taken along to first order."""
    x, y = target
    along = plus_product(x * terms.two_p2, y, terms.two_p1)
    aside_x, aside_y = (polynomial(rho_squared, part) for part in (terms.sideways_x, terms.sideways_y))
    outward = plus_product(plus_product(along, x, aside_x), y, aside_y)
    bent = rho_squared * (terms.above[0] - terms.below[0] if terms.below else terms.above[0])
    outward = outward * ((1 - bent) / (1 + bent)).clip(0.0, MOST_STRETCHED)  # where the terms act, farther out or in
    inner = minus_product(rho_squared, rho_squared, (2 * outward).clip(-MOST_OUTWARD, MOST_OUTWARD))
    ratio = table.ratio_at(inner)
    square = ratio * ratio
    scale, aside = minus_product(terms.one, along, square) * ratio, square * ratio * rho_squared
    return minus_product(x * scale, aside, aside_x), minus_product(y * scale, aside, aside_y)


def _solves(
    terms: Terms,
    target: Any,
    rho_squared: Values,
    domain: Values,
    noise: Values,
    x: Values,
    y: Values,
    dtype: torch.dtype,
) -> Any:
    """Whether `(x, y)` lies in the domain and is distorted to the target, whose squared radius is `rho_squared`."""
    share = 1 if terms.tilt is None else TILT_FACTOR
    tolerance = (share * TOLERANCE[dtype] * torch.finfo(dtype).eps * noise)[..., None]
    off_x, off_y, s = residual(terms, target, x, y)
    off_squared = plus_product(off_x * off_x, off_y, off_y)
    return (off_squared <= tolerance * tolerance * rho_squared) & (s <= squared_domain(domain))


def _solve_remaining(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor, left: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve the points that have not converged: by one more Newton step, then in float64.

    There they take two Newton steps, then global ones.

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
    lens = coefficients, domain, noise
    x, y, solved = _once_more(*lens, points, x, y, left, index)
    index = (left & ~solved).nonzero(as_tuple=True)
    if index[0].numel() == 0:
        return x, y, left & solved
    picked = *_lens_of_each(index, *lens), points[index]
    found_x, found_y, solved = _solved_by_newton(*picked, x[index], y[index])
    unsolved = (~solved).nonzero(as_tuple=True)
    if unsolved[0].numel():
        answer = _solved_globally(*(part[unsolved] for part in (*picked, found_x, found_y)))
        found_x, found_y, solved = (
            whole.index_put(unsolved, part) for whole, part in zip((found_x, found_y, solved), answer, strict=True)
        )
    return x.index_put(index, found_x), y.index_put(index, found_y), left.index_put(index, solved)


def _lens_of_each(index: tuple[Tensor, ...], *lens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Coefficients `(n, k)`, domain `(n,)` and noise `(n,)` for each of the picked points."""
    coefficients, domain, noise = (part[index[:-1]] for part in lens)
    count = index[0].numel()
    return coefficients.expand(count, -1), domain.expand(count), noise.expand(count)


def _once_more(
    coefficients: Tensor,
    domain: Tensor,
    noise: Tensor,
    points: Tensor,
    x: Tensor,
    y: Tensor,
    left: Tensor,
    index: tuple[Tensor, ...],
) -> tuple[Tensor, Tensor, Tensor]:
    """One more Newton step of the points that are left, in their dtype, and which it solves.

    Where they are many all points take it, which costs less than to pick them. Each is moved in the same way.
    """
    if index[0].numel() > MANY * left.numel():
        step_x, step_y, solved = _stepped_and_checked(coefficients, domain, noise, points, x, y)
        return torch.where(left, step_x, x), torch.where(left, step_y, y), solved
    lens, place = _lens_of_each(index, coefficients, domain, noise), (x[index].unsqueeze(-1), y[index].unsqueeze(-1))
    step_x, step_y, solved = _one_by_one(_stepped_and_checked(*lens, points[index].unsqueeze(-2), *place))
    return x.index_put(index, step_x), y.index_put(index, step_y), left.index_put(index, solved)


def _stepped_and_checked(
    coefficients: Tensor, domain: Tensor, noise: Tensor, points: Tensor, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """A Newton step from `(x, y)`, each `(*B, N)`, and whether it leads to a solution."""
    terms = Terms.of(coefficients)
    target = untilted(terms, points)
    x, y = newton(terms, target, x, y, steps=1)
    rho_squared = torch.addcmul(target[0] * target[0], target[1], target[1])
    return x, y, _solves(terms, target, rho_squared, domain, noise, x, y, x.dtype)


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
    """The global search. One lens for each of `n` points."""
    terms = Terms.of(in_float64(coefficients))
    goal_x, goal_y = in_float64(points).split(1, dim=-1)
    target = untilted(terms, in_float64(points).unsqueeze(-2))
    enough = (torch.finfo(goal_x.dtype).eps * torch.hypot(goal_x, goal_y)) ** 2
    start_x, start_y = (in_float64(part).unsqueeze(-1).nan_to_num(0.0, 0.0, 0.0) for part in (x, y))
    radius = in_float64(domain).unsqueeze(-1)
    found = global_newton(terms, (goal_x, goal_y), start_x, start_y, radius, enough)
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
