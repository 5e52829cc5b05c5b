"""A camera from a file, with nothing known but itself: photographs of another are told, and its own are not accused."""

import warnings

import pytest
import torch

import diffproj as dp

D = torch.float64
BOARD = dp.Chessboard()
LEFT, RIGHT = dp.example_views("left"), dp.example_views("right")
SIZE = LEFT.size
TOLD = "what other intrinsics would leave"


@pytest.fixture(scope="module")
def camera() -> dp.Camera:
    return dp.calibrate(LEFT, BOARD).camera


def located(views: dp.Views, target: object, camera: dp.Camera, **options: object) -> dp.Calibration:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.CameraMismatchWarning)
        return dp.locate(views, target, camera, **options)  # type: ignore[arg-type]


def of_resolution(camera: dp.Camera, times: float) -> dp.Camera:
    """With a K of photographs that many times as large, which nobody told."""
    scaled = camera.K * torch.tensor([[times], [times], [1.0]], dtype=D)
    return dp.Camera(scaled, distortion=camera.distortion, size=SIZE)


def undistorted(views: dp.Views, camera: dp.Camera) -> dp.Views:
    directions, _ = camera.directions(views.pixels)
    seen = directions @ camera.K.mT
    return dp.Views(seen[..., :2] / seen[..., 2:], size=SIZE)


@pytest.mark.parametrize("which", [slice(0, 13), slice(3, 4), slice(8, 10)])
def test_a_wrong_camera_is_told(camera: dp.Camera, which: slice) -> None:
    wrong = {
        "twice": (LEFT, of_resolution(camera, 2.0)),
        "without its lens": (LEFT, dp.Camera(camera.K, size=SIZE)),
        "lens on undistorted photographs": (undistorted(LEFT, camera), camera),
    }
    for views, given in wrong.values():
        found = located(views[which], BOARD, given)
        assert found.mismatch.doubtful.all()
        assert TOLD in found.doubts
        assert "pixels of photographs of this size" in found.verdict
        assert TOLD in found.message


def test_where_no_pose_fits_the_camera_is_asked_about(camera: dp.Camera) -> None:
    with pytest.raises(dp.CalibrationError, match="do not match the board: .*is the camera that of these photographs"):
        dp.locate(LEFT, BOARD, of_resolution(camera, 0.5))


def test_the_other_camera_of_a_pair_by_all_views_together(camera: dp.Camera) -> None:
    with pytest.warns(dp.CameraMismatchWarning, match=TOLD):
        found = dp.locate(RIGHT, BOARD, camera)
    assert found.mismatch.doubtful.all()
    assert (found.mismatch.scale > 2).all()
    with pytest.warns(dp.CameraMismatchWarning, match=rf"measure: the residuals of {RIGHT.names[0]} .*{TOLD}"):
        measured = dp.measure(RIGHT.pixels[0, [0, 53]], found, dp.Plane.z(0.0), view=0, pixel_sigma="detector")
    assert TOLD in measured.doubts


@pytest.mark.parametrize("views", [LEFT, RIGHT], ids=["left", "right"])
@pytest.mark.parametrize("lens", ["brown4", "fisheye"])
def test_its_own_photographs_are_not_accused(views: dp.Views, lens: str) -> None:
    for count in (4, 8):
        camera = dp.calibrate(views[:count], BOARD, lens).camera
        with warnings.catch_warnings():
            warnings.simplefilter("error", dp.CameraMismatchWarning)
            assert not dp.locate(views[count:], BOARD, camera).mismatch.doubtful.any()
            for view in range(count, 13):
                assert not dp.locate(views[view : view + 1], BOARD, camera).mismatch.doubtful.any()


