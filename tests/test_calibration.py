"""`calibrate` and `locate`: simulated truth, OpenCV's own figures, the bundled corners, and what is refused."""

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj import calibration as calibration_module
from diffproj import synthetic

D = torch.float64


@pytest.fixture(scope="module")
def simulated() -> tuple[dp.Camera, dp.Views, dp.Chessboard]:
    lens = dp.BrownConrady(torch.tensor([-0.25, 0.08, 0.001, -0.0005, 0.01], dtype=D))
    setup = synthetic.paper_setup(lens)
    return setup.fit, synthetic.corner_views(setup.fit, setup.board, noise_px=0.1), setup.board


def test_finds_the_truth(simulated: tuple[dp.Camera, dp.Views, dp.Chessboard]) -> None:
    truth, views, board = simulated
    calibration = dp.calibrate(views, board)
    # Noise of 0.1 px on each coordinate: an RMS of 0.1 sqrt(2), less a little for what the parameters absorb.
    assert 0.12 < calibration.rms < 0.145
    assert (calibration.camera.K - truth.K[0]).abs().max() < 2
    assert (calibration.cameras.center - truth.center).norm(dim=-1).max() < 2  # millimetres from 400 away
    assert calibration.camera.batch_shape == ()
    assert torch.equal(calibration.camera.R, torch.eye(3, dtype=D))


def test_residuals_are_opencvs(simulated: tuple[dp.Camera, dp.Views, dp.Chessboard]) -> None:
    _, views, board = simulated
    calibration = dp.calibrate(views, board)
    K, dist, rvecs, tvecs = calibration.cameras.to_opencv()
    total = 0.0
    for i in range(len(views)):
        projected, _ = cv2.projectPoints(board.points.numpy(), rvecs[i], tvecs[i], K[i], dist[i])
        error = projected.reshape(-1, 2) - views.pixels[i].numpy()
        np.testing.assert_allclose(calibration.residuals[i].numpy(), error, atol=1e-9)
        total += float(np.square(error).sum())
    assert calibration.rms == pytest.approx((total / (10 * 54)) ** 0.5, rel=1e-9)
    torch.testing.assert_close((calibration.view_rms.square().mean()).sqrt().item(), calibration.rms)


@pytest.mark.parametrize(("side", "rms", "focal"), [("left", 0.180, 532.8), ("right", 0.185, 537.2)])
def test_bundled_corners(side: str, rms: float, focal: float) -> None:
    calibration = dp.calibrate(dp.example_views(side), dp.Chessboard())
    assert 0.15 < calibration.rms < rms
    assert calibration.camera.K[0, 0].item() == pytest.approx(focal, abs=1.5)
    pinhole = dp.calibrate(dp.example_views(side), dp.Chessboard(), "none")
    assert pinhole.rms > 1.4
    assert pinhole.camera.distortion is None
    four = dp.calibrate(dp.example_views(side), dp.Chessboard(), "brown4")
    assert four.camera.distortion is not None
    assert four.camera.distortion.coefficients.shape == (4,)
    assert calibration.rms <= four.rms < 1.1 * calibration.rms


def test_both_frames_of_the_board_tell_the_same_story() -> None:
    views = dp.example_views("left")
    opencv, paper = (dp.calibrate(views, dp.Chessboard(axes=axes)) for axes in ("opencv", "paper"))
    assert paper.rms == pytest.approx(opencv.rms, rel=1e-6)
    torch.testing.assert_close(paper.camera.K, opencv.camera.K, rtol=1e-5, atol=0)
    # z points into the board in OpenCV's frame and towards the camera in the paper's.
    assert (opencv.cameras.center[:, 2] < 0).all()
    assert (paper.cameras.center[:, 2] > 0).all()


def test_missing_corners_do_not_matter(simulated: tuple[dp.Camera, dp.Views, dp.Chessboard]) -> None:
    truth, views, board = simulated
    hidden = torch.rand(len(views), 54) < 0.3
    holes = views.hiding(hidden)
    poisoned = dp.Views(torch.where(hidden[..., None], torch.nan, views.pixels), ~hidden, size=views.size)
    first, second = dp.calibrate(holes, board), dp.calibrate(poisoned, board)
    torch.testing.assert_close(first.camera.K, second.camera.K, rtol=1e-6, atol=1e-6)
    assert (first.camera.K - truth.K[0]).abs().max() < 3
    assert (first.residuals[hidden] == 0).all()


