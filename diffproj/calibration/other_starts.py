"""Minima of `refine` from other poses and focal lengths, where few corners leave several.

Where corners hardly outnumber the unknowns, lie nearly on a line, or are explained badly, intrinsics and pose take up
each other's errors: the minimum next to the pose that the camera as given explains best need not be the lowest, and may
lie where the lens folds. So several focal lengths are tried, each with the poses that explain the corners best then,
all side by side in one batch. Only the lowest of them goes on to its minimum, and only where it is below the first.

The minima are compared as they are: on the same corners, and with the likelihood of uncertain landmarks' errors.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit, normal_tensors
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.second_look import LOWER, exchanged
from diffproj.calibration.fitting.start import candidate_poses
from diffproj.calibration.fitting.surveyed import FINEST_PX
from diffproj.calibration.fitting.task import Task, solved
from diffproj.calibration.fitting.two_poses import tilted_poses
from diffproj.calibration.least_squares.solver import Solution, Status
from diffproj.calibration.outcome import Begun
from diffproj.calibration.problem.parametrisation import POSE, Pose
from diffproj.calibration.results.ambiguity import difference
from diffproj.calibration.results.remark import Kind, Remark, Remarks
from diffproj.calibration.trust.noise import times_less_likely
from diffproj.calibration.trust.other_poses import APART, typical_noise
from diffproj.calibration.trust.reach import folds_at_corners

SPARE = 3
"""Coordinates of corners beyond the unknowns, priors not counted, below which other minima are always looked for."""
LINE, LINE_CORNERS = 0.15, 12
"""Extent of corners across a line, relative to that along it, up to which so many of a view lie nearly on it."""
POOR = 9.0
"""Mean square of a residual's coordinate, in the noise's variance or in px^2, above which a fit explains too little."""
FEW_VIEWS, FEW_CORNERS = 4, 40
"""Views and corners up to which other starts are looked for: more have had better ones."""
FOCAL = (1.0, 0.5, 0.7, 1.4, 2.0)
"""Focal lengths to start from, in that of the camera."""
SHORT_FIT = 50
"""Steps after which only the best of the starts goes on: with 20 of them some valleys' lowest places are not seen."""
NEAR = 1e-6
"""Part of the cost that another of these steps need not gain."""
FEWEST_STEPS = 40
"""Steps that the solver must be allowed: who wants fewer gets where they lead from the start."""
NEARLY = 20.0
"""Ratio of likelihoods up to which another minimum is spoken of."""
ANOTHER = "another camera and pose explain the corners nearly as well"


class Rivals(NamedTuple):
    """Of each camera the lowest of other minima that lie beyond the error bars of the one that is taken.

    Attributes:
        ratio: how many times less likely it is `(P,)`; infinite where there is none.
        focal: its focal length f_x `(P,)`.
    """

    ratio: Tensor
    focal: Tensor


def lowest(begin: Begun, options: Options) -> tuple[Fit, Rivals]:
    """The minimum from the start, or a lower one from another pose or focal length, where the first is doubtful.

    With it what else nearly as low was seen on the way.
    """
    found = begin.minimum(options)
    rivals = Rivals(*(torch.full_like(found.solution.cost, torch.inf) for _ in Rivals._fields))
    if options.max_iterations < FEWEST_STEPS or not _may_be_several(found):
        return found, rivals
    rows = _doubtful(found, begin.shared).nonzero().flatten()
    if len(rows) == 0:
        return found, rivals
    first, start = found.part(rows), begin.shared[rows]
    near, cost = _led_to(first, start)
    which, lane = _lower(first, start, cost)
    if len(which) > 0:
        limits: dict[str, Any] = {"max_iterations": options.max_iterations, "tolerance": options.tolerance}
        shared, poses = near.shared[lane], tuple(z[lane] for z in near.local)
        other = fit(begin.task.part(rows[which]), shared, poses, reject=options.outlier_limit, **limits)
        found = exchanged(found, other, rows[which], _better(first.part(which), other, start[which]))
    told = _rivals(found.part(rows), near, cost)
    return found, Rivals(*(a.index_copy(0, rows, b) for a, b in zip(rivals, told, strict=True)))


def _may_be_several(found: Fit) -> bool:
    """Whether there can be several minima worth a search."""
    task = found.task
    free = task.basis is None or task.basis.shape[-1] > 0
    few = task.used.shape[1] <= FEW_VIEWS and int(task.used.sum((1, 2)).amin()) <= FEW_CORNERS
    return free and few and task.objective == "image" and not task.free


