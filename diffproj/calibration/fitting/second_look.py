"""A second look at doubtful minima: other focal lengths, both poses of each view, and the fit of a poorer lens.

From one start in closed form the solver may end in a side valley: a focal length far off with views turned to fit it, a
lens that stands for what the poses should explain. A camera is looked at again where its first minimum is doubtful:

* the solver did not converge, or took many steps, as it does in narrow valleys, or
* where outliers were rejected, neighbouring corners are off in the same direction, as noise is not, or
* a view fits far worse than the others, as one does that is turned over where a long lens bends to the rest.

Then starts compete. The best focal lengths of a grid (`focal_grid`), with and without the lens's first estimate, are
solved side by side, and what ends lowest is kept, or what is reached from it with the principal point at the image's
middle or on another side of it, or with views turned over (`turned_views`). Who is still lost then, with the principal
point far outside the image, climbs a ladder of focal lengths (`focal_ladder`), or as a fisheye starts from a grid of
principal points. A minimum is only ever replaced by a lower one, or by one as low where the solver came to an end.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffproj._core.numerics import spread_evenly
from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.focal_grid import SAMPLE_VIEWS, start_at, starts_around, starts_on_grid
from diffproj.calibration.fitting.focal_ladder import (
    LADDER,
    climbed,
    far_out,
    moves_focal_length,
    moves_principal_point,
)
from diffproj.calibration.fitting.start import Straightened
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.fitting.turned_views import choices
from diffproj.calibration.fitting.two_poses import mean_squares, replaced
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import INTRINSICS, Parametrisation, Pose
from diffproj.lens.models import MODELS

CORRELATED = 0.65
"""Correlation of the residuals of neighbouring corners from which on they are not noise. (A printed board that is off
its grid by 0.08 mm gives 0.58 at an RMS of 0.16 px.)"""
UNEVEN, TELLING = 4.0, 8
"""Times the median over views that the mean square of the residuals of one must be to fit far worse, and from how many
corners on that tells."""
SAMPLE_POINTS, MOST_PAIRS = 4096, 2**22
"""Corners whose neighbours are looked at, and distances that are held at once."""
MANY_STEPS = 12
"""Steps of the solver from which on a minimum is looked at again."""
SHORT_FIT = 40
"""Steps after which only the best of the starts goes on."""
MAX_TURNS = 3
"""How often views of a camera are turned over, one time after the other."""
ASIDE = 0.05
"""Distance of the principal point from the image's middle, in both directions and relative to the image's longer side,
from which on there may be valleys on four sides of it."""
ALIKE = 1e-7
"""Part of the cost up to which two starts have led to one place."""
LOWER = 1e-9
"""Part of the cost by which another minimum must be lower to replace the first."""


def doubtful(found: Fit, steps_tell: bool, long_valley: bool = False) -> Tensor:
    """Which minima deserve a second look `(P,)`, by their number of steps or by what is left of the residuals."""
    solution = found.solution
    if long_valley:  # along which any start takes many steps, or does not come to an end
        return ~(correlation(found) <= CORRELATED)
    suspicious = solution.iterations > MANY_STEPS if steps_tell else correlation(found) > CORRELATED
    return suspicious | _uneven(found) | (solution.status != Status.CONVERGED)


def _uneven(found: Fit) -> Tensor:
    """Which cameras have a view that fits far worse than the others `(P,)`."""
    squares = mean_squares(found.task, found.solution.equations.c)
    squares = torch.where(found.task.used.sum(-1) >= TELLING, squares, torch.nan)
    return (squares > UNEVEN * squares.nanmedian(-1, keepdim=True).values).any(-1)


def correlation(found: Fit) -> Tensor:
    """Correlation of each corner's residual with that of its nearest neighbour on the target `(P,)`, in some views."""
    V = found.task.used.shape[1]
    some = spread_evenly(V, min(V, SAMPLE_VIEWS), found.task.used.device)
    cut = {name: getattr(found.task, name)[:, some] for name in ("pixels", "used")}
    task = replace(found.task, **cut, whitening=None)
    poses = tuple(z[:, some] for z in found.solution.local)
    residual = task.problem.linearise(found.solution.shared, poses)[:, :, -1]
    N = len(task.points)
    each = spread_evenly(N, min(N, SAMPLE_POINTS), task.points.device)
    nearest = _nearest(task.points, each)
    both = (task.used[..., each] & task.used[..., nearest]).unsqueeze(2)
    own = residual[..., each]
    product = torch.where(both, own * residual[..., nearest], 0.0).sum((1, 2, 3))
    return product / torch.where(both, own.square(), 0.0).sum((1, 2, 3)).clamp(min=1e-300)


