"""`calibrate`, `refine` and `locate` against OpenCV's solvers, simulated truth and the bundled corners."""

import os
from collections.abc import Sequence

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj import synthetic
from diffproj.lens.models import LensModel

D = torch.float64
FLAGS = {
    "brown4": cv2.CALIB_FIX_K3,
    "brown5": 0,
    "brown8": cv2.CALIB_RATIONAL_MODEL,
    "none": cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
}
TRUE_LENSES: dict[str, dp.Lens] = {
    "brown4": dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001], dtype=D)),
    "brown5": dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002], dtype=D)),
    "brown8": dp.BrownConrady(torch.tensor([0.2, -0.1, 0.001, -0.0005, 0.02, 0.5, -0.05, 0.01], dtype=D)),
    "fisheye": dp.KannalaBrandt(torch.tensor([0.02, -0.01, 0.004, -0.001], dtype=D)),
}
K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
BOARD = dp.Chessboard()


def simulate(
    views: int,
    lens: dp.Lens | None = TRUE_LENSES["brown5"],
    noise_px: float = 0.2,
    seed: int = 0,
    cameras: Sequence[int] = (),
    intrinsics: torch.Tensor = K,
) -> tuple[dp.Camera, dp.Views]:
    """True cameras `(*cameras, views)` and what they see."""
    camera = dp.Camera(intrinsics, distortion=lens, size=(640, 480))
    count = int(np.prod(cameras, dtype=int)) * views
    posed = synthetic.random_cameras(camera, BOARD, count, seed=seed)
    truth = camera.at(posed.R.reshape(*cameras, views, 3, 3), posed.t.reshape(*cameras, views, 3))
    return truth, synthetic.corner_views(truth, BOARD, noise_px=noise_px, seed=seed)


def by_opencv(views: dp.Views, model: str) -> tuple[float, np.ndarray, np.ndarray]:
    """RMS, K and coefficients of OpenCV's minimum, from its own start; corners as it takes them, in float32."""
    points = BOARD.points.numpy().astype(np.float32)
    object_points = [points[seen] for seen in views.visible.numpy()]
    image_points = [p[s].astype(np.float32) for p, s in zip(views.pixels.numpy(), views.visible.numpy(), strict=True)]
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-16)
    if model == "fisheye":
        where = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # OpenCV 4, OpenCV 5
        flags = where.CALIB_RECOMPUTE_EXTRINSIC | where.CALIB_FIX_SKEW
        found = cv2.fisheye.calibrate(
            [p.reshape(1, -1, 3).astype(np.float64) for p in object_points],
            [p.reshape(1, -1, 2).astype(np.float64) for p in image_points],
            views.size, np.eye(3), np.zeros(4), flags=flags, criteria=stop,
        )  # fmt: skip
        return found[0], found[1], found[2].ravel()
    rms, found_K, dist, _, _ = cv2.calibrateCamera(
        object_points, image_points, views.size, None, None, flags=FLAGS[model], criteria=stop
    )
    return rms, found_K, dist.ravel()


def by_opencv_from(truth: dp.Camera, pixels: torch.Tensor) -> float:
    """The RMS of OpenCV's minimum from the true intrinsics."""
    true_K, dist, _, _ = truth[0].to_opencv()
    points = [BOARD.points.numpy().astype(np.float32)] * len(pixels)
    corners = [view.numpy().astype(np.float32) for view in pixels]
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    return cv2.calibrateCamera(points, corners, (640, 480), true_K, dist, flags=flags, criteria=stop)[0]


def in_float32(views: dp.Views) -> dp.Views:
    """The same corners as OpenCV sees them."""
    return views.to(torch.float32).to(D)


def opencvs_rms(calibration: dp.Calibration, fisheye: bool = False) -> float:
    """The RMS of the calibration by OpenCV's own projection."""
    cameras_K, dist, rvecs, tvecs = calibration.cameras.to_opencv()
    total = 0.0
    for i, seen in enumerate(calibration.used.numpy()):
        if not seen.any():
            continue
        points = BOARD.points.numpy()[seen].reshape(-1, 1, 3)
        project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
        projected, _ = project(points, rvecs[i], tvecs[i], cameras_K[i], dist[i])
        total += float(np.square(projected.reshape(-1, 2) - calibration.views.pixels[i].numpy()[seen]).sum())
    return (total / int(calibration.used.sum())) ** 0.5


def folds(found_K: np.ndarray, lens: np.ndarray, views: dp.Views) -> bool:
    """Whether a lens of OpenCV has no inverse at some pixel of the image's border or at a corner."""
    width, height = views.size or (0, 0)
    u, v = torch.arange(width, dtype=D), torch.arange(height, dtype=D)
    sides = [torch.cartesian_prod(u, torch.tensor([0.0, height - 1], dtype=D)), views.pixels[views.visible]]
    border = torch.cat([*sides, torch.cartesian_prod(torch.tensor([0.0, width - 1], dtype=D), v)])
    camera = dp.Camera(torch.tensor(found_K, dtype=D), distortion=dp.BrownConrady(torch.tensor(lens[:8], dtype=D)))
    return not bool(camera.directions(border)[1].all())


def assert_same_minimum(views: dp.Views, model: LensModel, atol_px: float = 1e-5) -> dp.Calibration:
    views = in_float32(views)
    calibration = dp.calibrate(views, BOARD, model)
    rms, found_K, found_lens = by_opencv(views, model)
    ours = opencvs_rms(calibration, model == "fisheye")
    assert float(calibration.rms) == pytest.approx(ours, rel=1e-9)
    if model == "brown8" and folds(found_K, found_lens, views):
        assert ours <= rms * 1.01
        return calibration
    assert ours <= rms * (1 + 1e-9)
    if atol_px < np.inf:
        np.testing.assert_allclose(calibration.camera.K.numpy(), found_K, rtol=0, atol=atol_px)
    return calibration


# ------------------------------------------------------------------------------------------------------ the minimum


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("model", ["none", "brown4", "brown5", "brown8"])
def test_minimum_is_opencvs_on_bundled_corners(side: str, model: LensModel) -> None:
    calibration = assert_same_minimum(dp.example_views(side), model)
    if model == "brown5":
        assert 0.15 < calibration.rms < {"left": 0.180, "right": 0.185}[side]
        assert calibration.camera.K[0, 0].item() == pytest.approx({"left": 532.8, "right": 537.2}[side], abs=1.5)


