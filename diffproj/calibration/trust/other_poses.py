"""The search for the other pose of each view of a fit, and how likely it is."""

import torch
from torch import Tensor

from diffproj.calibration.fitting import closed_form
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.fitting.two_poses import FEW_CORNERS, posed, tilted_poses, view_costs, weak_perspective
from diffproj.calibration.problem.parametrisation import Pose
from diffproj.calibration.results.ambiguity import OtherPoses, difference
from diffproj.calibration.trust.noise import Noise, own_noise, pooled, times_less_likely

APART = 3.0
"""Distance of two poses, in standard deviations, up to which the kept one's error bar covers the other."""
TYPICAL_PX, TYPICAL_FREEDOM = 0.3, 2
"""Noise of corners in photographs, and for how many degrees of freedom it counts where nothing else is known of it.

Four corners leave two degrees of freedom: their residuals may all be small by chance."""
SYNTHETIC_PX = 1e-3
"""Residuals below which corners are no photograph's, and tell their noise alone."""
TAIL = 3.0
"""Degrees of freedom of Student's distribution, which stands for corners of which some may be wrong: a loss tells how
much a wrong corner may pull, and not how often corners are wrong."""
EXACT_PX = 1e-9
"""Noise in pixels that is assumed at least: residuals below it are rounding errors, and no odds come of them."""


def other_poses(found: Fit, noise: Noise | None = None) -> OtherPoses:
    """The best other pose of each view, the shared parameters held.

    The mirrored pose is refined, and for few corners, which may have up to four poses, several tilts are. A view whose
    perspective is far above its residuals has no other pose worth a search.

    Args:
        found: the fit of P cameras.
        noise: what is known of the corners' noise beforehand. It counts along with their residuals, unless these
            contradict it.
    """
    with torch.inference_mode():
        R, t, ratio = _other_poses(found, *typical_noise(found, noise))
    return OtherPoses(R.clone(), t.clone(), ratio.clone())


def _other_poses(found: Fit, variance: Tensor, freedom: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    task = found.task
    shared, kept = found.solution.shared, found.solution.local
    unit = EXACT_PX if task.objective == "image" else 1e-3 * EXACT_PX * float(task.points.abs().amax())
    variance, freedom = variance.clamp(min=unit**2).unsqueeze(-1), freedom.unsqueeze(-1)
    here = view_costs(task, shared, kept)
    count = task.used.sum(-1)
    sound = (count >= 4) & here.isfinite()
    few = sound & (count <= FEW_CORNERS)
    each = count if task.weights is None else torch.where(task.used, task.weights, 0.0).sum(-1)
    level = variance * count / torch.where(each > 0, each, 1.0)  # of a residual, whatever the unit of the weights
    weak = sound & ~few & weak_perspective(task, shared, kept, level)
    mirrored = closed_form.other_pose(kept[0], kept[1], task.points)
    best, cost = kept, torch.full_like(here, torch.inf)
    for tried in (few, weak):
        p, v = tried.nonzero(as_tuple=True)
        if len(p) == 0:
            continue
        starts = [mirrored, *tilted_poses(task, shared)] if tried is few else [mirrored]
        poses, costs = posed(task, shared, starts, p, v, max_iterations=50, tolerance=1e-10)
        one = tuple(z[p, v].expand(len(starts), *z[p, v].shape) for z in kept)
        step = difference(one, poses, task.points.mean(0))
        apart = (step.unsqueeze(-2) @ found.solution.equations.W[p, v] @ step.unsqueeze(-1)).squeeze(-1).squeeze(-1)
        another = (apart > APART**2 * variance[p, 0]) & costs.isfinite()
        if not task.solid:
            another &= _faces_alike(one, poses, task.points)
        lowest, chosen = torch.where(another, costs, torch.inf).min(0)
        taken = lowest.isfinite()
        p, v, chosen = p[taken], v[taken], chosen[taken]
        number = torch.arange(len(p), device=p.device)
        best = tuple(z.index_put((p, v), new[:, taken][chosen, number]) for z, new in zip(best, poses, strict=True))
        cost = cost.index_put((p, v), lowest[taken])
    if task.loss is not None:
        here, there = (_improbability(task, shared, poses, variance.unsqueeze(-1)) for poses in (kept, best))
        ratio = (there - here).nan_to_num(torch.inf).clamp(min=0).exp()
        return best[0], best[1], torch.where(cost.isfinite(), ratio, torch.inf)
    return best[0], best[1], times_less_likely(cost - here, Noise(variance, freedom))


def _improbability(task: Task, shared: Tensor, poses: Pose, variance: Tensor) -> Tensor:
    """Minus the logarithm of the likelihood of each view `(P, V)` where some corners may be wrong, up to a constant."""
    squared = task.problem.linearise(shared, poses)[:, :, -1].square().sum(2)
    squared = squared if task.weights is None else squared * task.weights
    each = (TAIL + 2) / 2 * (squared / (TAIL * variance)).log1p()
    return torch.where(task.used, each, 0.0).sum(-1)


def typical_noise(found: Fit, known: Noise | None = None) -> Noise:
    """The noise of the corners, where few of them tell little with what is usual of photographs.

    That counts even where the residuals contradict it: a pose with an error several times as large takes a noise that
    is even less usual. (Of 1500 views of four points with a noise of 3 px, odds told of 2.2 wrong poses, and 2 were; of
    8 px of 31, and 23 were.)
    """
    own = own_noise(found)
    if found.task.weights is not None or found.task.objective != "image":
        return own
    if known is None:
        typical = torch.where(own.variance > SYNTHETIC_PX**2, TYPICAL_PX**2, 0.0).to(own.variance)
        freedom = own.freedom + TYPICAL_FREEDOM
        return Noise((own.variance * own.freedom + typical * TYPICAL_FREEDOM) / freedom, freedom)
    return pooled(own, known)


def _faces_alike(one: Pose, other: Pose, points: Tensor) -> Tensor:
    """Whether both poses show the same face of the target to the camera: it is printed on one."""

    def towards(R: Tensor, t: Tensor) -> Tensor:
        return (R[..., 2] * (R @ points.mean(0) + t)).sum(-1) > 0

    return towards(*one) == towards(*other)