def _nearest(points: Tensor, some: Tensor) -> Tensor:
    """The nearest other point of some `(n,)` of the points `(N, 3)`; of several as near, the first."""
    found = []
    for rows in some.split(max(1, MOST_PAIRS // len(points))):
        apart = torch.cdist(points[rows], points)
        apart[torch.arange(len(rows), device=points.device), rows] = torch.inf
        found.append(apart.argmin(-1))
    return torch.cat(found)


def second_look(
    found: Fit,
    straight: Straightened,
    *,
    reject: float | None,
    max_iterations: int,
    tolerance: float,
    long_valley: bool = False,
) -> Fit:
    """The lower of the first minimum and those from other starts, for each camera.

    Args:
        found: the first minimum.
        straight: the corners as the first estimate of the lens straightens them.
        reject: robust standard deviations beyond which a corner is an outlier.
        max_iterations: of the solver. Who allows it fewer steps than a start is judged by gets the first minimum.
        tolerance: of the solver.
        long_valley: whether the last steps to any minimum are many, as with a rational lens or a prism.
    """
    if max_iterations < SHORT_FIT or found.task.solid:  # points in space have had other starts
        return found
    steps: dict[str, Any] = {"max_iterations": max_iterations, "tolerance": tolerance}
    with torch.inference_mode():
        # Steps that were spent on rejecting outliers say nothing.
        which = doubtful(found, steps_tell=reject is None, long_valley=long_valley).nonzero().flatten()
        if len(which) == 0:
            return found
        task = replace(found.task, used=found.task.used | found.rejected).part(which)
        first = found.solution.shared[which]
        lenses = [straight.part(which)]
        if bool(straight.lam.any()):
            lenses.append(lenses[0].without_lens())
        if straight.lens == "none":
            lenses.append(lenses[0].elsewhere(task))
        starts = [start for lens in lenses for start in starts_on_grid(task, first, lens)]
    last = _lowest_of(task, starts, reject, steps)
    found = lower_fit(found, last, which, reject)
    if straight.lens == "fisheye":
        found = _from_other_middles(found, straight, which, reject, steps)
    short: dict[str, Any] = steps | {"max_iterations": SHORT_FIT}
    if moves_principal_point(task):
        found = _with_other_principal_points(found, straight.middle[which], which, short, steps, reject)
    if straight.lens == "none" and MODELS[straight.model].count:
        found = _along_focal_lengths(found, straight, which, reject, steps)
    return found if reject is not None else _with_views_turned_over(found, which, short, steps)


def _lowest_of(task: Task, starts: Sequence[tuple[Tensor, Pose]], reject: float | None, steps: dict[str, Any]) -> Fit:
    """The lowest fit of each of P cameras from any of the starts, with the first coefficient of the lens and then all.

    Side by side, as one batch: the time of few views is that of the calls. Only the best goes on to the end.
    """
    P = len(task.used)
    every = torch.arange(P, device=task.used.device).repeat(len(starts))
    shared = torch.cat([shared for shared, _ in starts])
    poses = tuple(torch.cat(parts) for parts in zip(*(poses for _, poses in starts), strict=True))
    short: dict[str, Any] = steps | {"max_iterations": SHORT_FIT}
    own = torch.ones(len(starts), P, dtype=torch.bool, device=every.device)
    with torch.inference_mode():
        poorer = _poorer(task.part(every))
    if poorer is not None:
        near = fit(poorer, shared, poses, **short).solution
        shared, poses = near.shared, near.local
        own = _first_of_alike(near.cost.reshape(own.shape))
    kept = own.flatten()
    others = fit(task.part(every[kept]), shared[kept], tuple(z[kept] for z in poses), reject=reject, **short)
    number = (kept.cumsum(0) - 1).reshape(own.shape)
    best = others.part(number[0])
    for rank in range(1, len(starts)):
        rows = own[rank].nonzero().flatten()
        best = lower_fit(best, others.part(number[rank, rows]), rows, reject)
    return fit(task, best.solution.shared, best.solution.local, reject=reject, **steps)


def _from_other_middles(
    found: Fit, straight: Straightened, which: Tensor, reject: float | None, steps: dict[str, Any]
) -> Fit:
    """The fit of those of some cameras `(n,)` that are lost, from principal points far from the image's middle.

    An image that was cut out of a fisheye's larger one may show none of its axis.
    """
    part = found.part(which)
    if not moves_principal_point(part.task):
        return found
    rows = _lost(part)
    if len(rows) == 0:
        return found
    with torch.inference_mode():
        task = replace(part.task, used=part.task.used | part.rejected).part(rows)
        starts = starts_around(task, part.solution.shared[rows], straight.part(which[rows]))
    return lower_fit(found, _lowest_of(task, starts, reject, steps), which[rows], reject)


def _lost(found: Fit) -> Tensor:
    """The cameras `(n,)` that came to no end, or whose residuals are no noise."""
    lost = (found.solution.status != Status.CONVERGED) | ~(correlation(found) <= CORRELATED)
    return lost.nonzero().flatten()


def _along_focal_lengths(
    found: Fit, straight: Straightened, which: Tensor, reject: float | None, steps: dict[str, Any]
) -> Fit:
    """The fit of those of some cameras `(n,)` that are lost with their principal point far out, by focal lengths."""
    part = found.part(which)
    part = Fit(replace(part.task, used=part.task.used | part.rejected), part.solution, part.rejected)
    if not moves_focal_length(part.task) or not moves_principal_point(part.task):
        return found
    rows = _lost(part)
    if len(rows) > 0:
        rows = rows[far_out(part.part(rows), straight.part(which[rows]))]
    if len(rows) == 0:
        return found
    which, task = which[rows], part.task.part(rows)
    lens = straight.part(which).elsewhere(task)
    starts = [start_at(task, part.solution.shared[rows], lens, lens.longer * rung) for rung in LADDER]
    shared = torch.stack([shared for shared, _ in starts])
    poses = tuple(torch.stack(parts) for parts in zip(*(poses for _, poses in starts), strict=True))
    return lower_fit(found, climbed(task, shared, poses, reject=reject, **steps), which, reject)


def _with_views_turned_over(found: Fit, which: Tensor, short: dict[str, Any], steps: dict[str, Any]) -> Fit:
    """The fit of some cameras `(n,)` with views turned over where that lets all parameters end lower.

    With the shared parameters held a view's other pose may cost a little more, and less when all is solved again.
    """
    for _ in range(MAX_TURNS):
        part = found.part(which)
        rows, starts = choices(part.task, part.solution)
        if len(rows) == 0:
            break
        tried = fit(part.task.part(rows), part.solution.shared[rows], starts, **short)
        costs = tried.solution.cost.nan_to_num(torch.inf)
        lowest = torch.full_like(part.solution.cost, torch.inf).scatter_reduce(0, rows, costs, "amin")
        number = torch.arange(len(rows), device=rows.device)
        best = torch.zeros_like(which).index_put((rows[costs == lowest[rows]],), number[costs == lowest[rows]])
        lower = (lowest < part.solution.cost * (1 - LOWER)).nonzero().flatten()
        if len(lower) == 0:
            break
        near, which = tried.part(best[lower]).solution, which[lower]
        last = fit(found.task.part(which), near.shared, near.local, **steps)
        found = lower_fit(found, last, which, None)
    return found


def _with_other_principal_points(
    found: Fit, middle: Tensor, which: Tensor, short: dict[str, Any], steps: dict[str, Any], reject: float | None
) -> Fit:
    """The fit of some cameras `(n,)`, or what is lower from the principal point elsewhere in the image.

    Of a long lens the principal point is hardly known, and with it decides which way the coefficients bend the image:
    there are valleys on both sides of the middle `(n, 2)`, where it is far off in both directions, on four; and another
    may be reached from the middle itself.
    """
    part = found.part(which)
    solution, task = part.solution, replace(part.task, used=part.task.used | part.rejected)
    both = ~((solution.shared[:, 2:4] - middle).abs().amin(-1) <= ASIDE * 2 * middle.amax(-1))
    every = torch.arange(len(which), device=which.device)
    starts = [every, every, every[both], every[both]]
    sides = middle.new_tensor([(1.0, 1.0), (0.5, 0.5), (1.0, 0.0), (0.0, 1.0)])
    counts = torch.tensor([len(some) for some in starts], device=which.device)
    rows, sides = torch.cat(starts), sides.repeat_interleave(counts, dim=0)
    start = _elsewhere(task.parameters, solution.shared[rows], part.part(rows).solution.local, middle[rows], sides)
    tried = fit(task.part(rows), *start, reject=reject, **short)
    best = tried.part(every)
    for some, numbers in zip(
        starts[1:], torch.arange(len(rows), device=rows.device).split(counts.tolist())[1:], strict=True
    ):
        best = lower_fit(best, tried.part(numbers), some, reject)
    last = fit(task, best.solution.shared, best.solution.local, reject=reject, **steps)
    return lower_fit(found, last, which, reject)


def _elsewhere(
    parameters: Parametrisation, shared: Tensor, poses: Pose, middle: Tensor, sides: Tensor
) -> tuple[Tensor, Pose]:
    """The same with the principal point elsewhere, views shifted and no lens.

    It is mirrored at the middle where `sides (n, 2)` are 1, and at it where they are a half.
    """
    shared, (R, t) = shared.clone(), poses
    moved = 2 * (middle - shared[:, 2:4]) * sides
    lens = slice(len(INTRINSICS), parameters.lens_end)
    # What is not the pinhole's goes back to nothing, and the views to where they are seen in the same place.
    shared[:, lens], shared[:, 2:4] = 0.0, shared[:, 2:4] + moved
    aside = (moved / shared[:, :2]).unsqueeze(1) * t[..., 2:]
    return shared, (R, t - torch.nn.functional.pad(aside, (0, 1)))


def _first_of_alike(costs: Tensor) -> Tensor:
    """Which of the starts `(S, P)` of each camera end with a cost that none before them has; the first always does."""
    same = (costs.unsqueeze(0) - costs.unsqueeze(1)).abs() <= ALIKE * costs.abs()  # (later, earlier, P)
    before = torch.ones(len(costs), len(costs), dtype=torch.bool, device=costs.device).tril(-1)
    return ~(same & before.unsqueeze(-1)).any(1)


def _poorer(task: Task) -> Task | None:
    """The same with all coefficients of the lens held but the first; `None` where it has no more."""
    names = task.parameters.names
    late = [i for i, name in enumerate(names) if name in task.parameters.coefficient_names[1:]]
    if not late:
        return None
    return task.holding(late)


def lower_fit(found: Fit, other: Fit, which: Tensor, reject: float | None) -> Fit:
    """The fit with the minima of some cameras `(n,)` replaced where the others are lower.

    Or as low, where the solver came to an end there and did not here: a long valley is left a hair above its lowest
    place.
    """
    before, now = found.solution.cost[which], other.solution.cost
    ended = (found.solution.status[which] != Status.CONVERGED) & (other.solution.status == Status.CONVERGED)
    if reject is not None:
        before, now = truncated(found, other, which, reject)
    margin = torch.full_like(before, 1 - LOWER).masked_fill(ended, 1 + LOWER)
    lower = now.isfinite() & ~(now >= before * margin)
    return exchanged(found, other, which, lower)


def exchanged(found: Fit, other: Fit, which: Tensor, where: Tensor) -> Fit:
    """The fit with that of some cameras `(n,)` replaced by another, where that says so."""
    taken = which[where]
    if len(taken) == 0:
        return found
    used, rejected, whitening = found.task.used.clone(), found.rejected.clone(), found.task.whitening
    used[taken], rejected[taken] = other.task.used[where], other.rejected[where]
    if whitening is not None and other.task.whitening is not None:
        whitening = whitening.index_put((taken,), other.task.whitening[where])
    solution = replaced(found.solution, taken, other.solution, where)
    return Fit(replace(found.task, used=used, whitening=whitening), solution, rejected)


def truncated(found: Fit, other: Fit, which: Tensor, reject: float) -> tuple[Tensor, Tensor]:
    """Costs `(n,)` of two fits that reject different corners: all corners count, each at most at the limit."""
    given = replace(found.task, used=found.task.used | found.rejected).part(which)
    residuals = []
    for fitted, rows in ((found, which), (other, torch.arange(len(which), device=which.device))):
        shared, poses = fitted.solution.shared[rows], tuple(z[rows] for z in fitted.solution.local)
        residual = given.problem.linearise(shared, poses)[:, :, -1].square().sum(2)
        residuals.append(residual.nan_to_num(torch.inf) if given.weights is None else residual * given.weights)
    sigma = torch.stack(
        [torch.where(given.used, r, torch.nan).flatten(1).nanmedian(-1).values for r in residuals]
    ).amin(0)
    limit = (reject**2 * sigma / 1.386).clamp(min=1e-24)[:, None, None]  # the median of |e|^2 is 1.386 sigma^2
    one, two = (torch.where(given.used, r.minimum(limit), 0.0).sum(-1) for r in residuals)
    if given.shares is not None:
        one, two = one * given.shares, two * given.shares
    return one.sum(-1), two.sum(-1)