@pytest.mark.parametrize("model", ["brown4", "brown5", "fisheye"])
@pytest.mark.parametrize("count", [13, 100])
def test_minimum_is_opencvs_on_simulated_corners(model: LensModel, count: int) -> None:
    _, views = simulate(count, TRUE_LENSES[model])
    assert_same_minimum(views, model)


@pytest.mark.slow
def test_minimum_is_opencvs_for_eight_coefficients() -> None:
    # Along the valley k1 and k4 are known to 20, and a part of 10^11 of the cost is 1e-5 px in focal length.
    _, views = simulate(100, TRUE_LENSES["brown8"])
    assert_same_minimum(views, "brown8", atol_px=3e-5)
    # 13 views hardly determine them: of several minima the one found is OpenCV's, or lower.
    for seed in range(4):
        _, views = simulate(13, TRUE_LENSES["brown8"], seed=seed)
        assert_same_minimum(views, "brown8", atol_px=np.inf)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["brown4", "brown5", "brown8", "fisheye"])
def test_minimum_is_opencvs_for_a_thousand_views(model: LensModel) -> None:
    _, views = simulate(1000, TRUE_LENSES[model])
    assert_same_minimum(views, model)


PHOTOS = os.environ.get("DIFFPROJ_PHOTOS")


@pytest.mark.skipif(PHOTOS is None, reason="DIFFPROJ_PHOTOS names no folder with the photographs")
@pytest.mark.parametrize(("side", "rms"), [("left", 0.1954), ("right", 0.2070)])
def test_rms_of_corners_refined_in_windows_of_five(side: str, rms: float) -> None:
    """The usual recipe for corners, and the RMS that OpenCV and mrcal reach with it."""
    pixels = []
    for number in [*range(1, 10), 11, 12, 13, 14]:
        image = cv2.imread(f"{PHOTOS}/{side}{number:02d}.jpg", cv2.IMREAD_GRAYSCALE)
        found, corners = cv2.findChessboardCorners(image, (9, 6))
        assert found
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 0.001)
        pixels.append(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), stop).reshape(-1, 2))
    views = dp.Views(np.stack(pixels).astype(np.float64), size=(640, 480))
    # OpenCV starts counting at either end of the board: a half turn, which no calibration minds.
    assert float(dp.calibrate(views, BOARD).rms) == pytest.approx(rms, abs=2e-4)


@pytest.mark.parametrize("model", ["brown12", pytest.param("brown14", marks=pytest.mark.slow)])
def test_long_lenses_are_found(model: LensModel) -> None:
    coefficients = [-0.25, 0.05, 0.001, 0.0005, 0.01, 0.02, -0.01, 0.005, 0.002, -0.001, 0.001, 0.0005, 0.02, -0.03]
    lens = dp.BrownConrady(torch.tensor(coefficients[: 12 if model == "brown12" else 14], dtype=D))
    _, views = simulate(60, lens, noise_px=0.05)
    calibration = dp.calibrate(views, BOARD, model, throw=False, max_iterations=300)
    plain = dp.calibrate(views, BOARD, "brown5")
    # 54 corners on 60 views, 6 parameters a view, less a few: the noise's own level.
    assert calibration.rms == pytest.approx(0.05 * (2 * (1 - (60 * 6 + 18) / (60 * 54 * 2))) ** 0.5, rel=0.03)
    assert calibration.rms < plain.rms


def test_residuals_are_opencvs() -> None:
    _, views = simulate(10)
    calibration = dp.calibrate(views, BOARD)
    found_K, dist, rvecs, tvecs = calibration.cameras.to_opencv()
    for i in range(len(views)):
        projected, _ = cv2.projectPoints(BOARD.points.numpy(), rvecs[i], tvecs[i], found_K[i], dist[i])
        error = projected.reshape(-1, 2) - views.pixels[i].numpy()
        np.testing.assert_allclose(calibration.residuals[i].numpy(), error, atol=1e-9)
    torch.testing.assert_close(calibration.view_rms.square().mean().sqrt(), calibration.rms)


def test_finds_the_truth() -> None:
    truth, views = simulate(20, noise_px=0.1)
    calibration = dp.calibrate(views, BOARD)
    deviations = calibration.covariance.deviations
    found = calibration.camera.K
    for (row, column), name in {(0, 0): "f_x", (1, 1): "f_y", (0, 2): "c_x", (1, 2): "c_y"}.items():
        assert abs(found[row, column] - truth.K[0, row, column]) < 4 * deviations[name]
    assert calibration.camera.batch_shape == ()
    assert torch.equal(calibration.camera.R, torch.eye(3, dtype=D))
    assert calibration.converged


def test_exact_corners_give_exact_cameras() -> None:
    truth, views = simulate(13, noise_px=0.0)
    calibration = dp.calibrate(views, BOARD)
    torch.testing.assert_close(calibration.camera.K, truth.K[0], rtol=0, atol=1e-6)
    torch.testing.assert_close(calibration.cameras.t, truth.t, rtol=0, atol=1e-6)


def test_both_frames_of_the_board_tell_the_same_story() -> None:
    views = dp.example_views("left")
    opencv, paper = (dp.calibrate(views, dp.Chessboard(axes=axes)) for axes in ("opencv", "paper"))
    torch.testing.assert_close(paper.rms, opencv.rms, rtol=1e-9, atol=0)
    torch.testing.assert_close(paper.camera.K, opencv.camera.K, rtol=1e-7, atol=0)
    # z points into the board in OpenCV's frame and towards the camera in the paper's.
    assert (opencv.cameras.center[:, 2] < 0).all()
    assert (paper.cameras.center[:, 2] > 0).all()


def test_order_of_views_does_not_matter() -> None:
    views = dp.example_views("right")
    order = torch.randperm(len(views))
    plain, shuffled = dp.calibrate(views, BOARD), dp.calibrate(views[order.tolist()], BOARD)
    torch.testing.assert_close(shuffled.camera.K, plain.camera.K, rtol=1e-9, atol=0)
    torch.testing.assert_close(shuffled.cameras.t, plain.cameras.t[order], rtol=1e-7, atol=1e-7)


# ---------------------------------------------------------------------------------------------------------- batches


