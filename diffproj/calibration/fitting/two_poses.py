"""Each view of a plane has two poses that look alike, and a solver ends in the one that it starts near.

Seen from afar, a plane and its mirror image at the line of sight have the same outline; only the perspective within the
view tells them apart (Schweighofer and Pinz 2006). So a minimum is one only when the other pose of no view is better:
after each solve the other pose of each view is tried, where it is better it is taken, and the cameras concerned are
solved once more, until none changes.

Most views need no search to see this. Perspective moves the corners of a board of radius r, at a distance Z and tilted
by theta, by about `d = 2 f (r / Z)^2 sin(theta)`, one way for the one pose and the other way for the other; where that
is far more than the view's residuals, the other pose is no rival. For the views that are left, one linearisation at the
other pose predicts the cost that its refinement can reach, and whether it only leads back to the pose that is known.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting import closed_form
from diffproj.calibration.fitting.options import Progress
from diffproj.calibration.fitting.task import Task, solved
from diffproj.calibration.least_squares.everyone import for_each
from diffproj.calibration.least_squares.losses import Cauchy
from diffproj.calibration.least_squares.solver import Solution
from diffproj.calibration.problem.parametrisation import POSE, Pose, moved
from diffproj.geometry.cayley import turned

PERSPECTIVE = 20.0
"""Displacement by perspective, relative to the residuals, beyond which the other pose is no rival."""
FACE_ON = 0.3
"""Foreshortening, relative to the residuals, up to which a view's two poses are one."""
RIVAL = 4.0
"""Predicted cost of a view at its other pose, relative to its cost, up to which the other pose is refined."""
BACK = 1 / 3
"""Part of the way to the other pose that may be left after the first step back: the hill between is half way."""
MISFIT = 25.0
"""Mean squared residual of a view, relative to the median of its camera's views, from which on it is sought anew."""
FEW_CORNERS = 10
"""Corners of a view up to which more than two poses may fit about as well (four points: up to four)."""
TILT = math.radians(40)
"""By which boards are tilted that a lost view's pose, or that of a few corners, is sought from."""
WON_BACK = 10.0
"""Residual variances that shared parameters may win back when a view is turned over."""
MAX_ROUNDS = 8
"""Maximum number of times that poses are exchanged and the cameras solved again."""
BETTER = 1e-6
"""Part of its cost by which a view must gain for an exchange."""


def settled(
    task: Task,
    shared: Tensor,
    local: Pose,
    *,
    max_iterations: int | Tensor,
    tolerance: float,
    progress: Progress | None = None,
) -> Solution:
    """Minimise from shared parameters `(P, s)` and poses `(P, V, ...)`; the other pose of no view is then better."""
    limits = for_each(max_iterations, shared)
    options: dict[str, Any] = {"tolerance": tolerance}
    solution = solved(task, shared, local, max_iterations=limits, progress=progress, **options)
    open_ = torch.ones(len(shared), dtype=torch.bool, device=shared.device)
    for _ in range(MAX_ROUNDS):
        poses, changed = better_poses(task, solution, open_)
        if not bool(changed.any()):
            break
        which = changed.nonzero().flatten()
        start = solution.shared[which], tuple(z[which] for z in poses)
        again = solved(task.part(which), *start, max_iterations=limits[which], **options)
        gained = again.cost.isfinite() & ~(again.cost >= solution.cost[which])  # a start may have had no cost at all
        solution = replaced(solution, which[gained], again, gained)
        open_ = torch.zeros_like(open_).index_fill(0, which[gained], True)
    return solution


