"""Whether points were given in a left-handed frame.

Of points in space the mirror image fits then, and they do not. Points on a plane and their mirror image are seen alike:
the camera only comes to stand on the other side. Whether that is wrong nobody can tell who does not know where up is;
what can be told is that the camera would stand below level ground, and upside down.
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.own_frame import OwnFrame
from diffproj.calibration.fitting.space_poses import space_poses
from diffproj.calibration.fitting.task import Task, solved
from diffproj.calibration.fitting.two_poses import posed
from diffproj.calibration.least_squares.solver import Solution

DOUBTFUL = 0.003
"""RMS residual of a view, relative to its corners' spread, from which on the mirror image is tried."""
BETTER = 0.04
"""Part of the cost that the mirror image must come below."""
LEVEL, UPRIGHT = 0.95, 0.2
"""Cosine between z and the normal of a plane from which on it is level; and that between z and up in the photograph
from which on a camera below the plane stands upright, as one does that looks at a ceiling."""
FOCAL_LENGTHS = (0.7, 1.0, 1.5, 2.2, 3.3, 5.0, 7.5, 11.0)
"""Focal lengths that it is tried with where they are free, relative to the corners' extent in px: that of the fit
may be anything, for from infinitely far away points and their mirror image look alike."""


def left_handed(task: Task, solution: Solution, error: Tensor) -> Tensor:
    """For which cameras the mirror image of the points fits far better than the points `(P,)`.

    Args:
        task: what was minimised.
        solution: its minimum.
        error: the RMS residual of each view over its corners' spread `(P, V)`.
    """
    found = torch.zeros_like(solution.cost, dtype=torch.bool)
    which = (error.amax(-1) > DOUBTFUL).nonzero().flatten()
    if not task.solid or task.objective != "image" or len(which) == 0:
        return found
    part = task.part(which)
    mirrored = replace(part, points=part.points * part.points.new_tensor([1.0, 1.0, -1.0]))
    free = part.basis is None or bool(part.basis[:, :2].any())
    lowest = torch.full_like(solution.cost[which], torch.inf)
    seen = part.pixels.masked_fill(~part.used.unsqueeze(-1), torch.nan).flatten(1, 2)
    low, high = (seen.nan_to_num(side * torch.inf) for side in (1, -1))
    extent = (high.amax(1) - low.amin(1)).amax(-1, keepdim=True)
    for factor in FOCAL_LENGTHS if free else (0.0,):
        shared = solution.shared[which].clone()
        shared[:, :2] = factor * extent if free else shared[:, :2]
        lowest = lowest.minimum(_cost(mirrored, shared))
    return found.index_put((which,), lowest < BETTER * solution.cost[which])


def upside_down(frame: OwnFrame, R: Tensor, t: Tensor) -> Tensor:
    """Which poses `(...)` see a target on a level plane from below, and do not stand upright there.

    Args:
        frame: the target's own, on whose plane z = 0 its points lie.
        R: of the poses, from that frame to the camera `(..., 3, 3)`.
        t: too `(..., 3)`.
    """
    up = 1.0 if frame.axes is None else float(frame.axes[2, 2])
    normal = R[..., 2] * (-1.0 if up < 0 else 1.0)  # the one that leads up in the world, seen from the camera
    below = (normal * t).sum(-1) > 0
    return below & (-normal[..., 1] < UPRIGHT) & (abs(up) > LEVEL)


def _cost(task: Task, shared: Tensor) -> Tensor:
    """The cost `(P,)` from those shared parameters and poses that are sought."""
    P, V = task.used.shape[:2]
    upright = torch.eye(3, dtype=shared.dtype, device=shared.device).expand(P, V, 3, 3)
    direction, valid = task.parameters.unpack(shared, (upright, torch.zeros_like(upright[..., 0]))).directions(
        task.pixels
    )
    p, v = task.used.any(-1).nonzero(as_tuple=True)
    starts = space_poses(task.points, direction, task.used & valid)
    poses, costs = posed(task, shared, starts, p, v)
    best = costs.nan_to_num(torch.inf, torch.inf).argmin(0), torch.arange(len(p), device=p.device)
    local = tuple(z.index_put((p, v), new[best]) for z, new in zip(starts[0], poses, strict=True))
    return solved(task, shared, local, max_iterations=30, tolerance=1e-7).cost.nan_to_num(torch.inf, torch.inf)
