"""A focal length, ratio or principal point that is held and that the views contradict is told, and a right one is not."""

from typing import Any

import pytest
import torch

import diffproj as dp

VIEWS, BOARD = dp.example_views("left"), dp.Chessboard()


@pytest.fixture(scope="module")
def alone() -> dp.Calibration:
    return dp.calibrate(VIEWS, BOARD)


def refined(alone: dp.Calibration, by: torch.Tensor, views: dp.Views = VIEWS, **options: Any) -> dp.Calibration:
    camera = alone.camera
    return dp.refine(views, BOARD, dp.Camera(camera.K * by, distortion=camera.distortion, size=camera.size), **options)


@pytest.mark.parametrize(
    ("f_x", "f_y", "c_x", "options", "said"),
    [
        (1.02, 1.02, 1.0, {"fixed": ("focal",)}, "focal length that was held: they want it 2 % smaller"),
        (0.98, 0.98, 1.0, {"fixed": ("focal",)}, "focal length that was held: they want it 2 % larger"),
        (1.0, 1.01, 1.0, {"fixed": ("f_y",)}, "focal length that was held: they want it 1 % smaller"),
        (
            1.0,
            1.0,
            1.03,
            {"fixed": ("principal_point",)},
            "principal point that was held: they want it 10 px elsewhere",
        ),
    ],
)
def test_a_wrong_value_that_is_held_is_named_and_not_another_lens(
    alone: dp.Calibration, f_x: float, f_y: float, c_x: float, options: dict[str, Any], said: str
) -> None:
    """By as much as it is off. (Before, another lens was told of, or nothing: principal points err by up to twice their
    deviations then.)"""
    by = torch.tensor([[f_x, 1.0, c_x], [1.0, f_y, 1.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    found = refined(alone, by, **options)
    assert f"the views contradict the {said}" in found.remarks[0]
    assert "another lens" not in found.remarks[0]
    assert str(found.verdict).startswith("Weak: the views contradict the")


def test_right_values_that_are_held_are_left_alone(alone: dp.Calibration) -> None:
    """Those of all views, for subsets of the real ones. (Of 736 simulated calibrations none was told of.)"""
    right = torch.ones(3, 3, dtype=torch.float64)
    for count in (3, 5, 8):
        for fixed in ("focal", "principal_point"):
            assert "contradict" not in refined(alone, right, VIEWS[:count], fixed=(fixed,)).remarks[0]


def test_a_lens_that_is_held_and_wrong_is_told_as_a_lens(alone: dp.Calibration) -> None:
    camera = dp.Camera(
        alone.camera.K, distortion=dp.BrownConrady(torch.zeros(5, dtype=torch.float64)), size=alone.camera.size
    )
    found = dp.refine(VIEWS, BOARD, camera, fixed=("focal", "distortion"), throw=False)
    assert "contradict" not in found.remarks[0]