def better_poses(task: Task, solution: Solution, cameras: Tensor) -> tuple[Pose, Tensor]:
    """The poses of the views, exchanged where the other is better while the shared parameters are held.

    Args:
        task: what is minimised.
        solution: its minimum for the present poses.
        cameras: which are looked at `(P,)`.

    Returns:
        Poses `(P, V, ...)`, and whether a camera's poses changed `(P,)`.
    """
    poses = solution.local
    here = solution.equations.c if task.loss is None else view_costs(task, solution.shared, poses)
    seen = task.used.any(-1) & cameras.unsqueeze(-1)
    rivals = seen & weak_perspective(task, solution.shared, poses, mean_squares(task, here))
    other = poses
    if bool(rivals.any()):
        other = closed_form.other_pose(poses[0], poses[1], task.points)
        p, v = rivals.nonzero(as_tuple=True)
        single, held, start = _single(task, solution.shared, other, p, v)
        (R, _), costs = first_step(single, held, start)
        own = poses[0][p, v].unsqueeze(1)
        goes_back = (R - own).square().sum((-2, -1)) <= BACK**2 * (start[0] - own).square().sum((-2, -1))
        near = (costs <= RIVAL * here[p, v].unsqueeze(1)) & ~goes_back
        rivals = torch.zeros_like(rivals).index_put((p, v), near.squeeze(1))
    poses, here, changed = _exchanged(task, solution.shared, poses, here, [other], rivals)
    lost = seen & (_misfit(task, here) | (task.used.sum(-1) <= FEW_CORNERS))
    poses, more = _sought(task, solution.shared, poses, here, lost)
    return poses, changed | more


def near_rivals(task: Task, solution: Solution) -> tuple[Tensor, Tensor, Pose]:
    """The n views `(p, v)` whose other pose costs little more with the shared parameters held, and these poses.

    Little is what the shared parameters may win back when they are solved for again.
    """
    poses, shared = solution.local, solution.shared
    here = view_costs(task, shared, poses)
    variance = mean_squares(task, here)
    p, v = (task.used.any(-1) & weak_perspective(task, shared, poses, variance)).nonzero(as_tuple=True)
    if len(p) == 0:
        return p, v, tuple(z[p, v] for z in poses)
    refined, costs = posed(task, shared, [closed_form.other_pose(poses[0], poses[1], task.points)], p, v)
    level = torch.where(task.used.any(-1), variance, torch.nan).nanmedian(-1).values[p]
    turned_over = (refined[0][0] * poses[0][p, v]).sum((-2, -1)) < 3 - 1e-4  # another pose, and not the same again
    near = (costs[0] - here[p, v] <= WON_BACK * level) & turned_over
    return p[near], v[near], tuple(z[0][near] for z in refined)


def found_again(task: Task, solution: Solution, lost: Tensor) -> Solution:
    """The solution with the poses of lost views `(P, V)` sought anew, robust against wrong corners among theirs."""
    lost = lost & (task.used.sum(-1) >= 4)
    local = solution.local
    for p in lost.any(-1).nonzero().flatten().tolist():  # few cameras, and each has a noise of its own
        one = slice(p, p + 1)
        poses = _found_again(task.part(one), solution.shared[one], tuple(z[one] for z in local), lost[one])
        which = torch.tensor([p], device=lost.device)
        local = tuple(z.index_copy(0, which, new) for z, new in zip(local, poses, strict=True))
    return solution._replace(local=local)


def _found_again(task: Task, shared: Tensor, poses: Pose, lost: Tensor) -> Pose:
    """The same for one camera: poses under Cauchy's loss, its scale falling to that of the other views' residuals."""
    residual = task.problem.linearise(shared, poses)[:, :, -1]
    known = (task.used & ~lost.unsqueeze(-1)).unsqueeze(2)
    level = 4 * float(torch.where(known, residual.abs(), torch.nan).nanmedian().nan_to_num(0.0))
    unit = 1.0 if task.objective == "image" else 1e-3 * float(task.points.abs().amax())
    least, scale = max(level, 1e-9 * unit), max(level, unit)
    robust = replace(task, loss=task.loss or Cauchy(scale))
    poses, _ = _sought(robust, shared, poses, view_costs(robust, shared, poses), lost)
    while task.loss is None and scale > least:  # the smaller the scale, the less wrong corners pull
        scale = max(scale / 30, least)
        robust = replace(task, loss=Cauchy(scale))
        poses, _, _ = _exchanged(robust, shared, poses, view_costs(robust, shared, poses), [poses], lost)
    return poses


def _sought(task: Task, shared: Tensor, poses: Pose, here: Tensor, lost: Tensor) -> tuple[Pose, Tensor]:
    """Poses of lost views `(P, V)` sought from boards that face the camera and lean four ways; which changed `(P,)`."""
    if not bool(lost.any()):
        return poses, torch.zeros_like(lost[:, 0])
    poses, _, changed = _exchanged(task, shared, poses, here, tilted_poses(task, shared), lost)
    return poses, changed


