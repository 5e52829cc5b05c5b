"""Starts on a grid of focal lengths, and of principal points where a fisheye's may lie outside the image.

At each node of the grid each view takes the better of its two poses, as a Gauss-Newton step predicts their costs. No
solver runs: nodes are compared side by side, and those where the corners fit best are started from.
"""

import math

import torch
from torch import Tensor

from diffproj._core.numerics import spread_evenly
from diffproj.calibration.fitting import closed_form
from diffproj.calibration.fitting.start import Straightened
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.fitting.two_poses import first_step
from diffproj.calibration.problem.parametrisation import Pose

FOCAL_GRID = tuple(0.3 * 1.5**i for i in range(14))
"""Focal lengths to look at, in units of the image's longer side: from a field of view of 118 degrees to one of 1."""
FISHEYE_GRID = tuple(0.4 * 1.25**i for i in range(9))
"""The same for a fisheye, in units of the longer side over pi."""
BEST = 2
"""Focal lengths of the grid that are solved to the end."""
MIDDLES, BEST_MIDDLES = (-1.0, -0.5, 0.0, 0.5, 1.0), 4
"""Distances of a fisheye's principal point from the image's middle to look at, in units of the longer side, in both
directions; and how many of these places are started from."""
SAMPLE_VIEWS = 16
"""Views of a camera that the grid is judged by."""


def focal_lengths(like: Tensor, straight: Straightened) -> Tensor:
    """Those of the grid `(G,)` in px."""
    fisheye = straight.lens == "fisheye"
    unit = straight.longer / math.pi if fisheye else straight.longer
    return like.new_tensor(FISHEYE_GRID if fisheye else FOCAL_GRID) * unit


def starts_on_grid(task: Task, first: Tensor, straight: Straightened) -> list[tuple[Tensor, Pose]]:
    """Shared parameters `(P, s)` and poses for the best focal lengths of the grid."""
    P = len(task.used)
    grid = focal_lengths(first, straight)
    sample = _sample(task)
    costs = torch.stack([_profile(task, straight, grid[i].expand(P), sample) for i in range(len(grid))])
    best = lowest(costs)
    return [start_at(task, first, straight, grid[best[rank]]) for rank in range(best.shape[0])]


def starts_around(task: Task, first: Tensor, straight: Straightened) -> list[tuple[Tensor, Pose]]:
    """The same for the best principal points inside the image and around it, each at its best focal length."""
    P = len(task.used)
    along = first.new_tensor(MIDDLES) * straight.longer
    shifts = torch.cartesian_prod(along, along)
    every = torch.arange(P, device=first.device).repeat(len(shifts))
    moved = straight.part(every).around(straight.middle[every] + shifts.repeat_interleave(P, dim=0))
    grid = focal_lengths(first, straight)
    whole, sample = task.part(every), _sample(task)[every]
    costs = torch.stack([_profile(whole, moved, f.expand(len(every)), sample) for f in grid])
    costs, best = costs.nan_to_num(torch.inf, torch.inf).min(0)
    order = costs.reshape(len(shifts), P).argsort(dim=0, stable=True)[:BEST_MIDDLES]
    nodes = order * P + torch.arange(P, device=first.device)
    return [start_at(task, first, moved.part(node), grid[best[node]]) for node in nodes]


def start_at(task: Task, first: Tensor, straight: Straightened, f: Tensor | float) -> tuple[Tensor, Pose]:
    """Shared parameters `(P, s)` and poses at focal lengths `(P,)`; what is held, or tied, stays as first `(P, s)`."""
    P, V = task.used.shape[:2]
    f = f if isinstance(f, Tensor) else first.new_tensor(f).expand(P)
    every = torch.arange(V, device=f.device).expand(P, V)
    _, poses = _both_poses(task, straight, f, every)
    shared = straight.shared(f, first.shape[-1])
    if task.basis is not None:
        T = task.basis
        step = (T.mT @ (shared - first).unsqueeze(-1)) / T.square().sum(1).unsqueeze(-1)
        shared = first + (T @ step).squeeze(-1)
    return shared, poses


def _sample(task: Task) -> Tensor:
    """The views `(P, v)` of each camera that grids are judged by."""
    V = task.used.shape[1]
    order = task.used.sum(-1).argsort(dim=-1, descending=True, stable=True)
    return order[:, spread_evenly(V, min(V, SAMPLE_VIEWS), order.device)]


def _profile(task: Task, straight: Straightened, f: Tensor, views: Tensor) -> Tensor:
    """The cost `(P,)` of some views `(P, v)` at focal lengths `(P,)`, each at the better of its poses."""
    costs, _ = _both_poses(task, straight, f, views)
    costs = costs if task.shares is None else costs * task.shares.gather(1, views)
    return torch.where(task.used.any(-1).gather(1, views), costs, 0.0).sum(-1)


def _both_poses(task: Task, straight: Straightened, f: Tensor, views: Tensor) -> tuple[Tensor, Pose]:
    """Predicted costs `(P, v)` of views `(P, v)` at the better of their two poses, and these."""
    rays, inside = straight.rays(f)

    def pick(whole: Tensor) -> Tensor:
        index = views.reshape(*views.shape, *(1,) * (whole.ndim - 2)).expand(*views.shape, *whole.shape[2:])
        return whole.gather(1, index)

    used = pick(task.used)
    H = closed_form.homographies(task.points, pick(rays), used & pick(inside))
    one = closed_form.poses(H, task.points)
    other = closed_form.other_pose(one[0], one[1], task.points)
    robust = task.loss if task.objective == "image" else None
    weights = None if task.weights is None else pick(task.weights)
    plain = Task(task.points, pick(straight.pixels), used, straight.lens, loss=robust, weights=weights)
    held = straight.held(f)
    costs = [first_step(plain, held, poses)[1] for poses in (one, other)]
    better = costs[1] < costs[0]
    R = torch.where(better[..., None, None], other[0], one[0])
    return torch.minimum(*costs), (R, torch.where(better[..., None], other[1], one[1]))


def lowest(costs: Tensor) -> Tensor:
    """Positions `(BEST, P)` on the grid `(G, P)` of its lowest local minima, then of its lowest nodes."""
    padded = torch.nn.functional.pad(costs, (0, 0, 1, 1), value=torch.inf)
    local = (costs <= padded[:-2]) & (costs <= padded[2:])
    size = costs.nan_to_num(torch.inf, torch.inf)
    rank = torch.where(local, torch.zeros_like(size), torch.ones_like(size))
    order = size.argsort(dim=0, stable=True)
    return order.gather(0, rank.gather(0, order).argsort(dim=0, stable=True))[:BEST]
