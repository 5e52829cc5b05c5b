"""The region of the image that a calibration's corners covered."""

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.calibration.results.region import covered_region, in_region

D = torch.float64


def test_it_is_the_hull_grown_by_half_a_square() -> None:
    views = dp.example_views("left")
    reach = covered_region(views.pixels, views.visible)
    hull = cv2.convexHull(views.pixels.reshape(-1, 2).numpy().astype(np.float32))
    places = 700 * torch.rand(500, 2, generator=torch.Generator().manual_seed(1), dtype=D) - 20
    inside = in_region(places, reach)
    for place, known in zip(places.tolist(), inside.tolist(), strict=True):
        distance = cv2.pointPolygonTest(hull, place, measureDist=True)  # positive inside
        if abs(distance + 20) > 3:  # half of the squares' side of about 40 px; corners of the polygon are cut
            assert known == (distance > -20), place


@pytest.mark.parametrize("shape", [(), (3,), (2, 2)])
def test_many_cameras_have_their_own(shape: tuple[int, ...]) -> None:
    generator = torch.Generator().manual_seed(2)
    pixels = 100 * torch.rand(*shape, 4, 10, 2, generator=generator, dtype=D)
    used = torch.rand(*shape, 4, 10, generator=generator) > 0.3
    reach = covered_region(pixels, used)
    assert reach.shape == (*shape, 64)
    assert in_region(pixels.flatten(-3, -2), reach)[used.flatten(-2)].all()
    assert not in_region(pixels.flatten(-3, -2) + 300, reach).any()
    assert not in_region(torch.full((*shape, 1, 2), torch.nan, dtype=D), reach).any()
    assert not in_region(pixels[..., 0, :, :], covered_region(pixels, torch.zeros_like(used))).any()


def test_corners_that_were_not_used_do_not_count() -> None:
    views = dp.example_views("left")
    hidden = torch.zeros_like(views.visible)
    hidden[5] = True
    calibration = dp.calibrate(views.hiding(hidden), dp.Chessboard())
    torch.testing.assert_close(calibration.region, covered_region(views.pixels, views.visible & ~hidden).to(D))


def test_a_located_view_keeps_the_region_of_its_camera(tmp_path) -> None:
    views, board = dp.example_views("left"), dp.Chessboard()
    calibration = dp.calibrate(views[:8], board)
    located = dp.locate(views[8:9], board, calibration)
    assert located.region is not None
    assert torch.equal(located.region, calibration.region)
    assert dp.locate(views[8:9], board, located).region is located.region
    assert dp.locate(views[8:9], board, calibration.camera).region is None
    held = dp.refine(views[:8], board, calibration.camera, fixed=("focal", "principal_point", "distortion"))
    assert held.region is None
    for number, found in enumerate((calibration, located, dp.locate(views[8:9], board, calibration.camera))):
        path = tmp_path / f"{number}.json"
        dp.save_camera(path, found)
        again = dp.load_calibration(path)
        assert (again.region is None) == (found.region is None)
        assert found.region is None or torch.equal(again.region, found.region)
        assert torch.equal(again.degrees_of_freedom, found.degrees_of_freedom)
