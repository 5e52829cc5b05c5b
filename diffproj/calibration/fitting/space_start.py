"""Starts for points in space, with nothing known but the size of the image: focal lengths on a grid.

Points in space tell a focal length even in one view, where they are deep enough. For each of the grid's focal lengths
each view takes the pose that explains its corners best without a lens; the lowest minima along the grid are starts.
"""

import torch
from torch import Tensor

from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.focal_grid import focal_lengths, lowest
from diffproj.calibration.fitting.start import Straightened, best_pose, candidate_poses
from diffproj.calibration.fitting.two_poses import view_costs
from diffproj.calibration.problem.parametrisation import Parametrisation, Pose


def space_starts(
    data: Data, size: tuple[int, int], parameters: Parametrisation
) -> tuple[list[tuple[Tensor, Pose]], Straightened]:
    """Shared parameters `(P, s)` and poses to start from, the best first, and the corners as they are straightened."""
    middle = data.pixels.new_tensor([(size[0] - 1) / 2, (size[1] - 1) / 2]).expand(len(data.pixels), 2)
    zero = torch.zeros_like(middle[:, 0])
    straight = Straightened(parameters.lens, data.pixels, middle, zero, size, zero + 1)
    grid = focal_lengths(middle, straight)
    task = data.task(straight.lens)
    poses, costs = [], []
    for f in grid:
        held = straight.held(f.expand(len(middle)))
        pose = best_pose(task, held, candidate_poses(task, held))
        poses.append(pose)
        costs.append(view_costs(task, held, pose).sum(-1))
    chosen = lowest(torch.stack(costs))
    rows = torch.arange(len(middle), device=middle.device)
    starts = []
    for rank in chosen:
        pose = tuple(torch.stack(parts)[rank, rows] for parts in zip(*poses, strict=True))
        starts.append((straight.shared(grid[rank], parameters.size), pose))
    return starts, straight