def _exchanged(
    task: Task, shared: Tensor, poses: Pose, here: Tensor, others: Sequence[Pose], tried: Tensor
) -> tuple[Pose, Tensor, Tensor]:
    """Poses and their costs, exchanged where another, refined, is better; and whether a camera's changed `(P,)`."""
    p, v = tried.nonzero(as_tuple=True)
    changed = torch.zeros_like(tried[:, 0])
    if len(p) == 0:
        return poses, here, changed
    refined, costs = posed(task, shared, others, p, v)
    cost, best = torch.where(costs.isfinite(), costs, torch.inf).min(0)
    better = ~(cost >= here[p, v] * (1 - BETTER)) & cost.isfinite()
    p, v, best = p[better], v[better], best[better]
    poses = tuple(
        z.index_put((p, v), new[:, better][best, torch.arange(len(p), device=p.device)])
        for z, new in zip(poses, refined, strict=True)
    )
    return poses, here.index_put((p, v), cost[better]), changed.index_fill(0, p, True)


def _misfit(task: Task, costs: Tensor) -> Tensor:
    """Which views fit far worse than the others of their camera `(P, V)`."""
    mean = mean_squares(task, costs)
    median = mean.nanmedian(-1, keepdim=True).values
    return ~(mean <= MISFIT * median.clamp(min=1e-18)) & task.used.any(-1)


def mean_squares(task: Task, costs: Tensor) -> Tensor:
    """The mean square of a residual's component in each view `(P, V)`, whatever the unit of the weights."""
    weights = task.used.to(costs) if task.weights is None else torch.where(task.used, task.weights, 0.0)
    total = weights.sum(-1)
    return torch.where(total > 0, costs / torch.where(total > 0, total, 1.0), torch.nan)


def tilted_poses(task: Task, shared: Tensor) -> list[Pose]:
    """Poses `(P, V, ...)` of boards where the corners are: one that faces the camera, then leaning in four ways."""
    V = task.used.shape[1]
    identity = torch.eye(3, dtype=shared.dtype, device=shared.device).expand(len(shared), V, 3, 3)
    camera = task.parameters.unpack(shared, (identity, torch.zeros_like(identity[..., 0])))
    direction, valid = camera.directions(task.pixels)
    sight, xy, ahead = closed_form.turned_rays(direction, task.used & valid)
    R, t = closed_form.upright_poses(task.points, xy, ahead)
    R, t = sight @ R, (sight @ t.unsqueeze(-1)).squeeze(-1)
    middle = task.points.mean(0)
    axes = R.new_tensor([(0.0, 0, 0), (1.0, 0, 0), (-1.0, 0, 0), (0, 1.0, 0), (0, -1.0, 0)])
    turns = [turned(R, 2 * math.tan(TILT / 2) * (sight @ axis)) for axis in axes]
    return [(turn, t + (R - turn) @ middle) for turn in turns]


def weak_perspective(task: Task, shared: Tensor, poses: Pose, variance: Tensor) -> Tensor:
    """In which views perspective moves the corners by no more than some residuals, of that variance `(P, V)`."""
    R, t = poses
    middle = task.points.mean(0)
    radius = (task.points - middle).square().sum(-1).mean().sqrt()
    place = (R @ middle) + t
    distance = place.square().sum(-1).clamp(min=1e-300)
    cosine = (R[..., 2] * place).sum(-1).square() / distance
    displacement = 2 * shared[:, None, :2].mean(-1) * radius**2 / distance * (1 - cosine).clamp(min=0).sqrt()
    residual = variance.sqrt()
    if task.objective != "image":  # from world units to pixels
        residual = residual * shared[:, None, :2].mean(-1) / distance.sqrt()
    # Seen face on the two poses are one: between them lies no hill that the corners could tell of.
    foreshortening = shared[:, None, :2].mean(-1) * radius / distance.sqrt() * (1 - cosine.sqrt())
    return (displacement <= PERSPECTIVE * residual) & (foreshortening > FACE_ON * residual)


