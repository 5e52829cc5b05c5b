"""A lens with a denominator is kept from folding inside its own image.

The six radial terms of a rational lens nearly cancel each other, so that its unrestrained minimum may have a pole or a
fold where corners were seen: the terms above and below the line go to zero together, a hair apart, and buy a
fraction of the noise. Then the terms below the line, k4 to k6, are drawn towards 0, as little as makes the lens
one-to-one over its corners and the image. At 0 they are the lens without them, from whose minimum the solver starts:
the restrained lens never ends above it.
"""

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fit import Fit, fit
from diffproj.calibration.parametrisation import Pose
from diffproj.calibration.reach import folds_at_corners, reaches_image
from diffproj.calibration.solver import Prior, Status
from diffproj.calibration.task import Task
from diffproj.calibration.two_poses import replaced, view_costs

DENOMINATOR = ("k4", "k5", "k6")
STRENGTHS = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Deviations to which the terms below the line are held, one after the other until the lens does not fold: what each
adds to the denominator half an image's diagonal from the axis, where 1 is as much as there is without it."""
HAIR = 1.1
"""Factor of the cost that is paid to make a lens that reaches all of its corners reach the whole image, too."""


def restrained(
    found: Fit,
    shared: Tensor,
    poses: Pose,
    size: tuple[int, int],
    *,
    reject: float | None,
    max_iterations: int,
    tolerance: float,
) -> Fit:
    """The fit with lenses that fold replaced by restrained ones; `Fit.task.prior` then holds what restrains them.

    Args:
        found: the minimum without restraint.
        shared: `(P, s)` of a fit with nothing below the line.
        poses: of that fit.
        size: of the image.
        reject: robust standard deviations beyond which a corner is an outlier.
        max_iterations: of the solver.
        tolerance: of the solver.
    """
    task, names = found.task, found.task.names
    below = [names.index(name) for name in DENOMINATOR if name in names]
    if task.basis is not None:
        below = [i for i in below if bool(task.basis[:, i].any())]
    if not below:
        return found
    steps: dict[str, Any] = {"max_iterations": max_iterations, "tolerance": tolerance}
    lost = folds_at_corners(task, found.solution.shared, found.solution.local)
    lost |= found.solution.status != Status.CONVERGED
    reached = torch.where(lost, -1.0, reaches_image(task, found.solution.shared, size))
    which = ((reached < 1) & (found.degrees_of_freedom() > 0)).nonzero().flatten()
    if len(which) == 0:
        return found
    given = replace(task, used=task.used | found.rejected).part(which)
    poorer = given.holding(below)
    start = fit(poorer, shared[which], tuple(z[which] for z in poses), reject=reject, **steps)
    precision = _unit_precision(start, below, size)
    left = torch.arange(len(which), device=which.device)
    for strength in STRENGTHS:
        prior = _drawn_to_zero(given.part(left), precision[left] / strength**2)
        tried = fit(
            replace(given.part(left), prior=prior),
            start.solution.shared[left],
            tuple(z[left] for z in start.solution.local),
            reject=reject,
            **steps,
        )
        rows = which[left]
        sound = ~folds_at_corners(tried.task, tried.solution.shared, tried.solution.local)
        sound &= tried.solution.status == Status.CONVERGED
        sound &= lost[rows] | (_data_cost(tried) <= HAIR * found.solution.cost[rows])
        reach = torch.where(sound, reaches_image(tried.task, tried.solution.shared, size), -1.0)
        better = reach > reached[rows]
        if bool(better.any()):
            found = _put(found, rows[better], tried, better)
            reached[rows] = reach.maximum(reached[rows])
        left = left[reach < 1]
        if len(left) == 0:
            break
    return found


def _unit_precision(start: Fit, below: list[int], size: tuple[int, int]) -> Tensor:
    """Precisions `(P, s)` at which a term of 1 half a diagonal from the axis costs what one residual does."""
    shared = start.solution.shared
    variance = 2 * start.solution.cost / start.degrees_of_freedom().clamp(min=1)
    squared = (0.5 * math.hypot(*size) / shared[:, :2].mean(-1)).square()
    precision = torch.zeros_like(shared)
    for i in below:
        precision[:, i] = variance * squared ** (2 * (1 + DENOMINATOR.index(start.task.names[i])))
    return precision


def _drawn_to_zero(task: Task, precision: Tensor) -> Prior:
    """The task's prior with precisions `(P, s)` about 0 added."""
    more = torch.diag_embed(precision)
    if task.prior is None:
        return Prior(torch.zeros_like(precision), more, torch.zeros_like(more))
    mean, given, *_ = task.prior
    own = given.diagonal(dim1=-2, dim2=-1)
    total = own + precision
    return Prior(torch.where(total > 0, own * mean / total, 0.0), given + more, given)


def _data_cost(found: Fit) -> Tensor:
    return view_costs(found.task, found.solution.shared, found.solution.local).sum(-1)


def _put(found: Fit, which: Tensor, other: Fit, taken: Tensor) -> Fit:
    """The fit with some cameras `(n,)` replaced by the others that are taken, their priors included."""
    task = found.task
    used, rejected = task.used.clone(), found.rejected.clone()
    used[which], rejected[which] = other.task.used[taken], other.rejected[taken]
    shared = found.solution.shared
    nothing = shared.new_zeros(*shared.shape, shared.shape[-1])
    prior = task.prior or Prior(torch.zeros_like(shared), nothing, nothing)
    parts = [prior.mean, prior.precision, prior.precision if prior.known is None else prior.known]
    new = Prior(*(a.index_put((which,), b[taken]) for a, b in zip(parts, other.task.prior[:3], strict=True)))  # type: ignore
    solution = replaced(found.solution, which, other.solution, taken)
    return Fit(replace(task, used=used, prior=new), solution, rejected)
