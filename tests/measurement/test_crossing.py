"""Outlines that cross themselves: what their area is not."""

import warnings

import pytest
import torch

import diffproj as dp
from diffproj.measurement.shapes import crosses_itself

SQUARE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
BOW_TIE = SQUARE[[0, 2, 1, 3]]
TILTED = torch.linalg.qr(torch.tensor([[1.0, 2, 3], [0, 1, -2], [1, 0, 1]], dtype=torch.float64))[0]


def _star(count: int, generator: torch.Generator, noise: float = 0.0) -> torch.Tensor:
    """Corners around a middle, at distances that differ, and so never crossing."""
    angles = torch.linspace(0, 2 * torch.pi, count + 1, dtype=torch.float64)[:-1]
    radius = 0.2 + torch.rand(count, generator=generator, dtype=torch.float64)
    flat = torch.stack([radius * angles.cos(), radius * angles.sin(), torch.zeros_like(radius)], dim=-1)
    return 1000 * flat @ TILTED.mT + torch.tensor([642735.0, 8304292.0, 5.0])


def test_outlines_around_a_middle_do_not_cross() -> None:
    """300 of 3 to 40 corners, on a tilted plane far from the origin, in either direction; with a corner twice, too."""
    generator = torch.Generator().manual_seed(3)
    for i in range(300):
        outline = _star(3 + i % 38, generator)
        assert not crosses_itself(outline)
        assert not crosses_itself(outline.flip(0))
        assert not crosses_itself(torch.cat([outline, outline[-1:]]))
        assert not crosses_itself(torch.cat([outline, outline[:1]]))


def test_outlines_with_two_corners_exchanged_cross() -> None:
    generator = torch.Generator().manual_seed(4)
    for count in (5, 8, 20):
        order = torch.arange(count)
        order[[1, 3]] = order[[3, 1]]
        angles = torch.linspace(0, 2 * torch.pi, count + 1, dtype=torch.float64)[:-1]
        round_one = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=-1)
        assert crosses_itself(round_one[order] @ TILTED.mT + torch.rand(3, generator=generator, dtype=torch.float64))
    assert crosses_itself(BOW_TIE)
    assert not crosses_itself(SQUARE)
    assert crosses_itself(torch.stack([SQUARE, BOW_TIE])).tolist() == [False, True]


def test_points_on_a_line_and_on_one_spot_do_not_cross() -> None:
    assert not crosses_itself(torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [2, 0, 0]], dtype=torch.float64))
    assert not crosses_itself(torch.zeros(5, 3, dtype=torch.float64))


def test_the_area_of_corners_in_a_wrong_order_is_warned_of() -> None:
    """The two triangles of the bow tie cancel: its area is 0."""
    camera = dp.Camera.looking_at([0.5, 0.3, 5.0], [0.5, 0.5, 0.0], up=(0, 1, 0), fov_deg=40.0, size=(640, 480)).to(
        torch.float64
    )
    pixels, _ = camera.project(SQUARE)
    measured = dp.measure(pixels, camera, dp.Plane.z(0.0), pixel_sigma=0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert float(measured.area().value[0]) == pytest.approx(1.0)
    with pytest.warns(UserWarning, match="area: the outline crosses itself"):
        found = measured.area([0, 2, 1, 3])
    assert float(found.value[0]) == pytest.approx(0.0, abs=1e-9)


def test_corners_on_a_line_are_left_alone() -> None:
    """A column of a real board's corners, which lie on both sides of their line by chance."""
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    corners = calibration.views.pixels[0, ::9]
    measured = dp.measure(corners, calibration, dp.Plane.z(0.0), view=0, pixel_sigma=0.5)
    assert crosses_itself(measured.points)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert float(measured.area().value[0]) < 30  # of 125 mm squared: 12 with a deviation of 9