def _doubtful(found: Fit, start: Tensor) -> Tensor:
    """Which minima may not be the lowest `(P,)`."""
    task = found.task
    count = task.used.sum((1, 2))
    intrinsics = len(task.names) if task.basis is None else task.basis.shape[-1]
    spare = 2 * count - POSE * task.used.any(-1).sum(-1) - intrinsics
    poor = ~_explains(found) | (found.solution.status != Status.CONVERGED) | _no_camera(task, found.solution, start)
    return (count <= FEW_CORNERS) & ((spare < SPARE) | _on_a_line(task) | poor)


def _on_a_line(task: Task) -> Tensor:
    """Which cameras have a view whose few corners lie nearly on a line `(P,)`."""
    used = task.used.unsqueeze(-1).to(task.points)
    middle = (task.points * used).sum(-2, keepdim=True) / used.sum(-2, keepdim=True).clamp(min=1)
    off = (task.points - middle) * used
    values = torch.linalg.eigvalsh(off.mT @ off)
    few = task.used.any(-1) & (task.used.sum(-1) <= LINE_CORNERS)
    return (few & (values[..., 1] <= LINE**2 * values[..., 2])).any(-1)


def _explains(found: Fit) -> Tensor:
    """Which fits leave residuals as small as those of corners are `(P,)`; few are left of few corners."""
    task = found.task
    weights = task.used if task.weights is None or found.knows_noise else torch.where(task.used, task.weights, 0.0)
    left = found.degrees_of_freedom().clamp(min=1) / (2 * task.used.sum((1, 2))).clamp(min=1)
    return found.solution.cost <= POOR * weights.sum((1, 2)) * left.clamp(max=1)


def _no_camera(task: Task, solution: Solution, start: Tensor) -> Tensor:
    """Which fits are no camera's `(P,)`: the lens folds inside the corners, or the image is the start's mirrored."""
    mirrored = ~(solution.shared[:, :2] * start[:, :2] > 0).all(-1)
    return mirrored | folds_at_corners(task, solution.shared, solution.local)


