"""A factor that stands above and below a rational lens's line: it changes nothing, and minima are found from there."""

import pytest
import torch

import diffproj as dp
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.nested.factors import FACTORS, with_factor
from tests.calibration.minima.drawn import BOARD, KINDS, Draw

D = torch.float64
SIZE = (640, 480)


@pytest.fixture
def task() -> Task:
    views = dp.example_views("left")[:2]
    return Task(BOARD.points, views.pixels.unsqueeze(0), views.visible.unsqueeze(0), "brown12")


@pytest.mark.parametrize("factor", FACTORS)
def test_it_changes_nothing(task: Task, factor: tuple[float, float]) -> None:
    """Of a lens with fewer terms than there are places for: the others are products that no term holds."""
    shared = torch.tensor([[530.0, 540, 320, 240, 0.3, 0, 1e-3, -2e-3, 0, 0.5, 0, 0, 1e-3, 2e-3, 3e-3, 4e-3]], dtype=D)
    other = with_factor(task, shared, SIZE, factor)
    assert other is not None
    assert bool((other[:, [4, 5, 8, 9, 10, 11]] != shared[:, [4, 5, 8, 9, 10, 11]]).all())
    xy = 0.7 * torch.randn(100, 2, dtype=D, generator=torch.Generator().manual_seed(0))
    before, after = (dp.BrownConrady(x[0, 4:16]).distort(xy)[0] for x in (shared, other))
    torch.testing.assert_close(after, before, rtol=1e-12, atol=1e-12)


def test_there_is_none_where_a_term_is_held(task: Task) -> None:
    held = task.holding([task.names.index("k3")])
    assert with_factor(held, torch.ones(1, 16, dtype=D), SIZE, FACTORS[0]) is None


def test_a_lower_minimum_is_found_from_there() -> None:
    """The first minimum is at 30.030, and its lens makes sense."""
    problems = KINDS["any brown8"](25, Draw(5003))
    views = dp.Views(problems.views.pixels[20], problems.views.visible[20], size=problems.views.size)
    found = dp.calibrate(views, BOARD, "brown8")
    assert float(found.residuals.square().sum()) == pytest.approx(29.611, abs=1e-3)