def posed(
    task: Task,
    shared: Tensor,
    starts: Sequence[Pose],
    p: Tensor,
    v: Tensor,
    max_iterations: int = 20,
    tolerance: float = 1e-7,
) -> tuple[Pose, Tensor]:
    """The n views `(p, v)` alone refined from each of S starts, which are poses `(P, V, ...)`, side by side.

    Returns:
        Poses `(S, n, ...)`, and their costs `(S, n)`.
    """
    parts = [_single(task, shared, start, p, v) for start in starts]
    single, held, _ = parts[0]
    every = torch.arange(len(p), device=p.device).repeat(len(starts))
    local = tuple(torch.cat(pieces) for pieces in zip(*(start for _, _, start in parts), strict=True))
    ended = solved(single.part(every), held[every], local, max_iterations=max_iterations, tolerance=tolerance)
    shape = len(starts), len(p)
    return tuple(z.squeeze(1).unflatten(0, shape) for z in ended.local), ended.cost.unflatten(0, shape)


def _single(task: Task, shared: Tensor, poses: Pose, p: Tensor, v: Tensor) -> tuple[Task, Tensor, Pose]:
    """Each of the views `(p, v)` as a camera of its own, with its shared parameters, which are held, and its pose."""
    single = replace(
        task,
        pixels=task.pixels[p, v].unsqueeze(1),
        used=task.used[p, v].unsqueeze(1),
        weights=None if task.weights is None else task.weights[p, v].unsqueeze(1),
        whitening=None if task.whitening is None else task.whitening[p, v].unsqueeze(1),
        shares=None,
        prior=None,
        printed=None,
        basis=shared.new_zeros(len(p), shared.shape[-1], 0),
    )
    return single, shared[p], tuple(z[p, v].unsqueeze(1) for z in poses)


def view_costs(task: Task, shared: Tensor, poses: Pose) -> Tensor:
    """The cost of each view `(P, V)`: half the weighted sum of its (robust) squared residuals."""
    squared = task.problem.linearise(shared, poses)[:, :, -1].square().sum(2)
    value = squared if task.loss is None else task.loss.value(squared)
    return (value if task.weights is None else value * task.weights).sum(-1) / 2


def first_step(task: Task, shared: Tensor, poses: Pose) -> tuple[Pose, Tensor]:
    """Poses after a Gauss-Newton step of each, and the cost of each view `(P, V)` there by the linearised residuals.

    That is infinite where the residuals have no value or the corners determine no pose.
    """
    panel = task.problem.linearise(shared, poses)
    residual = panel[:, :, -1]
    squared = residual.square().sum(2)
    weights = torch.ones_like(squared) if task.weights is None else task.weights
    if task.loss is not None:
        weights = weights * task.loss.weight(squared)
    rows = (panel[:, :, -POSE - 1 :] * weights.sqrt()[:, :, None, None]).flatten(-2)
    gram = rows @ rows.mT
    W, h, cost = gram[..., :-1, :-1], gram[..., :-1, -1:], gram[..., -1, -1] / 2
    L, failed = torch.linalg.cholesky_ex(torch.where(W.isfinite(), W, 0.0))
    y = torch.linalg.solve_triangular(L, h, upper=False)
    step = torch.linalg.solve_triangular(L.mT, y, upper=True).squeeze(-1)
    predicted = cost - y.square().sum((-2, -1)) / 2
    costs = torch.where((failed == 0) & predicted.isfinite(), predicted.clamp(min=0), torch.inf)
    return moved(poses, -step), costs


def replaced(solution: Solution, which: Tensor, other: Solution, taken: Tensor) -> Solution:
    """A solution with that of some cameras `(n,)` replaced, where `taken` says so; iterations add up."""

    def put(whole: object, part: object) -> object:
        if isinstance(whole, Tensor):
            return whole.index_put((which,), part[taken])  # type: ignore[index]
        parts = [put(a, b) for a, b in zip(whole, part, strict=True)]  # type: ignore[call-overload]
        return type(whole)(*parts) if hasattr(whole, "_fields") else tuple(parts)

    total = solution.iterations.index_add(0, which, other.iterations[taken])
    return put(solution, other)._replace(iterations=total)  # type: ignore[attr-defined]