def test_a_batch_gives_what_a_loop_gives() -> None:
    _, views = simulate(8, cameras=(3,))
    together = dp.calibrate(views, BOARD)
    assert together.camera.batch_shape == (3,)
    assert together.cameras.batch_shape == (3, 8)
    assert together.rms.shape == (3,)
    assert "3 of 3 cameras converged" in together.message
    for i in range(3):
        alone = dp.calibrate(dp.Views(views.pixels[i], views.visible[i], size=views.size), BOARD)
        torch.testing.assert_close(alone.camera.K, together.camera.K[i], rtol=1e-9, atol=0)
        torch.testing.assert_close(alone.cameras.t, together.cameras.t[i], rtol=1e-9, atol=1e-7)
        torch.testing.assert_close(alone.covariance.view(2), together.covariance.view(2)[i], rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("hopeless", ["nan", "empty", "parallel"])
def test_a_hopeless_camera_disturbs_no_neighbour(hopeless: str) -> None:
    truth, views = simulate(8, cameras=(4,))
    good = dp.calibrate(views, BOARD)
    pixels, visible = views.pixels.clone(), views.visible.clone()
    if hopeless == "nan":
        pixels[1, 3, 7, 0] = torch.nan
    elif hopeless == "empty":
        visible[1] = False
    else:
        level = truth[1, 0].at(torch.eye(3, dtype=D), torch.tensor([-100.0, -60, 500], dtype=D))
        shifts = 20 * torch.randn(8, 3, dtype=D)
        pixels[1] = level.at(level.R.expand(8, 3, 3), level.t + shifts).project(BOARD.points)[0]
        pixels[1] += 0.2 * torch.randn_like(pixels[1])
    broken = dp.Views.unchecked(pixels, visible, views.names, views.size)
    mixed = dp.calibrate(broken, BOARD, throw=False)
    want = {"nan": dp.Status.DIVERGED, "empty": dp.Status.DEGENERATE, "parallel": dp.Status.DEGENERATE}[hopeless]
    assert mixed.status.tolist() == [0, want, 0, 0]
    for i in (0, 2, 3):
        assert torch.equal(good.camera.K[i], mixed.camera.K[i])
        assert torch.equal(good.cameras.R[i], mixed.cameras.R[i])
        assert torch.equal(good.cameras.t[i], mixed.cameras.t[i])
        assert torch.equal(good.camera.distortion[i].coefficients, mixed.camera.distortion[i].coefficients)
    with pytest.raises(dp.CalibrationError, match="3 of 4 cameras converged; camera 1: ") as raised:
        dp.calibrate(broken, BOARD)
    assert raised.value.calibration is not None


def test_views_of_different_counts_side_by_side() -> None:
    _, views = simulate(9, cameras=(2,))
    visible = views.visible.clone()
    visible[0, 6:] = False  # padding
    visible[1] &= torch.rand(9, 54) > 0.3
    padded = dp.Views(views.pixels, visible, size=views.size)
    both = dp.calibrate(padded, BOARD)
    alone = dp.calibrate(dp.Views(views.pixels[0, :6], size=views.size), BOARD)
    torch.testing.assert_close(both.camera.K[0], alone.camera.K, rtol=1e-8, atol=0)
    assert both.view_rms[0, 6:].isnan().all()
    assert both.covariance.undetermined_views.tolist() == [[False] * 6 + [True] * 3, [False] * 9]


def test_missing_corners_do_not_matter() -> None:
    truth, views = simulate(10, noise_px=0.1)
    hidden = torch.rand(len(views), 54) < 0.3
    holes = views.hiding(hidden)
    poisoned = dp.Views(torch.where(hidden[..., None], torch.nan, views.pixels), ~hidden, size=views.size)
    first, second = dp.calibrate(holes, BOARD), dp.calibrate(poisoned, BOARD)
    assert torch.equal(first.camera.K, second.camera.K)
    assert (first.camera.K - truth.K[0]).abs().max() < 3
    assert (first.residuals[hidden] == 0).all()
    assert_same_minimum(holes, "brown5")


def test_views_with_fewer_than_four_corners_take_no_part() -> None:
    _, views = simulate(8)
    visible = views.visible.clone()
    visible[2, 3:] = False
    visible[5] = False
    calibration = dp.calibrate(dp.Views(views.pixels, visible, size=views.size), BOARD)
    rest = dp.calibrate(views[[0, 1, 3, 4, 6, 7]], BOARD)
    torch.testing.assert_close(calibration.camera.K, rest.camera.K, rtol=1e-9, atol=0)
    assert "view 3  left out: 3 corners, 4 are needed" in calibration.summary()
    assert not calibration.used[[2, 5]].any()


# --------------------------------------------------------------------------------------------------------- starts


@pytest.mark.slow
def test_refine_from_poor_starts() -> None:
    """1000 cameras, 20 % off in focal length, 5 degrees and 10 % in pose: at least 99 % reach OpenCV's minimum."""
    truth, views = simulate(10, cameras=(1000,), seed=3)
    views = in_float32(views)
    factor = 1 + 0.2 * torch.randn(1000, 2, dtype=D).sign()
    bad_K = truth.K.clone()
    bad_K[..., 0, 0] *= factor[:, None, 0]
    bad_K[..., 1, 1] *= factor[:, None, 0]
    axis = torch.nn.functional.normalize(torch.randn(1000, 10, 3, dtype=D), dim=-1)
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    turn = axis_angle_to_rotation_matrix((np.deg2rad(5) * axis).reshape(-1, 3)).reshape(1000, 10, 3, 3)
    shift = torch.nn.functional.normalize(torch.randn(1000, 10, 3, dtype=D), dim=-1)
    bad_t = truth.t + 0.1 * truth.t.norm(dim=-1, keepdim=True) * shift
    lens = dp.BrownConrady(torch.zeros(1000, 10, 5, dtype=D))
    start = dp.Camera(bad_K, turn @ truth.R, bad_t, lens, size=(640, 480))
    found = dp.refine(views, BOARD, start, throw=False)
    best = torch.tensor([by_opencv_from(truth[i], views.pixels[i]) for i in range(1000)], dtype=D)
    reached = found.rms <= best * (1 + 1e-9)
    assert reached.double().mean() >= 0.99
    assert not found.converged[~reached].any()


def test_refine_starts_from_a_camera_or_from_its_poses() -> None:
    truth, views = simulate(8)
    wanted = dp.calibrate(views, BOARD)
    without = dp.refine(views, BOARD, truth[0].without_pose())
    with_poses = dp.refine(views, BOARD, truth)
    torch.testing.assert_close(without.camera.K, wanted.camera.K, rtol=0, atol=1e-4)
    torch.testing.assert_close(with_poses.camera.K, wanted.camera.K, rtol=0, atol=1e-4)
    assert with_poses.iterations <= wanted.iterations
    kornia = dp.Camera(K, size=(640, 480)).to_kornia()
    batch = dp.Views(views.pixels[None], size=views.size)
    assert dp.refine(batch, BOARD, kornia).camera.distortion is None


def test_strong_lenses_are_started_well() -> None:
    for k1, k2 in ((-0.45, 0.22), (-0.35, 0.1), (0.3, 0.1)):
        lens = dp.BrownConrady(torch.tensor([k1, k2, 0.0, 0.0], dtype=D))
        wide = torch.tensor([[380.0, 0, 310], [0, 380, 250], [0, 0, 1]], dtype=D)
        _, views = simulate(10, lens, intrinsics=wide)
        assert dp.calibrate(views, BOARD, "brown4").rms < 0.3


# --------------------------------------------------------------------------------------------------------- locate


@pytest.mark.parametrize("lens", ["brown5", "fisheye", None])
def test_locate_finds_each_pose(lens: str | None) -> None:
    truth, views = simulate(10, TRUE_LENSES[lens] if lens else None, noise_px=0.1)
    located = dp.locate(views, BOARD, truth[0])
    assert located.rms < 0.145
    assert (located.cameras.center - truth.center).norm(dim=-1).max() < 2
    exact = synthetic.corner_views(truth, BOARD, noise_px=0.0)
    torch.testing.assert_close(dp.locate(exact, BOARD, truth[0]).cameras.t, truth.t, rtol=0, atol=1e-6)
    assert located.covariance.shared.abs().max() == 0
    spread = located.covariance.view(0).diagonal()[-6:].sqrt()
    assert (spread > 0).all()
    assert (spread[3:] < 1).all()


def test_locate_is_solvepnp() -> None:
    truth, views = simulate(6)
    located = dp.locate(views, BOARD, truth[0])
    found_K, dist, rvecs, tvecs = truth.to_opencv()
    for i in range(6):
        corners = views.pixels[i].numpy()
        rvec, tvec = cv2.solvePnPRefineLM(
            BOARD.points.numpy(), corners, found_K[i], dist[i], rvecs[i].reshape(3, 1), tvecs[i].reshape(3, 1),
            (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-15),
        )  # fmt: skip
        np.testing.assert_allclose(located.cameras.t[i].numpy(), tvec.ravel(), atol=1e-5)
        np.testing.assert_allclose(located.cameras.R[i].numpy(), cv2.Rodrigues(rvec)[0], atol=1e-7)


def test_locate_keeps_the_better_of_two_poses() -> None:
    # From afar and nearly face on, a plane tilted one way looks almost like the plane tilted the other way.
    far = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=D)
    angle = torch.tensor([0.25, -0.25, 0.2, 0.15], dtype=D)
    R = dp.rotation_from_euler(angle, angle.roll(1), 0 * angle)
    truth = dp.Camera(far, size=(640, 480)).at(R, torch.tensor([-100.0, -60, 2500], dtype=D))
    views = synthetic.corner_views(truth, BOARD, noise_px=0.02)
    located = dp.locate(views, BOARD, truth[0])
    cosine = ((located.cameras.R * truth.R).sum(dim=(-2, -1)) - 1) / 2
    assert (cosine.clamp(-1, 1).arccos().rad2deg() < 2).all()


