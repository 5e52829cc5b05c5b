"""Which views to turn over together, and what the bowls of their costs tell of it."""

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic
from diffproj.calibration.fitting import closed_form
from diffproj.calibration.fitting.fit import fit
from diffproj.calibration.fitting.task import Task, solved
from diffproj.calibration.fitting.turned_views import choices
from diffproj.calibration.fitting.two_poses import posed
from diffproj.calibration.problem.parametrisation import Pose

D = torch.float64
BOARD = dp.Chessboard()
SHARED = torch.tensor([[6000.0, 6000.0, 319.5, 239.5]], dtype=D)


def seen_through_a_long_lens(seed: int = 3) -> tuple[Task, Pose]:
    """Eight noisy views from afar, in which perspective moves corners by about the noise, and their true poses."""
    K = torch.tensor([[6000.0, 0, 319.5], [0, 6000, 239.5], [0, 0, 1]], dtype=D)
    cameras = synthetic.random_cameras(dp.Camera(K, size=(640, 480)), BOARD, 8, distance=(18.0, 40.0), seed=seed)
    views = synthetic.corner_views(cameras, BOARD, noise_px=0.6, seed=seed)
    task = Task(BOARD.points, views.pixels.unsqueeze(0), views.visible.unsqueeze(0), "none")
    return task, (cameras.R.unsqueeze(0), cameras.t.unsqueeze(0))


def with_turned(task: Task, shared: Tensor, poses: Pose, views: list[int]) -> Pose:
    """The poses with some views in the other of their two, refined alone."""
    other = closed_form.other_pose(*poses, task.points)
    refined, _ = posed(task, shared, [other], torch.zeros(len(views), dtype=torch.long), torch.tensor(views))
    where = torch.zeros(len(views), dtype=torch.long), torch.tensor(views)
    return tuple(z.index_put(where, new[0]) for z, new in zip(poses, refined, strict=True))


@pytest.mark.parametrize("fixed", [False, True])
def test_views_that_were_turned_over_together_are_turned_back(fixed: bool) -> None:
    task, poses = seen_through_a_long_lens()
    if fixed:
        task = task.holding([2, 3])
    right = solved(task, SHARED, poses, max_iterations=100, tolerance=1e-13)
    turned = with_turned(task, right.shared, right.local, [1, 4, 6])
    wrong = solved(task, right.shared, turned, max_iterations=100, tolerance=1e-13)
    assert float(wrong.cost) > float(right.cost) * (1 + 1e-4)
    solution = wrong
    for _ in range(3):
        rows, starts = choices(task, solution)
        assert rows.tolist() == [0] * len(rows)
        if len(rows) == 0:
            break
        tried = fit(task.part(rows), solution.shared[rows], starts).solution
        best = tried.cost.argmin().unsqueeze(0)
        if not bool(tried.cost[best] < solution.cost):
            break
        solution = solution._replace(
            shared=tried.shared[best], local=tuple(z[best] for z in tried.local), cost=tried.cost[best]
        )
    assert float(solution.cost) <= float(right.cost) * (1 + 1e-9)