def test_error_bars_hold_the_wrong_camera(camera: dp.Camera) -> None:
    """Corners put back with a K of twice the resolution: 41 % of the coordinates were beyond three deviations."""
    found = located(LEFT, BOARD, of_resolution(camera, 2.0))
    beyond, before = [], []
    for view in range(13):
        with pytest.warns(dp.CameraMismatchWarning):
            measured = dp.measure(LEFT.pixels[view], found, dp.Plane.z(0.0), view=view, pixel_sigma=0.1)
        error = ((measured.points - BOARD.points)[:, :2].abs() / measured.deviations[:, :2]).flatten()
        beyond.append(error > 3)
        before.append(error * found.mismatch.scale[view] > 3)
    assert torch.cat(beyond).double().mean() < 0.04
    assert torch.cat(before).double().mean() > 0.2


DRONE = dp.Camera.looking_at(
    torch.tensor([0.0, -50, 60], dtype=D), torch.zeros(3, dtype=D), fov_deg=70.0, size=(1600, 1200)
)


def landmarks(count: int, flat: bool, trials: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(count + flat)
    points = torch.rand(count, 3, generator=generator, dtype=D) * torch.tensor([80.0, 60, 12 * (not flat)], dtype=D)
    points = points - torch.tensor([40.0, 30, 0], dtype=D)
    exact, _ = DRONE.project(points)
    return points, exact + 0.8 * torch.randn(trials, 1, *exact.shape, generator=generator, dtype=D)


@pytest.mark.parametrize("flat", [False, True])
def test_landmarks_tell_a_preview_from_the_photograph(flat: bool) -> None:
    points, seen = landmarks(12, flat, 20)
    views = dp.Views(seen / 2, size=DRONE.size)
    found = located(views, dp.Landmarks(points), DRONE, throw=False)
    assert found.mismatch.doubtful[found.converged].all()
    assert found.converged.any()
    assert not located(dp.Views(seen, size=DRONE.size), dp.Landmarks(points), DRONE).mismatch.doubtful.any()


@pytest.mark.slow
@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("count", [6, 12])
def test_noise_is_no_other_camera(flat: bool, count: int) -> None:
    points, seen = landmarks(count, flat, 150)
    views, target = dp.Views(seen, size=DRONE.size), dp.Landmarks(points)
    assert int(located(views, target, DRONE).mismatch.doubtful.sum()) <= 1
    assert int(located(views, target, DRONE, pixel_sigma=0.8).mismatch.doubtful.sum()) <= 1


def test_it_is_saved_and_weights_and_empty_views_are_known(camera: dp.Camera) -> None:
    wrong = of_resolution(camera, 2.0)
    found = located(LEFT[:4], BOARD, wrong)
    again = dp.Calibration.from_fields(found.to_fields(), found.camera)
    assert torch.equal(again.mismatch.doubtful, found.mismatch.doubtful)
    assert again.doubts == found.doubts
    seen = torch.ones(4, 54, dtype=torch.bool)
    seen[2] = False
    some = located(dp.Views(LEFT.pixels[:4], seen, size=SIZE), BOARD, wrong)
    assert some.mismatch.doubtful.tolist() == [True, True, False, True]
    weighted = located(LEFT[:4], BOARD, wrong, weights=torch.full((4, 54), 7.0, dtype=D))
    torch.testing.assert_close(weighted.mismatch.ratio, found.mismatch.ratio, rtol=1e-4, atol=0)


def test_exchanged_landmarks_are_named_and_found() -> None:
    """Two of twelve in space: no pose had all of them before the camera, which was put down to corners not finite."""
    points, seen = landmarks(12, False, 1)
    points[[2, 5]] = points[[5, 2]]
    views, target = dp.Views(seen[0], size=DRONE.size), dp.Landmarks(points)
    with pytest.raises(dp.CalibrationError, match="do not match the landmarks: .* in the same order"):
        dp.locate(views, target, DRONE)
    found = located(views, target, DRONE, pixel_sigma=0.8, reject_outliers=True)
    assert (~found.used[0]).nonzero().flatten().tolist() == [2, 5]
    torch.testing.assert_close(found.cameras[0].center, DRONE.center, atol=0.5, rtol=0)