def test_locate_many_cameras_and_few_corners() -> None:
    truth, views = simulate(5, cameras=(2,), noise_px=0.05)
    visible = torch.zeros_like(views.visible)
    visible[..., [0, 8, 45, 53]] = True
    visible[1, 4] = False
    few = dp.Views(views.pixels, visible, size=views.size)
    located = dp.locate(few, BOARD, truth[:, 0].without_pose())
    assert located.cameras.batch_shape == (2, 5)
    seen = visible.any(-1)
    assert ((located.cameras.center - truth.center).norm(dim=-1)[seen] < 3).all()


# --------------------------------------------------------------------------------------------------------- options


def test_fixed_and_tied_parameters() -> None:
    _, views = simulate(10)
    held = dp.calibrate(views, BOARD, fixed=("principal_point", "k3", "p1"))
    assert held.camera.K[:2, 2].tolist() == [319.5, 239.5]
    assert held.camera.distortion.coefficients[[2, 4]].tolist() == [0, 0]
    assert held.covariance.deviations["c_x"] == 0
    tied = dp.calibrate(views, BOARD, tied_focal=True)
    assert tied.camera.K[0, 0] == pytest.approx(float(tied.camera.K[1, 1]), rel=1e-12)
    assert tied.covariance.deviations["f_x"] == pytest.approx(float(tied.covariance.deviations["f_y"]), rel=1e-9)
    # OpenCV with the same restriction.
    points = [BOARD.points.numpy().astype(np.float32)] * 10
    corners = [p.numpy().astype(np.float32) for p in views.pixels]
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_USE_INTRINSIC_GUESS
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-16)
    _, cv_K, *_ = cv2.calibrateCamera(
        points, corners, (640, 480), np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), np.zeros(5),
        flags=flags, criteria=stop,
    )  # fmt: skip
    np.testing.assert_allclose(dp.calibrate(in_float32(views), BOARD, tied_focal=True).camera.K, cv_K, atol=1e-4)
    start = dp.Camera(torch.tensor([[600.0, 0, 320], [0, 300, 240], [0, 0, 1]], dtype=D), size=(640, 480))
    ratio = dp.refine(views, BOARD, start, tied_focal=True, throw=False).camera.K
    assert ratio[0, 0] / ratio[1, 1] == pytest.approx(2.0, rel=1e-12)


def test_what_is_held_or_known_is_no_guess() -> None:
    _, views = simulate(10)
    held = dp.calibrate(views, BOARD, fixed=("k1", "k2"), throw=False).camera.distortion.coefficients
    assert held[:2].tolist() == [0, 0]
    for model in ("brown5", "brown8"):
        bare, explicit = (
            dp.calibrate(views, BOARD, model, priors=priors, throw=False).camera
            for priors in ({"distortion": 1e-2, "c_x": 0.5}, {"distortion": (0.0, 1e-2), "c_x": (319.5, 0.5)})
        )
        assert torch.equal(bare.K, explicit.K)


