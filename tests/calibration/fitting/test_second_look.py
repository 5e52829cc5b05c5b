"""How starts are compared, and of two fits that reject different corners the lower one is kept."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.focal_grid import BEST, lowest
from diffproj.calibration.fitting.second_look import ALIKE, LOWER, MOST_PAIRS, _first_of_alike, _nearest, lower_fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Solution, Status, equations_at
from diffproj.calibration.problem.parametrisation import POSE

D = torch.float64
BOARD = dp.Chessboard()
SHARED = torch.tensor([[600.0, 640.0, 310.0, 250.0]], dtype=D)


def test_of_starts_that_lead_to_one_place_the_first_goes_on() -> None:
    low, alike, high = 2.0, 2.0 * (1 + ALIKE / 2), 2.0 * (1 + 3 * ALIKE)
    costs = torch.tensor([[low, high], [alike, low], [high, alike], [low, high]], dtype=D)
    assert _first_of_alike(costs).tolist() == [[True, True], [False, True], [True, False], [False, False]]


def test_neighbours_of_many_points_are_found_in_parts() -> None:
    """Those that all distances at once tell, of a grid with its equal ones too, some 20 points a part."""
    count = MOST_PAIRS // 20
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(1), dtype=D)
    some = torch.arange(0, count, count // 50)
    apart = torch.cdist(points[some], points)
    apart[torch.arange(len(some)), some] = torch.inf
    assert torch.equal(_nearest(points, some), apart.argmin(-1))
    grid = BOARD.points.to(D)
    assert torch.equal(
        _nearest(grid, torch.arange(len(grid))), torch.cdist(grid, grid).fill_diagonal_(torch.inf).argmin(-1)
    )


def test_the_lowest_places_of_a_grid_are_its_valleys() -> None:
    """Then the lowest of the other nodes."""
    costs = torch.tensor([5.0, 3.0, 4.0, 1.0, 2.0, torch.nan, 6.0], dtype=D).unsqueeze(-1)
    assert lowest(costs).squeeze(-1).tolist() == [3, 1, 4, 2, 0, 6, 5][:BEST]


def fit_of(task: Task, shared: Tensor, poses: tuple[Tensor, Tensor], left_out: Tensor) -> Fit:
    """As if it had ended there, without those corners `(P, V, N)`."""
    problem = task.problem
    P = len(shared)
    seen = task.used & ~left_out
    residual = problem.linearise(shared, poses)[:, :, -1].square().sum(2)
    cost = torch.where(seen, residual, 0.0).sum((-2, -1)) / 2
    none = torch.zeros(P, dtype=torch.int64)
    solution = Solution(shared, poses, cost, none, none, equations_at(problem, shared, poses, POSE, None, None))
    cut = Task(task.points, task.pixels, seen, task.lens)
    return Fit(cut, solution, left_out)


@pytest.mark.parametrize("reject", [None, 3.0])
def test_a_fit_is_no_better_for_the_corners_it_rejects(reject: float | None) -> None:
    """Of two cameras the second is better off with the other fit; of the first that is wrong, and rejects what tells."""
    f_x, f_y, c_x, c_y = SHARED[0].tolist()
    K = torch.tensor([[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]], dtype=D)
    cameras = synthetic.random_cameras(dp.Camera(K, size=(640, 480)), BOARD, 3, seed=2)
    views = synthetic.corner_views(cameras, BOARD, noise_px=0.2, seed=2)
    poses = cameras.R.expand(2, 3, 3, 3), cameras.t.expand(2, 3, 3)
    task = Task(BOARD.points, views.pixels.expand(2, 3, -1, 2), views.visible.expand(2, 3, -1), "none")
    shared, wrong = SHARED.expand(2, 4).clone(), SHARED.expand(2, 4) * torch.tensor([1.003, 1.003, 1, 1], dtype=D)
    none = torch.zeros_like(task.used)
    many = none.clone()
    many[:, :, 6:] = True
    found = fit_of(task, torch.stack([shared[0], wrong[1]]), poses, none)
    other = fit_of(task, torch.stack([wrong[0], shared[1]]), poses, torch.stack([many[0], none[1]]))
    assert float(other.solution.cost[0]) < float(found.solution.cost[0])
    kept = lower_fit(found, other, torch.arange(2), reject)
    torch.testing.assert_close(kept.solution.shared[1], shared[1])
    assert torch.equal(kept.rejected[1], none[1])
    first, rejected = (wrong, many) if reject is None else (shared, none)
    torch.testing.assert_close(kept.solution.shared[0], first[0])
    assert torch.equal(kept.rejected[0], rejected[0])


@pytest.mark.parametrize(("part", "taken"), [(-0.5, True), (0.5, True), (2.0, False)])
def test_of_two_fits_as_low_the_one_that_came_to_an_end_is_kept(part: float, taken: bool) -> None:
    """Of an image cut out far from the axis: the lowest place was found twice, and refused as the first never ended."""
    camera = dp.Camera(torch.tensor([[600.0, 0, 310], [0, 640, 250], [0, 0, 1]], dtype=D), size=(640, 480))
    cameras = synthetic.random_cameras(camera, BOARD, 3, seed=2)
    views = synthetic.corner_views(cameras, BOARD, noise_px=0.2, seed=2)
    task = Task(BOARD.points, views.pixels.unsqueeze(0), views.visible.unsqueeze(0), "none")
    ended = fit_of(task, SHARED, (cameras.R.unsqueeze(0), cameras.t.unsqueeze(0)), torch.zeros_like(task.used))
    cost = ended.solution.cost
    lost = replace(
        ended,
        solution=ended.solution._replace(status=torch.tensor([Status.MAX_ITERATIONS]), cost=cost * (1 - part * LOWER)),
    )
    kept = lower_fit(lost, ended, torch.arange(1), None)
    assert bool(kept.solution.status[0] == Status.CONVERGED) is taken
    assert lower_fit(ended, lost, torch.arange(1), None).solution.status.tolist() == [
        Status.MAX_ITERATIONS if part > 1 else Status.CONVERGED
    ]


def test_a_view_that_fits_far_worse_asks_for_another_look() -> None:
    """Through a long lens it ended in few steps at an RMS of 0.260 px, with two views off by twice the others'."""
    draw = torch.Generator().manual_seed(12)
    focal = 15000 * 4.0 ** float(torch.rand(1, generator=draw))
    center = torch.tensor([639.5, 479.5], dtype=D) + 20 * torch.randn(2, generator=draw, dtype=D)
    K = torch.tensor([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]], dtype=D)
    lens = dp.BrownConrady(torch.tensor([0.1, -0.5, 0, 0, 0], dtype=D))
    near = 1.3 * focal / 1280
    camera = dp.Camera(K, distortion=lens, size=(1280, 960))
    board = dp.Chessboard(9, 6, 25.0)
    posed = synthetic.random_cameras(camera, board, 12, distance=(near, 2 * near), seed=12)
    found = dp.calibrate(synthetic.corner_views(posed, board, noise_px=0.15, seed=12), board)
    assert float(found.rms) < 0.2068
