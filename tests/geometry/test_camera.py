"""`Camera`: conventions by hand, OpenCV and Kornia as oracles, what is invalid, and what is refused."""

import copy

import cv2
import kornia
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import diffproj as dp

D = torch.float64


def draw_cameras(seed: int, count: int, lens: bool = False) -> dp.Camera:
    """Random cameras that look at the world's origin from 300 to 1500 units."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float = -1.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, dtype=D, generator=generator)

    K = torch.eye(3, dtype=D).repeat(count, 1, 1)
    K[:, 0, 0], K[:, 1, 1] = uniform(2, count, low=300, high=2000)
    K[:, :2, 2] = uniform(count, 2, low=100, high=900)
    R = dp.rotation_from_euler(*(uniform(3, count) * torch.pi))
    t = torch.cat([uniform(count, 2) * 100, uniform(count, 1, low=300, high=1500)], dim=-1)
    scale = torch.tensor([0.3, 0.1, 0.002, 0.002, 0.05], dtype=D)
    distortion = dp.BrownConrady(uniform(count, 5) * scale) if lens else None
    return dp.Camera(K, R, t, distortion, (1000, 1000))


# ------------------------------------------------------------------------------------------------------- conventions


def test_world_to_camera_and_pixel_centres_by_hand() -> None:
    K = torch.tensor([[100.0, 0, 50], [0, 200, 40], [0, 0, 1]], dtype=D)
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=D)  # world x points to camera y
    camera = dp.Camera(K, quarter, torch.tensor([1.0, 2, 10], dtype=D))
    pixels, valid = camera.project(torch.tensor([[3.0, 0, 0]], dtype=D))
    # X_cam = (0 + 1, 3 + 2, 10), so u = 100 * 1 / 10 + 50 and v = 200 * 5 / 10 + 40.
    assert pixels.tolist() == [[60.0, 140.0]]
    assert valid.tolist() == [True]
    assert camera.center.tolist() == [-2.0, 1.0, -10.0]


def test_resizing_keeps_pixel_centres_at_integers(camera: dp.Camera) -> None:
    # A 4-pixel row halved: the first new pixel is centred between old pixels 0 and 1, at 0.5.
    half = camera.resized((320, 240))
    points = torch.tensor([[10.0, 20, 0], [-50, 60, 0]], dtype=D)
    torch.testing.assert_close(half.project(points)[0], 0.5 * camera.project(points)[0] - 0.25)
    assert half.size == (320, 240)


@pytest.mark.parametrize(
    "size", [(321, 240), (320, 241), (319, 240), (1280, 959), (64, 48), (13, 10), (4, 3), (2133, 1600)]
)
def test_resizing_allows_for_sides_rounded_to_whole_pixels(camera: dp.Camera, size: tuple[int, int]) -> None:
    """Each axis keeps its own scale, so that the pixels are exactly those of the resized image."""
    points = torch.tensor([[10.0, 20, 0], [-50, 60, 0]], dtype=D)
    scale = torch.tensor(size, dtype=D) / torch.tensor(camera.size, dtype=D)
    want = scale * camera.project(points)[0] + (scale - 1) / 2
    torch.testing.assert_close(camera.resized(size).project(points)[0], want)


@pytest.mark.parametrize(
    "size", [(640, 360), (1280, 720), (480, 640), (324, 240), (320, 242), (224, 224), (1, 1), (2, 2), (3, 2)]
)
def test_resizing_to_another_aspect_is_refused_unless_it_is_meant(camera: dp.Camera, size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=r"want the aspect of 640 x 480 px, got .* cropped\(left.* stretched=True"):
        camera.resized(size)
    points = torch.tensor([[10.0, 20, 0], [-50, 60, 0]], dtype=D)
    scale = torch.tensor(size, dtype=D) / torch.tensor(camera.size, dtype=D)
    want = scale * camera.project(points)[0] + (scale - 1) / 2
    torch.testing.assert_close(camera.resized(size, stretched=True).project(points)[0], want)


def test_cropping_moves_the_principal_point(camera: dp.Camera) -> None:
    points = torch.tensor([[10.0, 20, 0]], dtype=D)
    crop = camera.cropped(100.0, 50.0, 300, 200)
    shift = torch.tensor([100.0, 50], dtype=D)
    torch.testing.assert_close(crop.project(points)[0], camera.project(points)[0] - shift)
    assert crop.size == (300, 200)


# ------------------------------------------------------------------------------------------------ points and pixels


@given(seed=st.integers(0, 2**31), lens=st.booleans())
def test_projection_equals_opencv(seed: int, lens: bool) -> None:
    camera = draw_cameras(seed, 1, lens)[0]
    points = torch.randn(50, 3, dtype=D, generator=torch.Generator().manual_seed(seed)) * 50
    pixels, valid = camera.project(points)
    K, dist, rvec, tvec = camera.to_opencv()
    want, _ = cv2.projectPoints(points.numpy(), rvec, tvec, K, dist)
    np.testing.assert_allclose(pixels[valid].numpy(), want.reshape(-1, 2)[valid], rtol=0, atol=1e-9)
    assert valid.float().mean() > 0.9


def test_projection_equals_kornia() -> None:
    camera = draw_cameras(3, 8)
    points = torch.randn(8, 50, 3, dtype=D) * 50
    pixels, valid = camera.project(points)
    assert valid.all()
    torch.testing.assert_close(pixels, camera.to_kornia().project(points), rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", [False, True])
def test_rays_pass_through_the_points(lens: bool) -> None:
    camera = draw_cameras(5, 8, lens)
    points = torch.randn(8, 50, 3, dtype=D) * 50
    pixels, seen = camera.project(points)
    origin, direction, valid = camera.rays(pixels)
    assert valid[seen].all()
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(8, 50, dtype=D))
    torch.testing.assert_close(origin, camera.center[:, None].expand(8, 50, 3))
    offset = points - origin
    distance = torch.linalg.cross(offset, direction).norm(dim=-1)
    assert (distance[seen] < 1e-9 * offset.norm(dim=-1)[seen]).all()
    assert ((offset * direction).sum(dim=-1) > 0).all()


def test_a_turned_or_skewed_image_is_exact(lens_camera: dp.Camera, pixels: Tensor) -> None:
    turn = torch.tensor([[0.9, -0.4, 30], [0.5, 1.1, -20], [0, 0, 1]], dtype=D)
    turned = dp.Camera(turn @ lens_camera.K, lens_camera.R, lens_camera.t, lens_camera.distortion)
    moved = pixels @ turn[:2, :2].T + turn[:2, 2]
    _, want, valid = lens_camera.rays(pixels)
    _, direction, turned_valid = turned.rays(moved)
    assert torch.equal(valid, turned_valid)
    torch.testing.assert_close(direction, want, rtol=0, atol=1e-14)
    torch.testing.assert_close(
        turned.project(want * 100)[0], lens_camera.project(want * 100)[0] @ turn[:2, :2].T + turn[:2, 2]
    )


def test_points_that_no_camera_sees_are_invalid(K: Tensor) -> None:
    nan, inf = float("nan"), float("inf")
    points = torch.tensor(
        [[1, 2, 5.0], [1, 1, 0], [0, 0, 0], [1, 0, -5], [nan, 0, 5], [0, inf, 5], [0, 0, inf]], dtype=D
    )
    points.requires_grad_()
    pixels, valid = dp.Camera(K).project(points)
    assert valid.tolist() == [True] + [False] * 6
    assert (pixels[1:] == 0).all()
    (gradient,) = torch.autograd.grad(pixels.sum(), points)
    assert (gradient[1:] == 0).all()
    assert gradient[0].abs().sum() > 0


def test_pixels_that_are_not_finite_have_no_ray(lens_camera: dp.Camera) -> None:
    pixels = torch.tensor([[100.0, 100], [float("nan"), 1], [1, float("inf")]], dtype=D, requires_grad=True)
    directions, valid = lens_camera.directions(pixels)
    assert valid.tolist() == [True, False, False]
    assert directions[1].tolist() == [0, 0, 1]
    (gradient,) = torch.autograd.grad(directions.sum(), pixels)
    assert (gradient[1:] == 0).all()


@pytest.mark.parametrize("name", ["project", "rays"])
def test_derivatives(name: str, lens_camera: dp.Camera) -> None:
    inputs = {"project": torch.randn(4, 3, dtype=D) * 50, "rays": torch.rand(4, 2, dtype=D) * 400}[name]

    def function(inputs: Tensor, K: Tensor, R: Tensor, t: Tensor, coefficients: Tensor) -> Tensor:
        camera = dp.Camera(K, R, t, dp.BrownConrady(coefficients))
        return getattr(camera, name)(inputs)[-2]

    assert lens_camera.distortion is not None
    coefficients = lens_camera.distortion.coefficients
    arguments = [inputs, lens_camera.K, lens_camera.R, lens_camera.t, coefficients]
    arguments = tuple(argument.detach().clone().requires_grad_() for argument in arguments)
    assert torch.autograd.gradcheck(function, arguments, check_forward_ad=True)


# ------------------------------------------------------------------------------------------------------- as a tensor


def test_batch_equals_loop_and_broadcasts() -> None:
    cameras = draw_cameras(7, 6, lens=True)
    points = torch.randn(10, 3, dtype=D) * 50
    pixels, valid = cameras.project(points)
    assert pixels.shape == (6, 10, 2)
    for i in range(6):
        one, one_valid = cameras[i].project(points)
        torch.testing.assert_close(pixels[i], one, rtol=0, atol=1e-12)
        assert torch.equal(valid[i], one_valid)
    many = dp.Camera(cameras.K[:, None], cameras.R[0], cameras.t[None])
    assert many.batch_shape == (6, 6)
    assert many[1:3, ..., 0].batch_shape == (2,)
    assert many[many.K[..., 0, 0] > 0].batch_shape == (36,)


def test_survives_copying_and_moving(lens_camera: dp.Camera) -> None:
    copied = copy.deepcopy(lens_camera)
    assert torch.equal(copied.K, lens_camera.K)
    single = lens_camera.to(torch.float32)
    assert single.dtype == torch.float32
    assert single.distortion is not None
    assert single.distortion.dtype == torch.float32
    assert "BrownConrady" in repr(single)


def test_detached_camera_has_no_graph(K: Tensor, lens: dp.BrownConrady) -> None:
    camera = dp.Camera(K.requires_grad_(), distortion=lens)
    assert camera.K.requires_grad
    assert not camera.detach().K.requires_grad


# --------------------------------------------------------------------------------------------------- other libraries


@pytest.mark.parametrize("shape", ["flat", "row", "column"])
def test_opencv_round_trip(shape: str) -> None:
    K = np.array([[500, 0, 320], [0, 510, 240], [0, 0, 1]])  # integers, as people write them
    reshape = {"flat": lambda x: x, "row": lambda x: x[None], "column": lambda x: x[:, None]}[shape]
    dist, rvec, tvec = np.array([-0.2, 0.1, 0.001, 0.002, 0.01]), np.array([0.1, -0.2, 3.0]), np.array([1.0, 2, 300])
    camera = dp.Camera.from_opencv(K, reshape(dist), reshape(rvec), reshape(tvec), (640, 480))
    assert camera.batch_shape == ()
    assert camera.dtype == D
    for found, want in zip(camera.to_opencv(), (K, dist, rvec, tvec), strict=True):
        np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)


def test_opencv_poses_of_a_calibration_become_a_batch() -> None:
    rvecs = (np.zeros((3, 1)), np.full((3, 1), 0.1))  # the tuple that cv2.calibrateCamera returns
    camera = dp.Camera.from_opencv(np.diag([500.0, 500, 1]), None, rvecs, rvecs)
    assert camera.batch_shape == (2,)
    assert camera.distortion is None


def test_opencv_tensors_keep_their_graph() -> None:
    rvec = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float32, requires_grad=True)
    camera = dp.Camera.from_opencv(torch.diag(torch.tensor([500.0, 500, 1])), None, rvec, [0, 0, 1])
    assert camera.dtype == torch.float32
    camera.R.sum().backward()
    assert rvec.grad is not None


def test_kornia_round_trip() -> None:
    camera = draw_cameras(9, 4)
    again = dp.Camera.from_kornia(camera.to_kornia())
    for name in ("K", "R", "t"):
        assert torch.equal(getattr(again, name), getattr(camera, name))
    assert again.size == camera.size
    assert isinstance(camera[0].to_kornia(), kornia.geometry.PinholeCamera)
    assert camera[0].to_kornia().batch_size == 1


# ------------------------------------------------------------------------------------------------------------ errors


@pytest.mark.plain
def test_bad_cameras_are_refused_by_name(K: Tensor) -> None:
    eye = torch.eye(3, dtype=D)
    zero = K * torch.tensor([[0.0], [1], [1]], dtype=D)
    cases = [
        (ValueError, r"K: want shape \(\*B, 3, 3\), got \(1, 1\)", lambda: dp.Camera([[1.0]])),
        (TypeError, "K: want a tensor, an array or numbers, got None", lambda: dp.Camera(None)),
        (TypeError, "K: want a floating-point tensor, got torch.int64", lambda: dp.Camera(K.long())),
        (ValueError, r"K: want shape \(\*B, 3, 3\), got \(3, 4\)", lambda: dp.Camera(K.new_zeros(3, 4))),
        (ValueError, "K: want finite", lambda: dp.Camera(K * float("nan"))),
        (ValueError, "K: want an invertible matrix", lambda: dp.Camera(zero)),
        (ValueError, "K: want the last row .*divide by", lambda: dp.Camera(2 * K)),
        (ValueError, "K: want the last row .*transpose K", lambda: dp.Camera(K.mT)),
        (ValueError, "R: want rotation matrices", lambda: dp.Camera(K, 1.1 * eye)),
        (ValueError, "R: want rotation matrices", lambda: dp.Camera(K, -eye)),
        (ValueError, "t: want finite", lambda: dp.Camera(K, eye, eye[0] / 0)),
        (TypeError, "R: want torch.float64 as K has, got torch.float32", lambda: dp.Camera(K, eye.float())),
        (
            ValueError,
            "t: want device cpu as K has, got meta",
            lambda: dp.Camera(K, eye, torch.zeros(3, dtype=D, device="meta")),
        ),
        (
            ValueError,
            r"batch shapes do not broadcast: K \(2,\), R \(3,\)",
            lambda: dp.Camera(K.repeat(2, 1, 1), eye.repeat(3, 1, 1)),
        ),
        (TypeError, "distortion: want a lens", lambda: dp.Camera(K, distortion=eye[0])),
        (ValueError, "size: want", lambda: dp.Camera(K, size=(640, 0))),
        (IndexError, "too many indices", lambda: dp.Camera(K)[0]),
        (ValueError, "resized: want a camera with a size", lambda: dp.Camera(K).resized((10, 10))),
        (ValueError, "R: want rotation matrices", lambda: dp.Camera(K).at(2 * eye, eye[0])),
        (ValueError, "size: want .* PinholeCamera needs it", lambda: dp.Camera(K).to_kornia()),
        (
            ValueError,
            "K: want no skew",
            lambda: dp.Camera(K + 0.1 * eye.roll(1, 1) * eye.new_tensor([[1.0], [0], [0]])).to_opencv(),
        ),
    ]
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()


@pytest.mark.plain
def test_bad_points_are_refused_by_name(camera: dp.Camera) -> None:
    with pytest.raises(TypeError, match="points: want torch.float64 as camera has, got torch.float32"):
        camera.project(torch.zeros(5, 3))
    with pytest.raises(TypeError, match="pixels: want a floating-point tensor"):
        camera.rays(torch.zeros(5, 2, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"points: want shape \(\*B, N, 3\), got \(3,\)"):
        camera.project(torch.zeros(3, dtype=D))


@pytest.mark.plain
def test_what_another_library_cannot_hold_is_refused(lens_camera: dp.Camera, camera: dp.Camera) -> None:
    with pytest.raises(ValueError, match="PinholeCamera holds no lens"):
        lens_camera.to_kornia()
    with pytest.raises(ValueError, match=r"batch shape \(\) or \(B,\)"):
        camera.at(camera.R.expand(2, 3, 3, 3), camera.t).to_kornia()
    pinhole = camera.at(camera.R.expand(2, 3, 3), camera.t).to_kornia()
    pinhole.width[0] = 7
    with pytest.raises(ValueError, match="one image size"):
        dp.Camera.from_kornia(pinhole)
    with pytest.raises(TypeError, match="camera: want dp.Camera or kornia"):
        dp.back_project(torch.zeros(1, 2), "camera", dp.Plane.z(0.0))


def test_converting_keeps_one_camera_in_memory_once(lens_camera: dp.Camera) -> None:
    poses = lens_camera.at(lens_camera.R.expand(1000, 3, 3), torch.randn(1000, 3, dtype=D))
    single = poses.to(torch.float32)
    assert single.K.untyped_storage().nbytes() == 9 * 4
    assert single.distortion.coefficients.untyped_storage().nbytes() == 5 * 4
    assert torch.equal(single.t, poses.t.float())
    assert torch.equal(single.K, poses.K.float())
    plane = dp.Plane(torch.tensor([0.0, 0, 1], dtype=D).expand(50, 3), torch.arange(50, dtype=D))
    assert plane.to(torch.float32).normal.untyped_storage().nbytes() == 3 * 4


@pytest.mark.plain
def test_sizes_and_crops_that_are_none() -> None:
    camera = dp.Camera(torch.eye(3, dtype=torch.float64), size=(640, 480))
    with pytest.raises(TypeError, match=r"size: want \(width, height\) of the resized image, got None"):
        camera.resized(None)
    for left, top, name in (
        (float("nan"), 0, "left"),
        (0, float("inf"), "top"),
        (0, torch.tensor(float("nan")), "top"),
    ):
        with pytest.raises(ValueError, match=f"{name}: want a finite number"):
            camera.cropped(left, top, 10, 10)
    with pytest.raises(TypeError, match="left: want a finite number of px, got None"):
        camera.cropped(None, 0, 10, 10)


def test_opencv_s_arrays_are_copied() -> None:
    K, dist, vector = np.diag([500.0, 500, 1]), np.array([0.1, 0, 0, 0]), np.array([0.1, 0, 5])
    camera = dp.Camera.from_opencv(K, dist, vector, vector)
    t = camera.t.clone()
    for array in (K, dist, vector):
        array[:] = 7
    assert camera.K[0, 0] == 500
    assert camera.distortion.coefficients[0] == 0.1
    assert torch.equal(camera.t, t)


def test_a_rotation_matrix_is_no_rotation_vector() -> None:
    """Taken for three vectors it gave three cameras, each turned some other way."""
    K, matrix = np.diag([500.0, 500, 1]), cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]
    for rotation in (matrix, np.eye(3), matrix.tolist()):
        with pytest.raises(ValueError, match="rvec: want rotation vectors, got what looks like a rotation matrix"):
            dp.Camera.from_opencv(K, None, rotation, [0, 0, 1])
    assert dp.Camera.from_opencv(K, None, np.eye(3), np.zeros((3, 3))).batch_shape == (3,)
    assert dp.Camera.from_opencv(K, None, 2 * np.eye(3)).batch_shape == (3,)


@pytest.mark.plain
def test_what_is_no_camera_is_told_what_to_give() -> None:
    """The way from a calibration to its camera is told of calibrations only."""
    pixel = torch.zeros(1, 2, dtype=torch.float64)
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    with pytest.raises(TypeError, match=r"camera: .*give its \.camera"):
        dp.back_project(pixel, calibration, dp.Plane.z(0.0))  # type: ignore[arg-type]
    for other in (5, dp.Camera):
        with pytest.raises(TypeError, match="camera: want") as told:
            dp.back_project(pixel, other, dp.Plane.z(0.0))  # type: ignore[arg-type]
        assert "give its" not in str(told.value)


@pytest.mark.plain
def test_what_is_no_plane_is_refused_by_name(camera: dp.Camera) -> None:
    with pytest.raises(TypeError, match=r"plane: want a dp\.Plane, got 'z'"):
        dp.back_project(torch.zeros(1, 2, dtype=torch.float64), camera, "z")  # type: ignore[arg-type]