def test_priors_pull() -> None:
    _, views = simulate(6)
    free = dp.calibrate(views, BOARD)
    stiff = dp.calibrate(views, BOARD, priors={"principal_point": (torch.tensor([300.0, 200.0]), 1e-6), "k3": 1e-9})
    assert (stiff.camera.K[:2, 2] - torch.tensor([300.0, 200.0])).abs().max() < 1e-3
    assert stiff.camera.distortion.coefficients[4].abs() < 1e-9
    weak = dp.calibrate(views, BOARD, priors={"focal": (500.0, 1e6), "distortion": 1e6})
    torch.testing.assert_close(weak.camera.K, free.camera.K, rtol=0, atol=1e-3)
    # A prior counts as a measurement: with much of it, its deviation is what is left.
    known = dp.calibrate(views, BOARD, priors={"f_x": (533.0, 1e-3)}, weights=torch.tensor(25.0, dtype=D))
    assert known.covariance.deviations["f_x"] == pytest.approx(1e-3, rel=0.02)


def test_weights_say_what_counts() -> None:
    _, views = simulate(10)
    half = torch.ones(54, dtype=D)
    half[::2] = 0
    weighted = dp.calibrate(views, BOARD, weights=half)
    hidden = dp.calibrate(views.hiding(half == 0), BOARD)
    torch.testing.assert_close(weighted.camera.K, hidden.camera.K, rtol=1e-7, atol=0)
    scaled = dp.calibrate(views, BOARD, weights=torch.tensor(7.0, dtype=D))
    torch.testing.assert_close(scaled.camera.K, dp.calibrate(views, BOARD).camera.K, rtol=1e-7, atol=0)


def with_outliers(views: dp.Views, part: float = 0.05) -> tuple[dp.Views, torch.Tensor]:
    wrong = torch.rand(views.visible.shape) < part
    jump = 5 + 30 * torch.rand(*views.visible.shape, 1, dtype=D)
    direction = torch.nn.functional.normalize(torch.randn_like(views.pixels), dim=-1)
    pixels = torch.where(wrong.unsqueeze(-1), views.pixels + jump * direction, views.pixels)
    return dp.Views(pixels, names=views.names, size=views.size), wrong


@pytest.mark.parametrize("loss", [dp.Huber(0.3), dp.SoftL1(0.3), dp.Cauchy(0.3)])
def test_robust_losses_bear_outliers(loss: dp.Loss) -> None:
    truth, views = simulate(13, noise_px=0.1)
    dirty, _ = with_outliers(views)
    plain, robust = dp.calibrate(dirty, BOARD, throw=False), dp.calibrate(dirty, BOARD, loss=loss)
    off, better = ((c.camera.K - truth.K[0]).abs().max() for c in (plain, robust))
    assert better < off / 3
    assert better < 3


def test_outliers_are_rejected_and_named() -> None:
    _, views = simulate(13, noise_px=0.1)
    dirty, wrong = with_outliers(views)
    clean = dp.calibrate(views.hiding(wrong), BOARD)
    found = dp.calibrate(dirty, BOARD, reject_outliers=True)
    assert (found.rejected >= wrong).all()
    assert int((found.rejected & ~wrong).sum()) <= 2
    assert (found.camera.K - clean.camera.K).abs().max() < 0.5
    view, corner = (int(i) for i in wrong.nonzero()[0])
    line = next(line for line in found.summary().splitlines() if views.names[view] + " " in line)
    assert "without corners" in line
    assert str(corner) in line
    batch = dp.Views(torch.stack([dirty.pixels, views.pixels]), size=views.size)
    both = dp.calibrate(batch, BOARD, reject_outliers=True)
    assert torch.equal(both.rejected[0], found.rejected)
    assert int(both.rejected[1].sum()) <= 1


def test_objective_on_the_board() -> None:
    for side in ("left", "right"):
        views = dp.example_views(side)
        image, plane = (dp.calibrate(views, BOARD, objective=o) for o in ("image", "plane"))

        def on_board(calibration: dp.Calibration, views: dp.Views = views) -> float:
            points, valid = dp.back_project(views.pixels.to(D), calibration.cameras, dp.Plane.z(0.0))
            assert valid.all()
            return float((points - BOARD.points).square().sum(-1).mean().sqrt())

        assert on_board(plane) < on_board(image)
        assert plane.rms > image.rms
        assert plane.objective == "plane"
        assert (plane.camera.K - image.camera.K).abs().max() < 5


def test_outliers_by_their_own_weight_and_rounding_is_none() -> None:
    truth, _ = simulate(10)
    exact, _ = truth.project(BOARD.points)
    assert not dp.calibrate(dp.Views(exact, size=(640, 480)), BOARD, reject_outliers=True).rejected.any()
    sigma = torch.where(torch.rand(10, 54, dtype=D) < 0.3, 2.0, 0.1)
    noisy = dp.Views(exact + sigma.unsqueeze(-1) * torch.randn_like(exact), size=(640, 480))
    found = dp.calibrate(noisy, BOARD, weights=sigma**-2, reject_outliers=True)
    assert int(found.rejected.sum()) <= 2


def test_corners_of_no_weight_take_no_part() -> None:
    _, views = simulate(10)
    weights = torch.ones(10, 54, dtype=D)
    weights[:, ::2] = 0
    weights[4] = 0
    weighted, hidden = dp.calibrate(views, BOARD, weights=weights), dp.calibrate(views.hiding(weights == 0), BOARD)
    torch.testing.assert_close(weighted.rms, hidden.rms)
    torch.testing.assert_close(weighted.pixel_sigma, hidden.pixel_sigma)
    poisoned = weights.clone()
    poisoned[:, 7] = torch.nan
    seventh = views.hiding(torch.arange(54) == 7)
    torch.testing.assert_close(
        dp.calibrate(seventh, BOARD, weights=poisoned).camera.K, dp.calibrate(seventh, BOARD, weights=weights).camera.K
    )


def test_calibrations_go_to_other_processes() -> None:
    import pickle

    found = dp.calibrate(dp.example_views("left"), BOARD)
    again = pickle.loads(pickle.dumps(found))  # noqa: S301
    assert torch.equal(again.covariance.view(3), found.covariance.view(3))


def test_progress_is_told() -> None:
    told: list[tuple[int, int]] = []
    dp.calibrate(dp.example_views("left"), BOARD, progress=lambda done, total: told.append((done, total)))
    assert told[0][0] == 1
    assert told[-1] == (300, 300)


