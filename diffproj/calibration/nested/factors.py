"""A second start for a rational lens: a factor that stands both above and below its line.

Such a factor changes nothing of the lens, and leads away from the poles and folds of its neighbourhood. So the poorer
lens with a factor is another place to start from, and some minima are found from there alone. Where a factor helps it
does so at once: after a few steps it is lower than the end of the other way. Those few steps are taken side by side
with the first ones of that, which hardly takes longer; where the first minimum makes sense, only what is lower goes on.
"""

import math
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.options import Progress
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.fitting.two_poses import view_costs
from diffproj.calibration.problem.parametrisation import Pose
from diffproj.calibration.trust.entangled import DENOMINATOR

FACTORS = ((30.0, 225.0), (3.0, 2.25))
"""Terms in r^2 and r^4, with r in half diagonals of the image, of factors above and below the line: squares of positive
ones, so that they have no pole. Where the first minimum makes sense, all that the second finds the first does, too."""
RADIAL = ("k1", "k2", "k3", *DENOMINATOR)
"""The terms above and below the line."""
FEW_STEPS = 30
"""Steps that both starts take side by side."""


def aside(
    task: Task,
    shared: Tensor,
    local: Pose,
    size: tuple[int, int],
    *,
    reject: float | None,
    max_iterations: int,
    tolerance: float,
    progress: Progress | None = None,
) -> tuple[Fit, Fit | None]:
    """The minima from a start, and where a few steps from the same with the first factor lead.

    Args:
        task: what is minimised, with a rational lens.
        shared: where it starts `(P, s)`.
        local: the poses there.
        size: of the image.
        reject: robust standard deviations beyond which a corner is an outlier.
        max_iterations: of the solver.
        tolerance: of the solver.
        progress: is told of the steps.

    Returns:
        Both; `None` where there is no such start.
    """
    options: dict[str, Any] = {"reject": reject, "tolerance": tolerance, "progress": progress}
    begin = with_factor(task, shared, size, FACTORS[0])
    if begin is None:
        return fit(task, shared, local, max_iterations=max_iterations, **options), None
    every = torch.arange(len(shared), device=shared.device)
    limits = torch.tensor([max_iterations, min(max_iterations, FEW_STEPS)], device=shared.device)
    both = fit(
        task.part(every.repeat(2)),
        torch.cat([shared, begin]),
        tuple(torch.cat([z, z]) for z in local),
        max_iterations=limits.repeat_interleave(len(shared)),
        **options,
    )
    return both.part(every), both.part(every + len(shared))


def with_factor(task: Task, shared: Tensor, size: tuple[int, int], factor: tuple[float, float]) -> Tensor | None:
    """The shared parameters `(P, s)` with a factor of `FACTORS`; `None` where not all terms of both sides are free."""
    terms = [task.names.index(name) for name in RADIAL]
    if task.basis is not None and not bool((task.basis[:, terms] != 0).any(-1).all()):
        return None
    squared = (shared[:, :2].mean(-1) / (0.5 * math.hypot(*size))).square()
    a, b = factor[0] * squared, factor[1] * squared.square()
    multiplied = shared.clone()
    for side in (terms[:3], terms[3:]):
        one, two, three = shared[:, side].unbind(-1)
        multiplied[:, side] = torch.stack([one + a, two + a * one + b, three + a * two + b * one], dim=-1)
    return multiplied


def data_cost(found: Fit) -> Tensor:
    """What the corners alone cost, without priors `(P,)`."""
    costs = view_costs(found.task, found.solution.shared, found.solution.local)
    return (costs if found.task.shares is None else costs * found.task.shares).sum(-1)
