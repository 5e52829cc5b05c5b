"""Where no plane is given, z = 0 is taken; landmarks with heights over the sea are far from it, and that is told."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.measurement.default_plane import far_from_landmarks

D = torch.float64
GROUND = torch.tensor([[-8.0, 20, 0], [9, 22, 0.1], [-6, 35, 0.3], [7, 30, -0.1], [0, 26, 0]], dtype=D)
MAST = dp.Camera.mounted(9.0, 20.0, focal=700.0, size=(640, 480))
UNPOSED = dp.Camera(MAST.K, size=MAST.size)


def located(height: float, landmarks: torch.Tensor = GROUND) -> dp.Calibration:
    """The mast's camera from landmarks whose z counts from `height` below the ground."""
    shown = MAST.project(landmarks)[0]
    world = landmarks + landmarks.new_tensor([0.0, 0.0, height])
    return dp.locate(dp.Views([shown], size=MAST.size), dp.Landmarks(world), UNPOSED, pixel_sigma=0.5)


def test_heights_over_the_sea_are_told(tmp_path: Path) -> None:
    """With z = 512 on the ground, 4.00 m on it are 232 m on z = 0."""
    found, photograph = located(512.0), np.zeros((480, 640), np.uint8)
    pixels = MAST.project(torch.tensor([[-2.0, 24, 0], [2, 24, 0]], dtype=D))[0]
    lengths = [float(dp.measure(pixels, found, dp.Plane.z(z), pixel_sigma=0.5).lengths().value[0]) for z in (0.0, 512)]
    assert lengths == pytest.approx([4 * 521 / 9, 4], abs=0.01)
    told = r"from z = 511.9 to 512.3: .* come out wrong; give plane=dp.Plane.z\(511.9\), or dp.Plane.z\(0.0\)"
    with pytest.warns(UserWarning, match=told):
        dp.write_measuring_page(tmp_path / "page.html", photograph, found)
    with pytest.warns(UserWarning, match=told):
        dp.AccuracyMap.over_image(found, step=200)
    with pytest.warns(UserWarning, match=told):
        dp.AccuracyMap.over_plane(found, (-5, 20, 5, 30), shape=(2, 2))


def test_a_plane_that_is_given_is_taken_at_its_word(tmp_path: Path) -> None:
    found, plane = located(512.0), dp.Plane.z(0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dp.write_measuring_page(tmp_path / "page.html", np.zeros((480, 640), np.uint8), found, plane)
        dp.AccuracyMap.over_image(found, plane, step=200)


@pytest.mark.parametrize(
    ("height", "far"),
    [(0.0, False), (0.09, False), (0.28, False), (0.42, True), (-0.55, True), (-40.0, True)],
    ids=["on it", "among them", "half their range below", "below", "above", "far above"],
)
def test_what_is_far(height: float, far: bool) -> None:
    """Landmarks from -0.1 to 0.3 m, seen from 9 m: z = 0 among them, and below or above them all."""
    found = far_from_landmarks(located(height), 0)
    assert (found is not None) is far


def test_landmarks_of_many_heights_tell_no_ground() -> None:
    """A facade from 1 to 6 m over the ground: z = 0 is as near to the lowest as landmarks are to each other."""
    facade = torch.tensor([[-6.0, 25, 1], [6, 25, 1.5], [-5, 26, 5], [6, 26, 6], [0, 25, 3]], dtype=D)
    assert far_from_landmarks(located(0.0, facade), 0) is None


def test_landmarks_on_a_wall_above_the_camera_tell_no_ground() -> None:
    """Marks from 3 to 5 m on a wall, seen from 1.6 m over the ground z = 0."""
    camera = dp.Camera.mounted(1.6, 0.0, focal=900.0, size=(1280, 960))
    wall = torch.tensor([[-5.0, 20, 3], [5, 20, 3], [-5, 20, 5], [5, 20, 5], [0, 20, 4], [-2, 20, 4.5]], dtype=D)
    views = dp.Views([camera.project(wall)[0]], size=camera.size)
    found = dp.locate(views, dp.Landmarks(wall), dp.Camera(camera.K, size=camera.size), pixel_sigma=0.5)
    assert far_from_landmarks(found, 0) is None


def test_a_board_lies_where_it_says() -> None:
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    assert far_from_landmarks(calibration, 0) is None