def test_says_when_it_was_stopped_early() -> None:
    with pytest.raises(dp.CalibrationError, match="still falling .* raise max_iterations"):
        dp.calibrate(dp.example_views("left"), BOARD, max_iterations=1)
    early = dp.calibrate(dp.example_views("left"), BOARD, max_iterations=1, throw=False)
    assert early.status == dp.Status.MAX_ITERATIONS
    assert not early.converged


def test_one_tilted_view_with_a_fixed_principal_point() -> None:
    centred = torch.tensor([[533.0, 0, 319.5], [0, 534, 239.5], [0, 0, 1]], dtype=D)
    _, views = simulate(1, None, noise_px=0.05, intrinsics=centred, seed=4)
    calibration = dp.calibrate(views, BOARD, "none", fixed=("principal_point",))
    deviation = calibration.covariance.deviations["f_x"]
    assert abs(calibration.camera.K[0, 0] - 533) < 4 * deviation
    assert deviation < 10


@pytest.mark.parametrize("side", ["left", "right"])
def test_deviations_are_opencvs(side: str) -> None:
    views = in_float32(dp.example_views(side))
    corners = [pixels.numpy().astype(np.float32) for pixels in views.pixels]
    points = [BOARD.points.numpy().astype(np.float32)] * len(views)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-16)
    found = cv2.calibrateCameraExtended(points, corners, views.size, None, None, criteria=stop)
    calibration = dp.calibrate(views, BOARD)
    # OpenCV takes the corners' errors for independent.
    independent = calibration.covariance.dispersion.sqrt()
    assert independent > 2
    spread = torch.stack(list(calibration.covariance.deviations.values())) / independent
    np.testing.assert_allclose(spread.numpy(), found[5].ravel()[:9], rtol=1e-4)
    # Of the poses the translations are comparable: OpenCV differentiates by the rotation vector.
    translations = torch.stack([calibration.covariance.view(i).diagonal()[-3:].sqrt() for i in range(len(views))])
    ratio = (translations / independent).numpy() / found[6].reshape(-1, 6)[:, 3:]
    # It takes the noise for the same in all views: of one view the corners clearly scatter more.
    noisy = (ratio > 1 + 1e-4).any(-1)
    assert noisy.tolist() == [side == "left" and view == 7 for view in range(len(views))]
    assert ratio[noisy].max(initial=1.0) < 1.03
    np.testing.assert_allclose(ratio[~noisy], 1.0, rtol=1e-4)


def test_the_full_covariance_is_the_dense_inverse() -> None:
    _, views = simulate(
        5, seed=1
    )  # seed 0 also has a variance of focal lengths, by chance: test_own_intrinsics.py tests that
    found = dp.calibrate(views, BOARD, "brown4", fixed=("p1",), tied_focal=True)
    full = found.covariance.full()
    assert full.shape == (8 + 30, 8 + 30)
    torch.testing.assert_close(full, full.mT, rtol=1e-9, atol=1e-16)
    scale = full.diagonal().clamp(min=1e-30).rsqrt()
    assert torch.linalg.eigvalsh(full * scale * scale[:, None])[0] > -1e-9
    from diffproj.calibration.problem.reprojection import Reprojection

    coefficients = found.camera.distortion.coefficients
    K = found.camera.K
    shared = torch.cat([K.diagonal()[:2], K[:2, 2], coefficients])[None]
    panel = Reprojection(BOARD.points, views.pixels[None], views.visible[None], "brown4").linearise(
        shared, (found.cameras.R[None], found.cameras.t[None])
    )[0]
    J = torch.zeros(5, 2, 54, 8 + 30, dtype=D)
    for v in range(5):
        J[v, ..., :8] = panel[v, :8].permute(1, 2, 0)
        J[v, ..., 8 + 6 * v : 14 + 6 * v] = panel[v, 8:14].permute(1, 2, 0)
    free = torch.eye(38, dtype=D)[:, [0, 2, 3, 4, 5, 7, *range(8, 38)]]
    free[1, 0] = K[1, 1] / K[0, 0]
    J = J.reshape(-1, 38) @ free
    sigma2 = found.residuals.square().sum() / (J.shape[0] - J.shape[1])
    want = free @ torch.linalg.inv(J.mT @ J) @ free.mT * sigma2 * found.covariance.dispersion
    torch.testing.assert_close(full, want, rtol=1e-4, atol=1e-9 * float(want.abs().amax()))
    joint = found.covariance.view(3)
    index = [*range(8), *range(8 + 18, 8 + 24)]
    torch.testing.assert_close(joint, want[index][:, index], rtol=1e-4, atol=1e-9 * float(want.abs().amax()))
    assert float(found.pixel_sigma) == pytest.approx(float(sigma2) ** 0.5, rel=1e-9)


# --------------------------------------------------------------------------------------------------------- the bow


def bowed_views(views: int, bow: tuple[float, float], seed: int = 0, cameras: Sequence[int] = ()) -> dp.Views:
    truth, _ = simulate(views, seed=seed, cameras=cameras)
    shape = torch.linspace(-1, 1, 9, dtype=D), torch.linspace(-1, 1, 6, dtype=D)
    eta, xi = torch.meshgrid(shape[1], shape[0], indexing="ij")
    z = bow[0] * (1 - xi.square()) + bow[1] * (1 - eta.square())
    points = BOARD.points + torch.nn.functional.pad(z.reshape(-1, 1), (2, 0))
    pixels, valid = truth.project(points)
    assert valid.all()
    generator = torch.Generator().manual_seed(seed)
    return dp.Views(pixels + 0.2 * torch.randn(pixels.shape, generator=generator, dtype=D), size=(640, 480))


@pytest.mark.parametrize("count", [13, 100, 300])
def test_a_bowed_board(count: int) -> None:
    views = bowed_views(count, (0.5, 0.0))
    flat, bowed = dp.calibrate(views, BOARD), dp.calibrate(views, BOARD, shape="bow")
    deviations = bowed.covariance.deviations
    assert abs(bowed.bow[0] - 0.5) < 4 * deviations["bow_x"]
    assert abs(bowed.bow[1]) < 4 * deviations["bow_y"]
    assert abs(bowed.camera.K[0, 0] - 533) < 4 * deviations["f_x"]
    assert abs(bowed.camera.K[1, 1] - 534) < 4 * deviations["f_y"]
    assert "bow along x, y" in bowed.summary()
    assert bowed.rms < flat.rms
    if count > 13:
        assert abs(flat.camera.K[0, 0] - 533) > 6 * flat.covariance.deviations["f_x"]


