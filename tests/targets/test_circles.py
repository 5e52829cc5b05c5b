"""Circle grids: their points are OpenCV's, and their images' middles are found, with some of them hidden."""

import dataclasses
import itertools
import re

import cv2
import numpy as np
import pytest

import diffproj as dp
from diffproj.calibration.circle_centres import middle_minus_centre
from tests.targets.boards_in_view import camera_before, photographed

PLAIN = dp.CircleGrid(7, 5, spacing=20.0, diameter=11.0)
LYING = dp.CircleGrid(11, 4, spacing=14.0, diameter=11.0, asymmetric=True)
STANDING = dp.CircleGrid(4, 11, spacing=14.0, diameter=11.0, asymmetric=True)


def test_the_points_of_an_asymmetric_grid_are_opencvs():
    places = [((2 * c + r % 2) * 14.0, r * 14.0, 0.0) for r in range(11) for c in range(4)]
    assert STANDING.points.tolist() == [list(place) for place in places]
    assert sorted(LYING.points[:, [1, 0]].tolist()) == sorted(STANDING.points[:, :2].tolist())


def test_opencv_finds_what_is_printed():
    image = np.uint8(255 * (1 - STANDING.artwork.darkness((-20.0, -20.0), 0.4, (500, 400))))
    found, centres = cv2.findCirclesGrid(image, (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    seen = dp.detect(image, STANDING).pixels[0].numpy()
    apart = np.linalg.norm(seen[:, None] - centres.reshape(1, -1, 2), axis=-1).min(axis=1)
    assert apart.max() < 0.5
    truth = (STANDING.points[:, :2].numpy() + 5.5 + 20) / 0.4 - 0.5
    assert np.abs(seen - truth).max() < 0.02


@pytest.mark.parametrize("board", [LYING, STANDING], ids=["lying", "standing"])
def test_middles_are_where_they_are(board):
    """Measured on better rendered images: .010 px RMS to the middles, and .03 to .17 px to the centres."""
    camera = camera_before(board, 1, 14, tilt_deg=40)
    found = dp.detect(photographed(camera, board), board)
    truth = camera.project(board.points)[0] + middle_minus_centre(camera, board)
    assert bool(found.visible.all())
    off = (found.pixels[0] - truth).norm(dim=-1)
    assert float(off.square().mean().sqrt()) < 0.05


def test_a_symmetric_grid_is_never_mirrored_and_follows():
    camera = camera_before(PLAIN, 2, 20, tilt_deg=20)
    found = dp.detect([photographed(camera, PLAIN)] * 2, PLAIN)
    truth = (camera.project(PLAIN.points)[0] + middle_minus_centre(camera, PLAIN)).numpy()
    off = [np.linalg.norm(found.pixels[0].numpy() - order, axis=-1).max() for order in (truth, truth[::-1])]
    assert min(off) < 0.2
    assert bool((found.pixels[0] == found.pixels[1]).all())


def test_hidden_circles_are_told():
    camera = camera_before(LYING, 4, 14, tilt_deg=20)
    image = photographed(camera, LYING)
    truth = camera.project(LYING.points)[0]
    u, v = truth[16].round().int().tolist()
    image[v - 8 : v + 9, u - 8 : u + 9] = 230
    found = dp.detect(image, LYING)
    assert not bool(found.visible[0, 16])
    assert int(found.visible.sum()) >= 40


@pytest.mark.parametrize("board", [PLAIN, LYING], ids=["plain", "asymmetric"])
def test_light_circles_on_dark_are_found_as_dark_ones_on_light(board):
    image = photographed(camera_before(board, 3, 18, tilt_deg=25), board)
    found, inverted = dp.detect(image, board), dp.detect(255 - image, board)
    assert bool((inverted.visible == found.visible).all())
    assert float((inverted.pixels - found.pixels).abs().max()) < 1e-6


def test_a_paper_that_looks_like_an_ellipse_hides_no_circle():
    """The dark halo that a threshold sees around white paper is as round as some ellipses are, and holds all circles."""
    board = dp.CircleGrid(7, 5, spacing=20.0, diameter=9.0)
    x, y = np.meshgrid(np.arange(480.0), np.arange(360.0))
    image = np.where(np.hypot((x - 240) / 1.06, y - 180) < 100, 225.0, 140.0)
    centres = 240 + 16 * (np.arange(7) - 3.0), 180 + 16 * (np.arange(5) - 2.0)
    for u, v in itertools.product(*centres):
        image -= 190 * np.clip(0.5 + 4.5 - np.hypot(x - u, y - v), 0, 1)
    found = dp.detect(cv2.GaussianBlur(np.uint8(image), (0, 0), 0.9), board)
    assert bool(found.visible.all())
    truth = np.stack(np.meshgrid(*centres), axis=-1).reshape(-1, 2)
    off = [np.linalg.norm(found.pixels[0].numpy() - order, axis=-1).max() for order in (truth, truth[::-1])]
    assert min(off) < 0.05


@pytest.mark.parametrize("light", ["glare", "shadow"])
def test_uneven_light_draws_no_middle_aside(light):
    """A reflection that saturates, and a soft shadow: before the fit knew of either, .12 and .06 px RMS here."""
    camera = camera_before(PLAIN, 2, 20, tilt_deg=20)
    truth = (camera.project(PLAIN.points)[0] + middle_minus_centre(camera, PLAIN)).numpy()
    image = photographed(camera, PLAIN).astype(float)
    y, x = np.indices(image.shape)
    if light == "glare":
        image += 250 * np.exp(-((x - truth[10, 0] - 9) ** 2 + (y - truth[10, 1]) ** 2) / (2 * 20.0**2))
    else:
        image *= 1 - 0.6 / (1 + np.exp(-(x + y - truth[17].sum()) / 10))
    found = dp.detect(np.rint(image.clip(0, 255)).astype(np.uint8), PLAIN)
    seen, pixels = found.visible[0].numpy(), found.pixels[0].numpy()
    assert seen.mean() > 0.8
    off = [np.linalg.norm(pixels - order, axis=-1)[seen] for order in (truth, truth[::-1])]
    assert min(float(np.sqrt((error**2).mean())) for error in off) < 0.045


def test_a_grid_that_may_be_turned_is_refused():
    """Without the circles of its last row, an asymmetric grid of odd size looks like itself turned."""
    board = dp.CircleGrid(9, 5, spacing=14.0, diameter=10.0, asymmetric="columns")
    camera = camera_before(board, 6, 13, tilt_deg=5)
    image = photographed(camera, board)
    assert bool(dp.detect(image, board).visible.all())
    for u, v in camera.project(board.points)[0].reshape(5, 9, 2)[-1, 1::2].round().int().tolist():
        image[v - 8 : v + 9, u - 8 : u + 9] = 230
    with pytest.raises(dp.BoardNotFoundError):
        dp.detect(image, board)


def test_words_and_numbers_that_cannot_be():
    with pytest.raises(ValueError, match="diameter: want circles apart, less than 20 at this spacing, got 20"):
        dp.CircleGrid(7, 5, 20.0, 20.0)
    with pytest.raises(ValueError, match="asymmetric: want False, True, 'rows' or 'columns', got 'both'"):
        dp.CircleGrid(7, 5, 20.0, 10.0, "both")
    with pytest.raises(dp.BoardNotFoundError, match=r"want a circle grid with 7 x 5 circles"):
        dp.detect(np.full((240, 320), 200, np.uint8), PLAIN)


@pytest.mark.parametrize(("factor", "named"), [(0.5, True), (0.7, True), (0.9, False), (1.15, False), (1.35, True)])
@pytest.mark.parametrize("board", [PLAIN, LYING], ids=["plain", "asymmetric"])
def test_another_diameter_is_named(board, factor, named):
    """The radius given for the diameter moved focal lengths by eight of their deviations, and nothing was said."""
    image = photographed(camera_before(board, 5, 18, tilt_deg=25), board)
    given = dataclasses.replace(board, diameter=min(factor * board.diameter, 0.94 * board.apart))
    if not named:
        assert bool(dp.detect(image, given).visible.all())
        return
    with pytest.raises(dp.BoardNotFoundError) as refused:
        dp.detect(image, given)
    told = re.search(
        r"circles are about ([\d.]+) across where they should be ([\d.]+): give the diam", str(refused.value)
    )
    assert told is not None
    assert float(told[1]) == pytest.approx(board.diameter, rel=0.05)
    assert float(told[2]) == pytest.approx(given.diameter, rel=0.01)


@pytest.mark.parametrize("change", ["blurred", "over-exposed", "dark"])
def test_light_and_blur_make_no_other_diameter(change):
    image = photographed(camera_before(PLAIN, 6, 14, tilt_deg=30), PLAIN).astype(np.float64)
    if change == "blurred":
        image = cv2.GaussianBlur(image, (0, 0), 2.0)
    else:
        image = (image * 1.6 - 10).clip(0, 255) if change == "over-exposed" else 255 * (image / 255) ** 2.2
    assert len(dp.detect(image.astype(np.uint8), PLAIN)) == 1
