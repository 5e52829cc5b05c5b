"""A camera with an axis mirrored sees a flat target alike."""

import pytest
import torch

import diffproj as dp
from diffproj.calibration.fitting.positive_focal import mirrored
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.problem.parametrisation import Parametrisation

D = torch.float64
BOARD = dp.Chessboard()


@pytest.mark.parametrize("signs", [(-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
def test_the_image_stays_the_same(signs: tuple[float, float]) -> None:
    parameters = Parametrisation("brown14", bow=True, skew=True)
    lens = [-0.2, 0.1, 0.01, -0.02, 0.03, 0.1, 0.02, 0.01, 0.003, -0.002, 0.004, -0.001, 0.05, -0.08]
    shared = torch.tensor([[-600.0, 620.0, 310, 250, *lens, 1.5, 2.0, -3.0]], dtype=D)
    camera = dp.calibrate(dp.example_views("left"), BOARD, "none").cameras[:3]
    poses = camera.R.unsqueeze(0), camera.t.unsqueeze(0)
    used = torch.ones(1, 3, len(BOARD.points), dtype=torch.bool)
    pixels = torch.zeros(1, 3, len(BOARD.points), 2, dtype=D)
    problem = Task(BOARD.points, pixels, used, "brown14", bow=True, skew=True).problem
    seen = problem.linearise(shared, poses)[:, :, -1].clone()
    other, (R, t) = mirrored(parameters, shared, poses, torch.tensor([signs], dtype=D))
    assert (other[0, :2] / shared[0, :2]).tolist() == list(signs)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(1, 3, dtype=D))
    torch.testing.assert_close(problem.linearise(other, (R, t))[:, :, -1], seen)
