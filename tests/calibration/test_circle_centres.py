"""Circles: the middle of an ellipse is not the centre's image, and a calibration that knows that."""

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.calibration.circle_centres import middle_minus_centre
from diffproj.calibration.fitting.options import calibration_options
from diffproj.calibration.one_lens import calibrated

D = torch.float64
BOARD = dp.CircleGrid(7, 5, spacing=20.0, diameter=17.0)
TRUE = [600.0, 602.0, 322.0, 238.0]


def cameras(tilt_deg: float = 55.0, lens: bool = True) -> dp.Camera:
    f_x, f_y, c_x, c_y = TRUE
    K = torch.tensor([[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]], dtype=D)
    bend = dp.BrownConrady(torch.tensor([-0.2, 0.05, 0, 0, 0], dtype=D)) if lens else None
    camera = dp.Camera(K, distortion=bend, size=(640, 480))
    return dp.synthetic.random_cameras(camera, BOARD, 12, tilt=np.radians(tilt_deg), distance=(1.2, 2.0), seed=1)


def test_without_a_lens_the_middle_is_that_of_the_conic():
    """Against the textbook's: the circle's conic carried over by the plane's homography."""
    camera = cameras(lens=False)[0]
    H = camera.K @ torch.stack([camera.R[:, 0], camera.R[:, 1], camera.t], dim=-1)
    shift = middle_minus_centre(camera, BOARD)
    for point, centre, moved in zip(BOARD.points, camera.project(BOARD.points)[0], shift, strict=True):
        x, y, r = float(point[0]), float(point[1]), BOARD.diameter / 2
        circle = torch.tensor([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - r * r]], dtype=D)
        pole = H @ torch.linalg.inv(circle) @ H.T @ torch.tensor([0.0, 0, 1], dtype=D)
        torch.testing.assert_close(centre + moved, pole[:2] / pole[2], rtol=0, atol=1e-7)


def test_with_a_lens_the_middle_is_that_of_the_drawn_ellipse():
    camera = cameras()[3]
    shift = middle_minus_centre(camera, BOARD)
    angle = torch.linspace(0, 2 * np.pi, 720, dtype=D)[:-1]
    rim = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1) * BOARD.diameter / 2
    for k in (0, 17, 34):
        outline = camera.project(BOARD.points[k] + rim)[0].numpy().astype(np.float32)
        middle = np.array(cv2.fitEllipseDirect(outline - outline.mean(0))[0]) + outline.mean(0)
        want = middle - camera.project(BOARD.points[k : k + 1])[0][0].numpy()
        np.testing.assert_allclose(shift[k].numpy(), want, atol=0.01)


@pytest.fixture(scope="module")
def middles() -> tuple[dp.Views, dp.Views]:
    """Where centres are seen, with a little noise, and the middles that a photograph shows there."""
    seen = dp.synthetic.corner_views(cameras(), BOARD, noise_px=0.01, seed=2)
    return seen, dp.Views(seen.pixels + middle_minus_centre(cameras(), BOARD), seen.visible, size=seen.size)


def test_calibrate_finds_the_camera_of_the_centres(middles):
    centres, seen = middles
    found = dp.calibrate(seen, BOARD)
    options = calibration_options("calibrate", {})
    best, naive = (calibrated(views, BOARD, "brown5", options) for views in (centres, seen))
    deviations = torch.stack(list(best.covariance.deviations.values()))
    assert bool(((found.shared - best.shared).abs() < 0.3 * deviations).all())
    # It matters: taken for centres, the middles give a wrong camera, and leave more error than the noise.
    assert float(naive.rms) > 1.4 * float(best.rms)  # measured: .0201 and .0133 px; f 599.3 for 600.0
    assert bool(((naive.shared - best.shared).abs() > 3 * deviations)[:4].any())
    torch.testing.assert_close(found.views.pixels, centres.pixels, rtol=0, atol=0.01)


@pytest.mark.filterwarnings("ignore:locate. a circle grid:UserWarning")
def test_the_other_ways_know_it_too(middles):
    _, seen = middles
    found = dp.calibrate(seen, BOARD)
    assert float(dp.locate(seen[:3], BOARD, found).rms) < 0.02
    assert float(dp.refine(seen, BOARD, found.camera).rms) == pytest.approx(float(found.rms), rel=1e-3)
    assert bool((dp.cross_validate(seen, BOARD, folds=3).held_out_px < 0.03).all())
    assert bool((dp.refine(seen, BOARD, found.camera, differentiable=True).camera.K > -1).all())
