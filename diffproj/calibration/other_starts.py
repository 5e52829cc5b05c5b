"""Minima of `refine` from other poses and focal lengths, where few corners leave several.

Where corners hardly outnumber the unknowns, or the first minimum explains them badly, intrinsics and pose take up each
other's errors: the minimum next to the pose that the camera as given explains best need not be the lowest, and may lie
where the lens folds. So each pose that may explain the corners is a start, with the focal length as given and with
others, as `locate` and `adjust` start from both poses of a plane.
"""

from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.focal_ladder import moves_focal_length
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.second_look import lower_fit
from diffproj.calibration.fitting.start import best_pose, poses_from_camera
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.outcome import Begun
from diffproj.calibration.problem.parametrisation import POSE, Pose
from diffproj.calibration.trust.reach import folds_at_corners

SPARE = 8
"""Coordinates of corners beyond those of poses, priors not counted, below which other minima are looked for whatever
the first is like."""
POOR = 9.0
"""Cost per coordinate of a corner, where the noise is known, from which on a minimum explains too little."""
FEW_VIEWS = 4
"""Views up to which each is turned over."""
FOCAL = (1.0, 0.7, 1.4)
"""Focal lengths to start from, in that of the camera."""


def lowest(begin: Begun, options: Options) -> Fit:
    """The minimum from the start, or a lower one from another pose or focal length, where the first is doubtful."""
    found = begin.minimum(options)
    doubtful = _doubtful(found)
    if not bool(doubtful.any()) or options.objective != "image" or found.task.used.shape[1] > FEW_VIEWS:
        return found
    rows = doubtful.nonzero().flatten()
    task = begin.task.part(rows)
    every = torch.arange(len(rows), device=rows.device)
    best = _kept_from_folding(found.part(rows))
    limits: dict[str, Any] = {"max_iterations": options.max_iterations, "tolerance": options.tolerance}
    for shared, poses in _starts(task, begin.shared[rows]):
        other = fit(task, shared, poses, reject=options.outlier_limit, **limits)
        best = lower_fit(best, _kept_from_folding(other), every, options.outlier_limit)
    end = lower_fit(_kept_from_folding(found), best, rows, options.outlier_limit)
    cost = torch.where(end.solution.cost.isinf(), found.solution.cost, end.solution.cost)  # folded, and none is better
    return Fit(end.task, end.solution._replace(cost=cost), end.rejected)


def _doubtful(found: Fit) -> Tensor:
    """Which minima may not be the lowest `(P,)`."""
    task = found.task
    coordinates = 2 * task.used.sum((1, 2))
    spare = coordinates - POSE * task.used.any(-1).sum(-1)
    poor = found.solution.status != Status.CONVERGED
    if found.knows_noise:
        poor |= 2 * found.solution.cost > POOR * coordinates
    return (spare < SPARE) | poor | folds_at_corners(task, found.solution.shared, found.solution.local)


def _starts(task: Task, shared: Tensor) -> list[tuple[Tensor, Pose]]:
    """Shared parameters `(P, s)` and poses `(P, V, ...)`: the best poses, and those with each view turned over."""
    starts = []
    for factor in FOCAL if moves_focal_length(task) else FOCAL[:1]:
        scaled = torch.cat([factor * shared[:, :2], shared[:, 2:]], dim=-1)
        poses = poses_from_camera(task, scaled)
        best = best_pose(task, scaled, poses)
        starts.append((scaled, best))
        for other in poses:
            for view in range(task.used.shape[1]):
                one = torch.zeros_like(task.used[0, :, 0])
                one[view] = True
                turned = tuple(
                    torch.where(one.reshape(-1, *(1,) * (a.ndim - 2)), b, a) for a, b in zip(best, other, strict=True)
                )
                starts.append((scaled, turned))
    return starts


def _kept_from_folding(found: Fit) -> Fit:
    """The same, with an infinite cost where the lens folds inside the corners: any other minimum is better."""
    folds = folds_at_corners(found.task, found.solution.shared, found.solution.local)
    cost = torch.where(folds, torch.inf, found.solution.cost)
    return Fit(found.task, found.solution._replace(cost=cost), found.rejected)
