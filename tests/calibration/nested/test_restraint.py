"""Minima of rational lenses side by side: which is lower, whatever corners each of them rejects."""

from dataclasses import replace

import pytest
import torch

import diffproj as dp
from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Prior
from diffproj.calibration.nested import restraint
from diffproj.calibration.nested.compared import costs, unrestrained_cost
from diffproj.calibration.trust.remarks import _restrained

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


@pytest.mark.parametrize("reaches", [True, False])
def test_what_ends_above_a_poorer_lens_is_held_to_it(reaches: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not where that reaches less of the image."""
    views = dp.example_views("left")[:8]
    poorer = dp.calibrate(views, BOARD, "brown8")
    task = Task(BOARD.points, views.pixels.unsqueeze(0), views.visible.unsqueeze(0), "brown12")
    start = torch.nn.functional.pad(poorer.shared, (0, 4)).unsqueeze(0)
    poses = poorer.cameras.R.unsqueeze(0), poorer.cameras.t.unsqueeze(0)
    prism = [task.names.index(name) for name in ("s1", "s2", "s3", "s4")]
    without = fit(task.holding(prism), start, poses)
    off = without.solution.shared.clone()
    off[:, prism] = 1e-3
    above = fit(task, off, poses, max_iterations=0)

    def reach(found: Fit, _size: tuple[int, int]) -> torch.Tensor:
        upright = found.solution.shared[:, prism].abs().amax(-1) < 1e-6
        return torch.where(upright, 1.0 if reaches else 0.5, 0.9)

    monkeypatch.setattr(restraint, "reach_of", reach)
    limits = {"reject": None, "max_iterations": 300, "tolerance": 3e-14}
    held = restraint.not_above(above, without, None, (640, 480), **limits)  # type: ignore[arg-type]
    if not reaches:
        assert held is above or torch.equal(held.solution.shared, above.solution.shared)
        return
    assert float(unrestrained_cost(held)) <= float(without.solution.cost) * (1 + 1e-9)
    assert float(held.solution.shared[:, prism].abs().amax()) < 1e-6
    assert "a poorer lens, and s1, s2, s3 and s4 at 0, for" in _restrained(held, 0)
    assert restraint.not_above(without, above, None, (640, 480), **limits) is without  # type: ignore[arg-type]


def test_a_lens_that_the_corners_do_not_determine_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if its terms went to infinity: it reaches the whole image, and would be refused."""
    views = dp.example_views("left")
    poorer = dp.calibrate(views, BOARD, "brown5")
    task = Task(BOARD.points, views.pixels.unsqueeze(0), views.visible.unsqueeze(0), "brown8")
    start = torch.nn.functional.pad(poorer.shared, (0, 3)).unsqueeze(0)
    poses = poorer.cameras.R.unsqueeze(0), poorer.cameras.t.unsqueeze(0)
    found = fit(task, start, poses)
    limits = {"reject": None, "max_iterations": 300, "tolerance": 3e-14}
    kept, _ = restraint.restrained(found, start, poses, (640, 480), **limits)  # type: ignore[arg-type]
    assert not bool(kept.is_restrained())
    monkeypatch.setattr(restraint, "_is_determined", Fit.is_restrained)
    held, folds = restraint.restrained(found, start, poses, (640, 480), **limits)  # type: ignore[arg-type]
    assert bool(held.is_restrained())
    assert not bool(folds)
    _, folds = restraint.restrained(found, start, poses, (640, 480), hold=False, **limits)  # type: ignore[arg-type]
    assert bool(folds)
