"""A last look, along the focal length, at cameras whose solver is lost in a long valley.

Where the principal point lies far outside the image, the focal length, the lens and the poses make up for each other
over a long and curved way, along which the solver crawls or is led astray. With the focal length held the way is short.
So the rungs of a ladder of focal lengths are fitted side by side. From the lowest, strides lead on to where the cost is
lowest, each from the last, with the lens and the distances scaled so that the image hardly changes; there all
parameters are free again.
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.start import Straightened
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.problem.parametrisation import Parametrisation, Pose

LADDER = tuple(0.3 * 1.6**i for i in range(6))
"""Focal lengths of the rungs, in units of the image's longer side: from a field of view of 118 degrees to one of 18."""
STRIDES, WALK = (1 / 1.2, 1.2), 12
"""Factors of the focal length to the places beside the best, and how often at most the better of them is gone to."""
RUNG_STEPS = 150
"""Steps of the solver on a rung."""
OUTSIDE = 0.25
"""Distance of the principal point from the image's middle, relative to the longer side, from which on it is far out."""
POWERS = {"k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6, "p1": 1, "p2": 1, "s1": 1, "s2": 3, "s3": 1, "s4": 3}
"""By which power of the focal length coefficients grow that bend the image alike."""


def far_out(found: Fit, straight: Straightened) -> Tensor:
    """Which cameras have their principal point far from the image's middle `(P,)`, as found or by Zhang's equations."""
    middles = found.solution.shared[:, 2:4], straight.elsewhere(found.task).middle
    off = torch.stack([(middle - straight.middle).abs().amax(-1) for middle in middles]).amax(0)
    return ~(off <= OUTSIDE * straight.longer)


def climbed(
    task: Task, shared: Tensor, poses: Pose, *, reject: float | None, max_iterations: int, tolerance: float
) -> Fit:
    """The fit of P cameras from the lowest place of a ladder of focal lengths.

    Args:
        task: what is minimised, in which the focal lengths are free.
        shared: where each of the L rungs starts `(L, P, s)`.
        poses: the same `(L, P, V, ...)`.
        reject: robust standard deviations beyond which a corner is an outlier.
        max_iterations: of the solver.
        tolerance: of the solver.
    """
    held = task.holding([0, 1] if _tied(task) else [0])
    limits: dict[str, Any] = {"max_iterations": min(max_iterations, RUNG_STEPS), "tolerance": tolerance}
    best = _lowest(held, shared, poses, limits)[0]
    beside = torch.zeros_like(shared[:2, :, 0])  # costs at both strides from where the walk ended
    left = torch.arange(shared.shape[1], device=shared.device)
    for _ in range(WALK):
        here = best.part(left)
        ways = [_with_focal_length(task.parameters, here.shared, here.poses, here.shared[:, 0] * by) for by in STRIDES]
        shared = torch.stack([shared for shared, _ in ways])
        poses = tuple(torch.stack(parts) for parts in zip(*(poses for _, poses in ways), strict=True))
        lower, costs = _lowest(held.part(left), shared, poses, limits)
        on = (lower.cost < here.cost).nonzero().flatten()
        beside[:, left] = costs
        left = left[on]
        beside[:, left] = 0.0
        if len(left) == 0:
            break
        best = best.replaced(left, lower.part(on))
    start = _with_focal_length(
        task.parameters, best.shared, best.poses, best.shared[:, 0] * _between(beside, best.cost)
    )
    return fit(task, *start, reject=reject, max_iterations=max_iterations, tolerance=tolerance)


class _Rung(NamedTuple):
    """Costs `(P,)`, shared parameters `(P, s)` and poses `(P, V, ...)` of cameras with their focal lengths held."""

    cost: Tensor
    shared: Tensor
    poses: Pose

    def part(self, rows: Tensor) -> "_Rung":
        return _Rung(self.cost[rows], self.shared[rows], tuple(z[rows] for z in self.poses))

    def replaced(self, rows: Tensor, by: "_Rung") -> "_Rung":
        poses = tuple(z.index_copy(0, rows, new) for z, new in zip(self.poses, by.poses, strict=True))
        return _Rung(self.cost.index_copy(0, rows, by.cost), self.shared.index_copy(0, rows, by.shared), poses)


def _lowest(held: Task, shared: Tensor, poses: Pose, limits: dict[str, Any]) -> tuple[_Rung, Tensor]:
    """The lowest of L rungs `(L, P, ...)`, each fitted with its focal length held, and the costs of all `(L, P)`."""
    L, P = shared.shape[:2]
    every = torch.arange(P, device=shared.device)
    start = shared.flatten(0, 1), tuple(z.flatten(0, 1) for z in poses)
    ended = fit(held.part(every.repeat(L)), *start, **limits).solution
    rungs = _Rung(ended.cost.nan_to_num(torch.inf), ended.shared, ended.local)
    costs = rungs.cost.reshape(L, P)
    return rungs.part(costs.argmin(0) * P + every), costs


def _between(beside: Tensor, cost: Tensor) -> Tensor:
    """The factor of the focal length `(P,)` at which a parabola through a rung and those beside it is lowest."""
    down, up = beside
    bend = down - 2 * cost + up
    step = ((down - up) / (2 * bend)).clamp(-1, 1)
    return torch.where((bend > 0) & step.isfinite(), math.log(STRIDES[1]) * step, 0.0).exp()


def _with_focal_length(parameters: Parametrisation, shared: Tensor, poses: Pose, f: Tensor) -> tuple[Tensor, Pose]:
    """The same with focal length f_x `(P,)`, the lens bending the image alike and the target as large in it."""
    ratio = (f / shared[:, 0]).unsqueeze(-1)
    powers = [1, 1, 0, 0, *(POWERS.get(name, 0) for name in parameters.coefficient_names)]
    powers = shared.new_tensor(powers + [0] * (shared.shape[-1] - len(powers)))
    R, t = poses
    return shared * ratio**powers, (R, torch.cat([t[..., :2], t[..., 2:] * ratio.unsqueeze(-1)], dim=-1))


def _tied(task: Task) -> bool:
    """Whether both focal lengths move together."""
    return task.basis is not None and bool(((task.basis[:, 0] != 0) & (task.basis[:, 1] != 0)).any())


def moves_focal_length(task: Task) -> bool:
    """Whether the focal lengths are free."""
    return task.basis is None or bool((task.basis[:, 0] != 0).any())


def moves_principal_point(task: Task) -> bool:
    """Whether the principal point is."""
    return task.basis is None or bool(task.basis[:, 2:4].any())
