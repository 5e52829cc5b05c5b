"""A lens with a denominator is kept from folding inside its own image.

The six radial terms of a rational lens nearly cancel each other, so that its unrestrained minimum may have a pole or a
fold where corners were seen: the terms above and below the line go to zero together, a hair apart, and buy a
fraction of the noise. Then the terms below the line, k4 to k6, are drawn towards those of the poorer lens that the fit
starts from, 0 if it has none, as little as makes the lens one-to-one over its corners and the image. As the start costs
nothing by this, a restrained lens does not end above the poorer one either; but where only another one reaches the
whole image, it may. Then what the poorer lens lacks, a prism or a tilt, is held at 0, too.

Of several minima without restraint one may make sense. The solver starts again from the poorer lens with factors
(`factors.py`), which lead away from the poles. And the terms are held: then the valley is short, and its lowest place
is found; from there they are let go step by step, as long as the lens does not fold. Either may end lower, so that both
are done. But factors may also lead to a needle in the image's middle, no lower than chance makes it, or with focal
lengths left open: that is not taken.

Where the first minimum makes sense none that is lower is found by holding terms, and by factors only what looks lower
after a few steps.
"""

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.second_look import LOWER
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Prior
from diffproj.calibration.nested.compared import costs, put, unrestrained_cost
from diffproj.calibration.nested.factors import FACTORS, with_factor
from diffproj.calibration.problem.parametrisation import INTRINSICS, Pose
from diffproj.calibration.trust.reach import folds_at_corners, reach_of
from diffproj.lens.brown_domain import RADIUS_POWERS
from diffproj.lens.models import DENOMINATOR, MODELS

FIRST = 1.0
"""Deviation to which the terms below the line are held at first: what each adds to the denominator half an image's
diagonal from the axis, where 1 is as much as there is without it."""
TIGHTER = (0.3, 0.1, 0.03, 0.01)
"""Then these, one after the other until the lens does not fold."""
LOOSER = (3.0, 10.0, 30.0, math.inf)
"""Or these, as long as it does not."""
HELD = 1e-6
"""Deviation to which all that a poorer lens lacks is held that the fit would else end above: as good as 0."""
RUNG_STEPS = 100
"""Steps of the solver at one of these, where with the terms held most take ten to twenty; and steps after which only
the lower of the starts with factors goes on."""
HAIR = 1.1
"""Factor of the cost that is paid to make a lens that reaches all of its corners reach the whole image, too."""
PROMISING = 0.1
"""Residuals' worth of noise by which a start with a factor must be lower after a few steps to go on to its end."""
WORTH, OPEN = 1.0, 0.05
"""Residuals' worth of noise by which one from a start with factors must be lower; and the deviation of a focal length
or principal point, relative to the focal length, above which it is not taken: at twice that the views are refused."""