def _lower(first: Fit, start: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """The cameras `(n,)` that one of the starts led lower, of costs `(L, P)`, and which of the L P that was."""
    lowest, lane = cost.min(0)
    before = torch.where(_no_camera(first.task, first.solution, start), torch.inf, first.solution.cost * (1 - LOWER))
    which = (lowest < before).nonzero().flatten()
    return which, lane[which] * len(start) + which


def _led_to(first: Fit, start: Tensor) -> tuple[Solution, Tensor]:
    """Where starts lead in a few steps `(L P, ...)`, and the costs there `(L, P)`; infinite of what is no camera's."""
    with torch.inference_mode():
        starts, poses = _starts(first.task, start, tuple(z.detach() for z in first.solution.local))
        P = len(start)
        lanes = first.task.part(torch.arange(P, device=start.device).repeat(len(starts) // P))
        near = solved(lanes, starts, poses, max_iterations=SHORT_FIT, tolerance=NEAR)
        wrong = _no_camera(lanes, near, starts)
        cost = torch.where(wrong, torch.inf, near.cost.nan_to_num(torch.inf)).reshape(-1, P)
    return normal_tensors(near), cost.clone()


def _starts(task: Task, shared: Tensor, found: Pose) -> tuple[Tensor, Pose]:
    """Shared parameters `(L P, s)` and poses `(L P, V, ...)` to start from, L of each camera.

    Focal lengths that may move are tried in several sizes, each with all poses that may explain the corners then, of
    all views and of one while the others are as found.
    """
    basis = task.basis
    free = torch.ones_like(shared[:, :2]) if basis is None else (basis[:, :2] != 0).any(-1).to(shared)
    factors = shared.new_tensor(FOCAL if bool(free.any()) else FOCAL[:1])
    scale = 1 + (factors[:, None, None] - 1) * free
    scaled = torch.cat([scale * shared[:, :2], shared[:, 2:].expand(len(factors), -1, -1)], dim=-1).flatten(0, 1)
    many = task.part(torch.arange(len(shared), device=shared.device).repeat(len(factors)))
    candidates = [*candidate_poses(many, scaled), *tilted_poses(many, scaled)]
    V = task.used.shape[1]
    if V > 1:
        kept = tuple(z.repeat(len(factors), *(1,) * (z.ndim - 1)) for z in found)
        for other in candidates[:]:
            for view in range(V):
                here = torch.arange(V, device=shared.device) == view
                candidates.append(
                    tuple(
                        torch.where(here.reshape(-1, *(1,) * (a.ndim - 2)), b, a)
                        for a, b in zip(kept, other, strict=True)
                    )
                )
    poses = tuple(torch.cat(parts) for parts in zip(*candidates, strict=True))
    return scaled.repeat(len(candidates), 1), poses


def _better(first: Fit, other: Fit, start: Tensor) -> Tensor:
    """Which of other fits are better `(P,)`: at an end, possible, on the same corners, and likelier than the first.

    Where the first is impossible, another that explains as many corners is better whatever it costs; one that does not
    would only hide that.
    """
    same = (other.rejected == first.rejected).flatten(1).all(-1)
    impossible = _no_camera(first.task, first.solution, start)
    same |= impossible & (other.rejected.sum((1, 2)) <= first.rejected.sum((1, 2)))
    ended = other.solution.status == Status.CONVERGED
    here, there = _improbability(first), _improbability(other)
    lower = there < here - LOWER * here.abs()
    lower = torch.where(impossible, _explains(other), lower)
    return same & ended & ~_no_camera(other.task, other.solution, start) & lower


def _improbability(found: Fit) -> Tensor:
    """Minus the logarithm of the likelihood `(P,)`, up to a constant and to the noise's variance where it is one."""
    task, cost = found.task, found.solution.cost
    if task.whitening is None:
        return cost
    level = found.residual_variance().nan_to_num(0.0).clamp(min=1.0 if task.known_noise else FINEST_PX**2)
    log = level.log()[:, None, None] - torch.linalg.slogdet(task.whitening)[1]
    return cost / level + torch.where(task.used, log, 0.0).sum((1, 2))


def _rivals(kept: Fit, near: Solution, cost: Tensor) -> Rivals:
    """What is nearly as low as minima that are taken, of starts that led to `near (L P, ...)` at costs `(L, P)`."""
    solution, P = kept.solution, len(kept.rejected)
    each = torch.arange(P, device=cost.device).repeat(len(cost))
    step = (near.shared - solution.shared[each]).unsqueeze(-1)
    turn = difference(tuple(z[each] for z in solution.local), near.local, kept.task.points.mean(0)).unsqueeze(-1)
    U, E, W = (getattr(solution.equations, name)[each] for name in ("U", "E", "W"))
    of_views = 2 * step.mT.unsqueeze(1) @ E @ turn + turn.mT @ W @ turn
    apart = ((step.mT @ U @ step).flatten() + of_views.flatten(1).sum(1)).reshape(-1, P)
    noise = typical_noise(kept)
    another = (apart > APART**2 * noise.variance) & (near.status == Status.CONVERGED).reshape(-1, P)
    another &= solution.status == Status.CONVERGED
    lowest, lane = torch.where(another, cost, torch.inf).min(0)
    noise = noise._replace(variance=noise.variance.clamp(min=1e-18))
    focal = near.shared[:, 0].reshape(-1, P).gather(0, lane.unsqueeze(0)).squeeze(0)
    return Rivals(times_less_likely(lowest - solution.cost, noise), focal)


def with_rivals(said: Callable[[], tuple[Remarks, ...]], focal: Tensor, rivals: Rivals) -> tuple[Remarks, ...]:
    """The remarks on each of P cameras of focal lengths `(P,)`, and one where another minimum is nearly as likely."""
    more: dict[int, Remarks] = {}
    for p in (rivals.ratio < NEARLY).nonzero().flatten().tolist():
        here, there = float(focal[p]), float(rivals.focal[p])
        moved = f", focal length {there:.4g} px in place of {here:.4g} px" if abs(there - here) > 1e-3 * here else ""
        sentence = (
            f"{ANOTHER}, {float(1 / rivals.ratio[p]):.2g} times as likely{moved}; more corners, off the line or plane "
            "of the others, or a prior, tell them apart"
        )
        more[p] = (Remark(sentence, Kind.RIVAL, ANOTHER),)
    return tuple((*one, *more.get(p, ())) for p, one in enumerate(said()))
