"""Minima of rational lenses side by side: which is lower, whatever corners each of them rejects."""

from dataclasses import replace

import torch

import diffproj as dp
from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.nested.factors import data_cost
from diffproj.calibration.nested.restraint import _costs

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
    some = Fit(replace(task, used=fewer), every.solution, used & ~fewer)
    first = torch.zeros(1, dtype=torch.long)
    assert float(data_cost(some)) < 0.9 * float(data_cost(every))
    one, other = _costs(every, some, first, 5.0)
    torch.testing.assert_close(one, other, rtol=1e-12, atol=0)