def test_bow_is_unbiased_and_its_deviation_is_true() -> None:
    """200 simulations at once: standardised errors have mean 0 and deviation 1, to four deviations of either."""
    views = bowed_views(13, (0.5, -0.2), cameras=(200,), seed=2)
    found = dp.calibrate(views, BOARD, shape="bow")
    deviations = found.covariance.deviations
    truths = {"bow_x": (found.bow[:, 0], 0.5), "bow_y": (found.bow[:, 1], -0.2)}
    truths |= {"f_x": (found.camera.K[:, 0, 0], 533.0), "f_y": (found.camera.K[:, 1, 1], 534.0)}
    for name, (value, truth) in truths.items():
        standard = (value - truth) / deviations[name]
        assert abs(standard.mean()) < 4 / 200**0.5
        assert abs(standard.std() - 1) < 4 / 400**0.5


def test_bundled_boards_are_bowed() -> None:
    for side in ("left", "right"):
        flat, bowed = (dp.calibrate(dp.example_views(side), BOARD, shape=shape) for shape in ("flat", "bow"))
        assert 0.03 < 1 - bowed.rms / flat.rms < 0.1  # measured: .065 and .081
        assert bowed.bow[1].item() == pytest.approx(-0.17, abs=0.03)


# ------------------------------------------------------------------------------------------------------ what is named


def test_summary_says_what_was_found() -> None:
    text = dp.calibrate(dp.example_views("left"), BOARD).summary()
    for part in ("focal lengths", "±", "k3", "left05.jpg", "702 corners", "converged"):
        assert part in text
    assert "k1" not in dp.calibrate(dp.example_views("left"), BOARD, "none").summary()
    _, views = simulate(6, cameras=(2,))
    with pytest.raises(ValueError, match=r"summary: want one camera, got batch shape \(2,\); index it"):
        dp.calibrate(views, BOARD).summary()


def parallel_views(tilt: float) -> dp.Views:
    angle = torch.tensor(tilt, dtype=D)
    R = dp.rotation_from_euler(angle, 0 * angle, 0 * angle)
    camera = dp.Camera(K, size=(640, 480)).at(
        R, torch.tensor([[-100.0, -60, 500], [-80, -50, 600], [-90, -70, 450]], dtype=D)
    )
    return synthetic.corner_views(camera, BOARD)


def mirrored(views: dp.Views) -> dp.Views:
    return dp.Views(views.pixels.unflatten(-2, (6, 9)).flip(-2).flatten(-3, -2), names=views.names, size=views.size)


def one_mirrored(views: dp.Views) -> dp.Views:
    pixels = views.pixels.clone()
    pixels[2] = mirrored(views).pixels[2]
    return dp.Views(pixels, names=views.names, size=views.size)


def swapped(views: dp.Views) -> dp.Views:
    """As if the board had 6 columns and 9 rows."""
    return dp.Views(views.pixels.unflatten(-2, (6, 9)).transpose(-3, -2).flatten(-3, -2), size=views.size)


@pytest.mark.parametrize(
    ("views", "options", "message"),
    [
        (lambda v: parallel_views(0.0)[0], {}, "do not determine .*: the only view is seen face on"),
        (
            lambda v: parallel_views(0.5)[0],
            {"distortion": "none"},
            "do not determine .*: one view is not enough.*or fix the principal point",
        ),
        (lambda v: parallel_views(0.0), {}, "do not determine .*f_x.*: all views are parallel; add photographs"),
        (lambda v: parallel_views(0.5), {"distortion": "none"}, "do not determine .*: all views are parallel"),
        (mirrored, {}, "show the board mirrored: number the corners of each row from the other end"),
        (one_mirrored, {}, "left03.jpg shows the board mirrored"),
        pytest.param(swapped, {}, "do not match the board: are its columns and rows right", marks=pytest.mark.slow),
        (lambda v: v.hiding(torch.arange(54) >= 3), {}, "no view shows at least 4 corners"),
        (lambda v: v.hiding(torch.arange(54) >= 9), {}, "calibrate: "),
        (lambda v: dp.Views(torch.full((3, 54, 2), 100.0), size=(640, 480)), {}, "calibrate: "),
    ],
    ids=[
        "face on",
        "one",
        "parallel",
        "tilted alike",
        "mirrored",
        "one mirrored",
        "swapped",
        "few",
        "a line",
        "a spot",
    ],
)
def test_what_the_views_do_not_say_is_named(views: object, options: dict, message: str) -> None:
    given = views(dp.example_views("left"))  # type: ignore[operator]
    with pytest.raises(dp.CalibrationError, match=message) as raised:
        dp.calibrate(given, BOARD, **options)
    found = raised.value.calibration
    assert found is not None
    assert found.status == dp.Status.DEGENERATE or found.status == dp.Status.DIVERGED
    assert found.camera.K.isfinite().all()
    assert isinstance(found.summary(), str)


def test_mirrored_views_of_any_target() -> None:
    target = type("Target", (), {"points": BOARD.points})()
    views = one_mirrored(dp.example_views("left"))
    with pytest.raises(dp.CalibrationError, match="left03.jpg shows the board mirrored"):
        dp.calibrate(views, target)
    assert dp.calibrate(dp.example_views("left"), target).converged


def test_locate_names_what_does_not_fit() -> None:
    camera = dp.calibrate(dp.example_views("left"), BOARD).camera
    with pytest.raises(dp.CalibrationError, match="locate: left03.jpg shows the board mirrored"):
        dp.locate(one_mirrored(dp.example_views("left")), BOARD, camera)
    line = dp.example_views("left").hiding(torch.arange(54) >= 9)
    with pytest.raises(dp.CalibrationError, match="do not determine a pose"):
        dp.locate(line, BOARD, camera)


