"""What spares the search for a view's other pose: the prediction of its cost, and how far perspective tells."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic
from diffproj.calibration.fitting import two_poses
from diffproj.calibration.fitting.closed_form import other_pose
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.fitting.two_poses import (
    better_poses,
    first_step,
    found_again,
    posed,
    view_costs,
    weak_perspective,
)
from diffproj.calibration.least_squares.losses import Cauchy, Loss
from diffproj.calibration.least_squares.solver import Solution, equations_at
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.geometry.cayley import turned

D = torch.float64
BOARD = dp.Chessboard()
SHARED = torch.tensor([[600.0, 640.0, 310.0, 250.0]], dtype=D)


def seen(noise: float = 0.2) -> tuple[Task, tuple[Tensor, Tensor]]:
    """Five noisy views, and their true poses."""
    f_x, f_y, c_x, c_y = SHARED[0].tolist()
    K = torch.tensor([[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]], dtype=D)
    cameras = synthetic.random_cameras(dp.Camera(K, size=(640, 480)), BOARD, 5, seed=2)
    views = synthetic.corner_views(cameras, BOARD, noise_px=noise, seed=2)
    task = Task(BOARD.points, views.pixels.unsqueeze(0), views.visible.unsqueeze(0), "none")
    return task, (cameras.R.unsqueeze(0), cameras.t.unsqueeze(0))


@pytest.mark.parametrize("loss", [None, Cauchy(2.0)])
@pytest.mark.parametrize("weighted", [False, True])
def test_the_predicted_cost_is_that_of_the_refined_pose(loss: Loss | None, weighted: bool) -> None:
    task, (R, t) = seen()
    weights = torch.rand(task.used.shape, dtype=D) + 0.5 if weighted else None
    task = replace(task, loss=loss, weights=weights)
    number = torch.arange(5)
    refined, cost = posed(task, SHARED, [(R, t)], torch.zeros(5, dtype=torch.long), number, max_iterations=50)
    pose = tuple(z.squeeze(0).unsqueeze(0) for z in refined)
    torch.testing.assert_close(view_costs(task, SHARED, pose), cost)
    off = turned(pose[0], torch.full_like(pose[1], 2e-4)), pose[1] + 0.05
    assert bool((view_costs(task, SHARED, off) > 1.02 * cost).all())
    predicted = first_step(task, SHARED, off)[1]
    torch.testing.assert_close(predicted, cost, rtol=1e-4 if loss is None else 0.05, atol=0)


def test_no_prediction_without_corners() -> None:
    task, poses = seen()
    used = task.used.clone()
    used[0, 1] = False
    assert first_step(replace(task, used=used), SHARED, poses)[1].isinf().tolist() == [
        [False, True, False, False, False]
    ]


def test_how_far_perspective_tells_does_not_depend_on_where_the_axis_is() -> None:
    task, poses = seen()
    far = torch.tensor([0.0, 0.0, 1.0], dtype=D)
    told = []
    for distance in (0.0, 3e3, 1e4, 3e4, 1e5):
        away = poses[0], poses[1] + distance * far
        variance = torch.full((1, 5), 0.04, dtype=D)
        found = weak_perspective(task, SHARED, away, variance)
        moved = SHARED + torch.tensor([0.0, 0.0, 5000.0, 3000.0], dtype=D)
        assert torch.equal(weak_perspective(task, moved, away, variance), found)
        told.append(int(found.sum()))
    assert told[0] == 0  # near, perspective tells the poses apart
    assert max(told) == 5  # far off it does not


@pytest.mark.parametrize("loss", [None, Cauchy(2.0)])
def test_lost_views_are_found_again_from_four_corners_on(loss: Loss | None) -> None:
    task, (R, t) = seen()
    used = task.used.clone()
    used[0, 1] = False
    used[0, 1, [0, 8, 45, 53]] = True
    used[0, 2, 3:] = False
    task = replace(task, used=used, loss=loss)
    away = turned(R, torch.tensor([0.0, 1.5, 0.5], dtype=D).expand(1, 5, 3)), t + 300
    lost = torch.tensor([[False, True, True, False, True]])
    which = lost[..., None]
    moved = torch.where(which[..., None], away[0], R), torch.where(which, away[1], t)
    none = torch.zeros(1, dtype=torch.int64)
    equations = equations_at(task.problem, SHARED, moved, POSE, None, loss)
    found = found_again(task, Solution(SHARED, moved, none.to(D), none, none, equations), lost).local
    for view in (1, 4):  # as near to the truth as the noise of the corners lets it be
        assert float((found[0][0, view] - R[0, view]).abs().amax()) < 0.05
        assert float((found[1][0, view] - t[0, view]).norm() / t[0, view].norm()) < 0.02
    assert torch.equal(found[0][0, 2], moved[0][0, 2])  # three corners tell no pose
    assert torch.equal(found[1][0, [0, 2, 3]], moved[1][0, [0, 2, 3]])


def test_a_view_in_the_worse_of_its_poses_is_turned_over() -> None:
    task, (R, t) = seen()
    far = torch.tensor([0.0, 0.0, 4000.0], dtype=D)
    f_x, f_y, c_x, c_y = SHARED[0].tolist()
    K = torch.tensor([[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]], dtype=D)
    pixels, _ = dp.Camera(K, R, t + far).project(BOARD.points)
    task = replace(task, pixels=pixels + 0.02 * torch.randn(pixels.shape, dtype=D))
    wrong = tuple(z.clone() for z in (R, t + far))
    for part, other in zip(wrong, other_pose(R, t + far, BOARD.points), strict=True):
        part[0, 3] = other[0, 3]
    none = torch.zeros(1, dtype=torch.int64)
    equations = equations_at(task.problem, SHARED, wrong, POSE, None, None)
    solution = Solution(SHARED, wrong, none.to(D), none, none, equations)
    poses, changed = better_poses(task, solution, torch.ones(1, dtype=torch.bool))
    assert changed.tolist() == [True]
    assert float((poses[0][0, 3] - R[0, 3]).abs().amax()) < 0.1 < float((wrong[0][0, 3] - R[0, 3]).abs().amax())
    again, changed = better_poses(task, solution, torch.zeros(1, dtype=torch.bool))
    assert changed.tolist() == [False]
    assert all(torch.equal(z, new) for z, new in zip(wrong, again, strict=True))


def test_a_view_whose_other_pose_leads_back_to_its_own_is_not_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen nearly face on there is one pose; it was exchanged for itself where few steps had led to it."""
    R = dp.rotation_from_euler(*torch.tensor([0.05, 0.0, 0.0], dtype=D)).expand(1, 1, 3, 3)
    pose = R, torch.tensor([[[-100.0, -60.0, 900.0]]], dtype=D)
    K = torch.tensor([[600.0, 0, 310.0], [0, 640.0, 250.0], [0, 0, 1]], dtype=D)
    pixels, _ = dp.Camera(K, *pose).project(BOARD.points)
    pixels = pixels + 0.2 * torch.randn(pixels.shape, dtype=D, generator=torch.Generator().manual_seed(0))
    task = Task(BOARD.points, pixels, torch.ones(1, 1, 54, dtype=torch.bool), "none")
    cost = view_costs(task, SHARED, pose)
    assert bool(weak_perspective(task, SHARED, pose, cost / 54).all())
    none = torch.zeros(1, dtype=torch.int64)
    refined, lower = posed(task, SHARED, [other_pose(*pose, BOARD.points)], none, none)
    assert float(lower) < 0.99 * float(cost)
    assert float((refined[0][0] - R).abs().amax()) < 0.02
    solution = Solution(SHARED, pose, cost[0], none, none, equations_at(task.problem, SHARED, pose, POSE))
    monkeypatch.setattr(two_poses, "posed", None)
    poses, changed = better_poses(task, solution, torch.ones(1, dtype=torch.bool))
    assert changed.tolist() == [False]
    assert torch.equal(poses[0], R)