def restrained(
    found: Fit,
    shared: Tensor,
    poses: Pose,
    size: tuple[int, int],
    aside: Fit | None = None,
    *,
    hold: bool = True,
    reject: float | None,
    max_iterations: int,
    tolerance: float,
) -> tuple[Fit, Tensor]:
    """The lowest fit whose lens does not fold; `Fit.task.prior` then holds what restrains it, if anything does.

    With it, for which cameras there is none `(P,)`: the lens folds before its own corners, or the solver came to no
    end, or the corners do not determine the lens, as where its terms go to infinity.

    Args:
        found: the minimum without restraint.
        shared: `(P, s)` of the fit of a poorer lens.
        poses: of that fit.
        size: of the image.
        aside: where a few steps from there with a factor lead.
        hold: whether lenses that fold are to be restrained. If not, what does not reach the whole image counts as such.
        reject: robust standard deviations beyond which a corner is an outlier.
        max_iterations: of the solver.
        tolerance: of the solver.
    """
    task, names = found.task, found.task.names
    below = [names.index(name) for name in MODELS[task.lens].below]
    if task.basis is not None:
        below = [i for i in below if bool(task.basis[:, i].any())]
    spare = found.degrees_of_freedom().to(found.solution.cost)
    if not below or not bool((spare > 0).any()):
        return found, torch.zeros_like(found.rejected[:, 0, 0])
    best, reached = found, reach_of(found, size).masked_fill(~_is_determined(found), -1.0)
    lost = reached < 0
    which = ((spare > 0) & (reached < 1)).nonzero().flatten()

    def weighed(which: Tensor, other: Fit, allowed: Tensor, lower: Tensor | float = LOWER) -> Tensor:
        """Which of the others `(n,)` do not fold; they are kept where they are allowed, and better."""
        nonlocal best, reached
        first, cost = costs(found, other, which, reject)
        reach = torch.where(allowed & (lost[which] | (cost <= HAIR * first)), reach_of(other, size), -1.0)
        lowest, cost = costs(best, other, which, reject)
        better = allowed & ((reach > reached[which]) | ((reach == reached[which]) & (cost < lowest * (1 - lower))))
        best = put(best, which[better], other, better)
        reached[which] = reach.maximum(reached[which])
        return reach >= 1

    steps: dict[str, Any] = {"max_iterations": max_iterations, "tolerance": tolerance}
    given = replace(task, used=task.used | found.rejected)

    def ended(which: Tensor, near: Fit) -> None:
        """Some cameras `(n,)` from near the end of a start with a factor."""
        other = fit(given.part(which), near.solution.shared, near.solution.local, reject=reject, **steps)
        weighed(which, other, knows_focal(other), WORTH / spare[which])

    if aside is not None:
        first, cost = costs(found, aside, torch.arange(len(spare), device=spare.device), reject)
        lower = ((spare > 0) & (reached >= 1) & (cost < first * (1 - PROMISING / spare))).nonzero().flatten()
        if len(lower) > 0:
            ended(lower, aside.part(lower))
    if len(which) == 0 or not hold:
        return best, reached < 0 if hold else reached < 1
    start = fit(given, shared, poses, max_iterations=0)
    precision = _unit_precision(start, below, size)

    def tried(which: Tensor, strength: float, near: Fit) -> tuple[Fit, Tensor]:
        """Those of the cameras `(n,)` at that strength, from `near` `(n, ...)`; and which of them do not fold."""
        part = given.part(which)
        if strength < math.inf:
            part = replace(part, prior=_drawn_to(shared[which], precision[which] / strength**2, part))
        limits: dict[str, Any] = (
            steps if strength == math.inf else steps | {"max_iterations": min(max_iterations, RUNG_STEPS)}
        )
        other = fit(part, near.solution.shared, near.solution.local, reject=reject, **limits)
        return other, weighed(which, other, _is_determined(other))

    first, sound = tried(which, FIRST, start.part(which))
    up, near = which[sound], first.part(sound.nonzero().flatten())
    for strength in LOOSER:
        if len(up) == 0:
            break
        near, sound = tried(up, strength, near)
        up, near = up[sound], near.part(sound.nonzero().flatten())
    starts = [
        (with_factor(start.task, start.solution.shared, size, factor), start.solution.local) for factor in FACTORS
    ]
    if aside is not None:
        starts[0] = aside.solution.shared, aside.solution.local
    if starts[0][0] is not None:
        begin = torch.cat([parameters[which] for parameters, _ in starts if parameters is not None])
        local = tuple(
            torch.cat([z[which] for z in parts]) for parts in zip(*(poses for _, poses in starts), strict=True)
        )
        short: dict[str, Any] = steps | {"max_iterations": min(max_iterations, RUNG_STEPS)}
        near = fit(given.part(which.repeat(len(starts))), begin, local, reject=reject, **short)
        folds = folds_at_corners(near.task, near.solution.shared, near.solution.local)
        lowest = torch.where(folds, torch.inf, unrestrained_cost(near)).reshape(len(starts), -1).argmin(0)
        ended(which, near.part(lowest * len(which) + torch.arange(len(which), device=which.device)))
    down = which[reached[which] < 1]
    for strength in TIGHTER:
        if len(down) == 0:
            break
        tried(down, strength, start.part(down))
        down = down[reached[down] < 1]
    return best, reached < 0


