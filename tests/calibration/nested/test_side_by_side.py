"""Fits that share a batch, with different starts, limits and parameters held, against each by itself."""

import pytest
import torch

import diffproj as dp
from diffproj.calibration.fitting.fit import fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.nested.side_by_side import Lane, side_by_side

BOARD = dp.Chessboard()
STEPS = {"reject": None, "tolerance": 3e-14}


@pytest.fixture(scope="module")
def begun() -> tuple[Task, torch.Tensor, tuple[torch.Tensor, ...]]:
    """Two cameras that begin near their minima without a lens."""
    sides = [dp.example_views(side)[:6] for side in ("left", "right")]
    task = Task(
        BOARD.points,
        torch.stack([views.pixels for views in sides]),
        torch.stack([views.visible for views in sides]),
        "brown8",
    )
    found = [dp.calibrate(views, BOARD, "none") for views in sides]
    shared = torch.stack([torch.nn.functional.pad(calibration.shared, (0, 8)) for calibration in found])
    poses = tuple(torch.stack([getattr(calibration.cameras, z) for calibration in found]) for z in ("R", "t"))
    return task, shared, poses


@pytest.mark.parametrize("tied", [False, True])
def test_each_ends_as_by_itself(
    begun: tuple[Task, torch.Tensor, tuple[torch.Tensor, ...]],
    tied: bool,
) -> None:
    task, shared, poses = begun
    if tied:
        task = task.holding([2])
    names = task.names
    denominator = tuple(names.index(name) for name in ("k4", "k5", "k6"))
    other = shared.clone()
    other[:, :2] *= 1.01
    lanes = [Lane(shared, poses, 100), Lane(other, poses, 3), Lane(shared, poses, 100, denominator)]
    ends = side_by_side(task, lanes, **STEPS)  # type: ignore[arg-type]
    for lane, end in zip(lanes, ends, strict=True):
        own = task.holding(list(lane.held)) if lane.held else task
        alone = fit(own, lane.shared, lane.local, max_iterations=lane.max_iterations, **STEPS)  # type: ignore[arg-type]
        torch.testing.assert_close(end.solution.cost, alone.solution.cost, rtol=1e-10, atol=0)
        assert torch.equal(end.degrees_of_freedom(), alone.degrees_of_freedom())
        assert torch.equal(end.solution.shared[:, list(lane.held)], lane.shared[:, list(lane.held)])
        assert int(end.solution.iterations.max()) <= lane.max_iterations
    assert bool((ends[0].solution.cost < ends[2].solution.cost).all())
