"""Points whose pixels in two cameras are not of one point are told, and the deviations hold it."""

import math
import warnings

import pytest
import torch

import diffproj as dp
from diffproj.calibration.rigs import triangulation

PLACES = torch.tensor([[10.0, 20, 400], [50, -20, 500], [-60, 10, 450], [0, 0, 600]], dtype=torch.float64)


@pytest.fixture(scope="module")
def rig():
    pair = {name: dp.example_views(name) for name in ("left", "right")}
    return dp.calibrate_rig(pair, dp.Chessboard())


def _seen(rig, sigma, generator, places=PLACES):
    pixels = {name: camera.project(places)[0] for name, camera in rig.cameras.items()}
    return {
        name: uv + sigma * torch.randn(uv.shape, generator=generator, dtype=uv.dtype) for name, uv in pixels.items()
    }


def test_derivatives_by_a_point_are_those_of_its_pixels(rig):
    only_cameras = triangulation.Rig(rig.cameras, {}, None, {})
    for name, camera in rig.cameras.items():
        found = triangulation._by_camera_point(only_cameras, name, PLACES) @ camera.R
        for place, slope in zip(PLACES, found, strict=True):
            expected = torch.autograd.functional.jacobian(lambda X, seer=camera: seer.project(X[None])[0][0], place)
            torch.testing.assert_close(slope, expected, rtol=1e-9, atol=1e-12)


def test_right_pixels_are_left_alone(rig):
    """One false alarm in 10,000 calls is what chance is allowed; 1000 points at once, four times, have none."""
    generator = torch.Generator().manual_seed(2)
    places = PLACES.repeat(250, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(4):
            found = rig.triangulate(_seen(rig, 0.3, generator, places), pixel_sigma=0.3)
            assert not found.disagrees.any()


def test_corners_of_a_held_out_moment_are_left_alone():
    """Of real corners, of a moment that the rig was not calibrated on, none is doubtful."""
    pair = {name: dp.example_views(name) for name in ("left", "right")}
    rig = dp.calibrate_rig({name: views[1:] for name, views in pair.items()}, dp.Chessboard())
    found = rig.triangulate({name: views.pixels[0] for name, views in pair.items()})
    assert found.valid.all()
    assert not found.disagrees.any()


def test_the_pixel_of_another_point_is_told_and_held(rig):
    """The third point's pixel in the right camera is that of the fourth: far off by the deviations of before, and within 3 of those that are told."""
    pixels = _seen(rig, 0.1, torch.Generator().manual_seed(3))
    right = rig.triangulate(pixels, pixel_sigma=0.1)
    pixels["right"][2] = pixels["right"][3]
    with pytest.warns(dp.CameraDisagreementWarning, match="point 2 is further from the cameras' rays"):
        found = rig.triangulate(pixels, pixel_sigma=0.1)
    assert found.disagrees.tolist() == [False, False, True, False]
    others = torch.tensor([0, 1, 3])
    assert torch.equal(found.covariance[others], right.covariance[others])
    off = (found.points[2] - PLACES[2]).abs()
    assert (off > 10 * right.deviations[2]).any()
    assert (off < 3 * found.deviations[2]).all()
    length, deviation = found.length(2, 3)
    assert abs(length - float((PLACES[2] - PLACES[3]).norm())) < 3 * deviation
    assert "1 doubtful" in repr(found)
    assert found.to_dict()["disagrees"] == found.disagrees.tolist()


def test_pixels_that_are_less_exact_than_said_are_told(rig):
    """Picked by hand to 1 px, and taken for a detector's."""
    pixels = _seen(rig, 1.0, torch.Generator().manual_seed(4))
    with pytest.warns(dp.CameraDisagreementWarning, match="as exact as pixel_sigma says"):
        rig.triangulate(pixels, pixel_sigma=0.05)


def test_a_point_that_one_camera_alone_sees_is_not_doubtful(rig):
    """It is not valid, and says nothing of the others."""
    pixels = _seen(rig, 0.2, torch.Generator().manual_seed(5))
    pixels["left"][1] = torch.nan
    found = rig.triangulate(pixels, pixel_sigma=0.2)
    assert found.valid.tolist() == [True, False, True, True]
    assert not found.disagrees.any()
    assert found.deviations.isnan().all(-1).tolist() == [False, True, False, False]
    assert found.between(0, 1).isnan().all()
    assert all(math.isnan(number) for number in found.length(0, 1))
    assert all(math.isfinite(number) for number in found.length(0, 2))
    columns = found.to_dict()
    assert [math.isnan(x) for x in columns["x"]] == [math.isnan(x) for x in columns["z_deviation"]]
    assert math.isnan(columns["x"][1])


def test_pixels_beyond_the_photograph_are_told(rig):
    pixels = _seen(rig, 0.1, torch.Generator().manual_seed(3))
    pixels["right"][3] = torch.nan
    pixels["right"][:2] += torch.tensor([2000.0, 0])
    said = r"triangulate: right: pixel \(2.* and 1 more outside of the photograph of 640"
    with pytest.warns(UserWarning, match=said):
        rig.triangulate(pixels, pixel_sigma=0.1)