@pytest.mark.plain
def test_bad_input_is_refused_by_name() -> None:
    truth, views = simulate(5)
    board = BOARD

    def target(points: torch.Tensor) -> object:
        return type("Target", (), {"points": points})()

    same = board.points.clone()
    same[7] = same[3]
    line = board.points * torch.tensor([1.0, 0, 0], dtype=D) + torch.arange(54, dtype=D)[:, None] * torch.tensor(
        [1.0, 0, 0]
    )
    other = type(
        "Other",
        (),
        {
            "unproject": None,
            "project_direction": None,
            "dtype": D,
            "device": torch.device("cpu"),
            "batch_shape": torch.Size(()),
        },
    )
    tilted = dp.BrownConrady(torch.tensor([0.0] * 12 + [0.02, 0.03], dtype=D))
    turned = dp.Camera(truth.K[0][[1, 0, 2]], distortion=tilted)
    batch = dp.Views(views.pixels[None], size=views.size)
    cases = [
        (TypeError, "views: want dp.Views, got Tensor", lambda: dp.calibrate(views.pixels, board)),
        (ValueError, "distortion: want one of none, .* got 'brown'", lambda: dp.calibrate(views, board, "brown")),
        (ValueError, "views: want 40 corners .* got 54", lambda: dp.calibrate(views, dp.Chessboard(8, 5))),
        (ValueError, "views: want at least one, got none", lambda: dp.locate(views[[]], board, truth[0])),
        (ValueError, "views: want the photographs' size", lambda: dp.calibrate(dp.Views(views.pixels), board)),
        (
            ValueError,
            "target: want finite points, got ",
            lambda: dp.calibrate(views, target(board.points + torch.nan)),
        ),
        (ValueError, "all distinct, got 54 with 3 and 7 alike", lambda: dp.calibrate(views, target(same))),
        (ValueError, "do not lie on one line", lambda: dp.calibrate(views, target(line))),
        (
            ValueError,
            "weights: want a shape that broadcasts to",
            lambda: dp.calibrate(views, board, weights=torch.ones(53)),
        ),
        (
            ValueError,
            "weights: want finite numbers of at least 0",
            lambda: dp.calibrate(views, board, weights=-torch.ones(54)),
        ),
        (ValueError, "objective: want one of 'image', 'plane'", lambda: dp.calibrate(views, board, objective="both")),
        (
            ValueError,
            "shape: want 'flat' with objective='plane', got 'bow'",
            lambda: dp.calibrate(views, board, shape="bow", objective="plane"),
        ),
        (
            TypeError,
            r"fixed: want several names, as in fixed=\('k3',\)",
            lambda: dp.calibrate(views, board, fixed="k3"),
        ),
        (ValueError, "fixed: want names from focal, .* got 'k4'", lambda: dp.calibrate(views, board, fixed=("k4",))),
        (
            ValueError,
            "fixed: want both focal lengths or none",
            lambda: dp.refine(views, board, truth[0], fixed=("f_x",), tied_focal=True),
        ),
        (TypeError, "priors: want a mapping", lambda: dp.calibrate(views, board, priors=[1])),
        (
            ValueError,
            "priors: want a positive standard deviation",
            lambda: dp.calibrate(views, board, priors={"k3": 0.0}),
        ),
        (ValueError, "priors: want a deviation or", lambda: dp.calibrate(views, board, priors={"k3": (1, 2, 3)})),
        (
            ValueError,
            "priors: want 'focal' to broadcast to",
            lambda: dp.calibrate(views, board, priors={"focal": torch.ones(3)}),
        ),
        (ValueError, "fixed: want what is known beforehand", lambda: dp.calibrate(views, board, fixed=("focal",))),
        (
            ValueError,
            "priors: want .* a finite mean for 'focal'",
            lambda: dp.calibrate(views, board, priors={"focal": 5.0}),
        ),
        (ValueError, "reject_outliers: want True or a number", lambda: dp.calibrate(views, board, reject_outliers=-1)),
        (TypeError, "target: want dp.Chessboard, dp.Landmarks or anything", lambda: dp.calibrate(views, board.points)),
        (TypeError, "loss: want one such as", lambda: dp.locate(views, board, truth[0], loss="huber")),
        (TypeError, "loss: want one such as", lambda: dp.calibrate(views, board, loss="huber")),
        (ValueError, "camera: want a batch shape that broadcasts", lambda: dp.locate(views, board, truth)),
        (ValueError, "camera: want a batch shape that broadcasts", lambda: dp.refine(views, board, truth[:3])),
        (ValueError, "K: want an image that is not turned against", lambda: dp.refine(views, board, turned)),
        (TypeError, "camera: want a pinhole", lambda: dp.refine(views, board, dp.Camera(K, distortion=other()))),
        (TypeError, "camera: want a pinhole", lambda: dp.locate(views, board, dp.Camera(K, distortion=other()))),
        (
            ValueError,
            r"camera: want the size of the photographs, \(640, 480\)",
            lambda: dp.locate(views, board, dp.Camera(K, size=(320, 240))),
        ),
        (TypeError, "camera: want dp.Camera", lambda: dp.refine(batch, board, "camera")),
        (TypeError, r"refine: want \(views, target, camera\) in this order", lambda: dp.refine(truth[0], views, board)),
        (TypeError, r"locate: want \(views, target, camera\) in this order", lambda: dp.locate(truth[0], views, board)),
        (
            TypeError,
            "calibrate: want options of weights, .*, got 'wieghts'",
            lambda: dp.calibrate(views, board, wieghts=1),
        ),
        (TypeError, "locate: want options of .*, got 'shape'", lambda: dp.locate(views, board, truth[0], shape="bow")),
    ]
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()


def test_scales_of_weights_and_losses() -> None:
    """Weights are relative; a loss whose scale is no residual's is refused for what it is."""
    views, board = dp.example_views("left")[:6], dp.Chessboard()
    want = dp.calibrate(views, board, "brown4")
    for weight in (1e-25, 1e-12, 1e25):
        found = dp.calibrate(views, board, "brown4", weights=torch.tensor(weight, dtype=torch.float64))
        torch.testing.assert_close(found.camera.K, want.camera.K, rtol=1e-8, atol=0)
        deviation = found.covariance.deviations["f_x"]
        torch.testing.assert_close(deviation, want.covariance.deviations["f_x"], rtol=1e-6, atol=0)
    with pytest.raises(ValueError, match="weights: want 0 or numbers from 1e-100 to 1e"):
        dp.calibrate(views, board, "brown4", weights=torch.tensor(1e-300, dtype=torch.float64))
    with pytest.raises(dp.CalibrationError, match="scale of the loss is so far below the residuals"):
        dp.calibrate(views, board, "none", loss=dp.Huber(1e-25))
    for scale in (1e-200, 1e200, 0.0, float("nan")):
        with pytest.raises(ValueError, match="scale: want a positive number in the residual's unit"):
            dp.Huber(scale)


def test_priors_keep_all_their_digits() -> None:
    views, board = dp.example_views("left")[:4], dp.Chessboard()
    found = dp.calibrate(views, board, "none", priors={"f_x": (533.1, 1e-7)})
    assert abs(float(found.camera.K[0, 0]) - 533.1) < 1e-9