def not_above(
    found: Fit,
    poorer: Fit,
    prior: Prior | None,
    size: tuple[int, int],
    *,
    reject: float | None,
    max_iterations: int,
    tolerance: float,
) -> Fit:
    """The fit, with cameras held to a poorer lens that is lower there, and reaches as far.

    Args:
        found: the lowest fit whose lens does not fold.
        poorer: that of a poorer lens.
        prior: what is known beforehand, without restraint.
        size: of the image.
        reject: robust standard deviations beyond which a corner is an outlier.
        max_iterations: of the solver.
        tolerance: of the solver.
    """
    every = torch.arange(len(found.rejected), device=found.rejected.device)
    before, now = costs(found, poorer, every, reject)
    rows = (now < before * (1 - LOWER)).nonzero().flatten()
    if len(rows) > 0:
        reached, reaches = (reach_of(one.part(rows), size) for one in (found, poorer))
        rows = rows[reaches >= reached]
    if len(rows) == 0:
        return found
    near = poorer.part(rows)
    task = replace(found.task, used=found.task.used | found.rejected, prior=prior)
    shared, lens = near.solution.shared, range(len(INTRINSICS), task.parameters.lens_end)
    free = [i for i in lens if task.basis is None or bool(task.basis[:, i].any())]
    drawn = [i for i in free if task.names[i] in DENOMINATOR or bool((shared[:, i] == 0).all())]
    part = task.part(rows)
    part = replace(part, prior=_drawn_to(shared, _unit_precision(near, drawn, size) / HELD**2, part))
    limits: dict[str, Any] = {"max_iterations": max_iterations, "tolerance": tolerance}
    other = fit(part, shared, near.solution.local, reject=reject, **limits)
    before, now = costs(found, other, rows, reject)
    taken = (now < before) & (reach_of(other, size) >= reach_of(near, size)) & _is_determined(other)
    return put(found, rows, other, taken)


def unfolded(
    freed: Fit, flat: Fit, size: tuple[int, int], *, reject: float | None, max_iterations: int, tolerance: float
) -> Fit:
    """The fit with free points, with the lenses that folded only once the points were freed restrained again.

    They are drawn to their terms of the fit to the flat target, which did not fold. Other cameras stay to the bit.
    """
    shared, task = flat.solution.shared, freed.task
    if not MODELS[task.lens].below:
        return freed
    rows = folds_at_corners(task, freed.solution.shared, freed.solution.local).nonzero().flatten()
    if len(rows) == 0:
        return freed
    start = torch.nn.functional.pad(shared, (0, freed.solution.shared.shape[-1] - shared.shape[-1]))[rows]
    poses = flat.part(rows).solution.local
    limits: dict[str, Any] = {"reject": reject, "max_iterations": max_iterations, "tolerance": tolerance}
    held, _ = restrained(freed.part(rows), start, poses, size, **limits)
    return put(freed, rows, held, torch.ones_like(rows, dtype=torch.bool))


def knows_focal(found: Fit) -> Tensor:
    """Where focal lengths and principal point are known well enough, and all else is determined `(P,)`."""
    deviation = found.plain_covariance.shared.diagonal(dim1=-2, dim2=-1)[:, :4].sqrt()
    known = (deviation <= OPEN * found.solution.shared[:, (0, 1, 0, 1)].abs()).all(-1)
    return known & _is_determined(found)


def _is_determined(found: Fit) -> Tensor:
    """Where all of the camera that is free is determined `(P,)`; else it is refused."""
    return ~found.plain_covariance.undetermined[:, : found.task.parameters.few].any(-1)


def _unit_precision(start: Fit, drawn: list[int], size: tuple[int, int]) -> Tensor:
    """Precisions `(P, s)` at which a term of 1 half a diagonal from the axis costs what one residual does."""
    shared = start.solution.shared
    variance = 2 * start.solution.cost / start.degrees_of_freedom().clamp(min=1)
    radius = 0.5 * math.hypot(*size) / shared[:, :2].mean(-1)
    precision = torch.zeros_like(shared)
    for i in drawn:
        power = (*RADIUS_POWERS, 1, 1)[i - len(INTRINSICS)]  # of a tilt, that of a decentring
        precision[:, i] = variance * radius ** (2 * power)
    return precision


def _drawn_to(shared: Tensor, precision: Tensor, task: Task) -> Prior:
    """The task's prior with precisions `(P, s)` about shared parameters `(P, s)` added."""
    more = torch.diag_embed(precision)
    if task.prior is None:
        return Prior(torch.where(precision > 0, shared, 0.0), more, torch.zeros_like(more))
    mean, given, *_ = task.prior
    own = given.diagonal(dim1=-2, dim2=-1)
    total = own + precision
    return Prior(torch.where(total > 0, (own * mean + precision * shared) / total, 0.0), given + more, given)
