"""Minima of rational lenses side by side: which is lower, whatever corners each of them rejects."""

from dataclasses import replace

import torch

import diffproj as dp
from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Prior
from diffproj.calibration.nested.compared import costs, unrestrained_cost

BOARD = dp.Chessboard()


def test_who_rejects_more_corners_is_not_lower_by_that() -> None:
    views = dp.example_views("left")[:6]
    known = dp.calibrate(views, BOARD, "brown8", shape="flat")
    pixels, used = views.pixels.unsqueeze(0), views.visible.unsqueeze(0)
    task = Task(BOARD.points.to(torch.float64), pixels.to(torch.float64), used, "brown8")
    assert known.parameters.names == task.names
    poses = known.cameras.R.unsqueeze(0), known.cameras.t.unsqueeze(0)
    every = fit(task, known.shared.unsqueeze(0), poses, max_iterations=0)
    fewer = used.clone()
    fewer[:, ::2, ::3] = False
    near = fit(replace(task, used=fewer), known.shared.unsqueeze(0), poses, max_iterations=0)
    some = Fit(near.task, near.solution, used & ~fewer)
    first = torch.zeros(1, dtype=torch.long)
    assert float(unrestrained_cost(some)) < 0.9 * float(unrestrained_cost(every))
    one, other = costs(every, some, first, 5.0)
    torch.testing.assert_close(one, other, rtol=1e-12, atol=0)


def test_what_restrains_costs_nothing_and_what_is_known_does() -> None:
    views = dp.example_views("left")[:4]
    poses = dp.calibrate(views, BOARD).cameras
    task = Task(BOARD.points, views.pixels.unsqueeze(0), views.visible.unsqueeze(0), "brown8")
    shared = torch.tensor([[530.0, 530, 320, 240, *([0.1] * 8)]], dtype=torch.float64)
    local = poses.R.unsqueeze(0), poses.t.unsqueeze(0)
    corners = fit(task, shared, local, max_iterations=0).solution.cost
    precision = torch.diag(torch.tensor([0.0] * 4 + [1e6] * 8, dtype=torch.float64)).unsqueeze(0)
    for known, part in ((None, 1), (0 * precision, 0), (0.5 * precision, 0.5)):
        prior = Prior(torch.zeros_like(shared), precision, known)
        found = fit(replace(task, prior=prior), shared, local, max_iterations=0)
        torch.testing.assert_close(found.solution.cost, corners + 4e4)
        torch.testing.assert_close(unrestrained_cost(found), corners + part * 4e4)