def test_deviations_are_opencvs() -> None:
    views, board = dp.example_views("left"), dp.Chessboard()
    deviations = calibration_module._deviations(dp.calibrate(views, board))
    object_points = [board.points.numpy().astype(np.float32)] * len(views)
    image_points = [pixels.numpy().astype(np.float32) for pixels in views.pixels]
    want = cv2.calibrateCameraExtended(object_points, image_points, views.size, None, None)[5].ravel()[:4]
    # OpenCV divides by the degrees of freedom, not by the number of residuals.
    freedom = 1 - (9 + 6 * 13) / (13 * 54 * 2)
    np.testing.assert_allclose(deviations.numpy(), want * freedom**0.5, rtol=1e-3)


def test_locate_finds_each_pose(simulated: tuple[dp.Camera, dp.Views, dp.Chessboard]) -> None:
    truth, views, board = simulated
    located = dp.locate(views, board, truth[0])
    assert located.rms < 0.145
    assert (located.cameras.center - truth.center).norm(dim=-1).max() < 1
    exact = synthetic.corner_views(truth, board, noise_px=0.0)
    torch.testing.assert_close(dp.locate(exact, board, truth[0]).cameras.t, truth.t, rtol=0, atol=1e-6)


def test_locate_keeps_the_better_of_two_poses() -> None:
    # From afar and nearly face on, a plane tilted one way looks almost like the plane tilted the other way.
    board = dp.Chessboard()
    K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=D)
    angle = torch.tensor([0.25, -0.25], dtype=D)
    R = dp.rotation_from_euler(angle, angle.roll(1), 0 * angle)
    truth = dp.Camera(K, size=(640, 480)).at(R, torch.tensor([-100.0, -60, 2500], dtype=D))
    views = synthetic.corner_views(truth, board, noise_px=0.02)
    located = dp.locate(views, board, truth[0])
    cosine = ((located.cameras.R * truth.R).sum(dim=(-2, -1)) - 1) / 2
    assert (cosine.clamp(-1, 1).arccos().rad2deg() < 2).all()


def test_summary_says_what_was_found() -> None:
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    text = calibration.summary()
    assert "focal lengths" in text
    assert "k3" in text
    assert "left05.jpg" in text
    assert "k1" not in dp.calibrate(dp.example_views("left"), dp.Chessboard(), "none").summary()


def test_views_that_determine_nothing_are_named(simulated: tuple[dp.Camera, dp.Views, dp.Chessboard]) -> None:
    truth, _, board = simulated
    shifts = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [5, 5, 0]], dtype=D)
    parallel = truth[0].at(truth.R[0], truth.t[0] + shifts)
    with pytest.raises(dp.CalibrationError, match="do not determine focal length"):
        dp.calibrate(synthetic.corner_views(parallel, board), board)


@pytest.mark.plain
def test_bad_input_is_refused_by_name(simulated: tuple[dp.Camera, dp.Views, dp.Chessboard]) -> None:
    truth, views, board = simulated
    few = views.hiding(torch.arange(54) >= 3)
    raised = type("Raised", (), {"points": board.points + 1})()
    fisheye = dp.Camera(truth.K[0], distortion=dp.KannalaBrandt(torch.zeros(4, dtype=D)))
    cases = [
        (TypeError, "views: want dp.Views, got Tensor", lambda: dp.calibrate(views.pixels, board)),
        (
            ValueError,
            "distortion: want one of none, brown4, brown5, got 'brown'",
            lambda: dp.calibrate(views, board, "brown"),
        ),
        (ValueError, "views: want 40 corners .* got 54", lambda: dp.calibrate(views, dp.Chessboard(8, 5))),
        (ValueError, "views: want at least 2 to find the intrinsics, got 1", lambda: dp.calibrate(views[0], board)),
        (ValueError, "views: want at least one, got none", lambda: dp.locate(views[[]], board, truth[0])),
        (ValueError, "views: want the photographs' size", lambda: dp.calibrate(dp.Views(views.pixels), board)),
        (ValueError, "at least 4 visible corners .* view 1, view 2", lambda: dp.calibrate(few, board)),
        (ValueError, "board: want all points on z = 0", lambda: dp.calibrate(views, raised)),
        (ValueError, "views: want those of one camera", lambda: dp.calibrate(dp.Views(views.pixels[None]), board)),
        (ValueError, "camera: want a single camera", lambda: dp.locate(views, board, truth)),
        (TypeError, "camera: want a pinhole or a BrownConrady lens", lambda: dp.locate(views, board, fisheye)),
    ]
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()
