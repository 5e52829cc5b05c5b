"""A turned image is that of a turned camera: the two see the same, also in OpenCV's and Kornia's eyes."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.geometry.intrinsics import upright

D = torch.float64
POINTS = torch.tensor([[0.0, 0, 0], [120, -40, 10], [-90, 70, -20], [60, 80, 30], [-100, -60, 5]], dtype=D)
BROWN = [-0.28, 0.07, 0.0013, -0.0021, 0.002, 0.01, -0.02, 0.003, 0.002, -0.001, 0.003, 0.0005, 0.02, -0.03]
LENSES: dict[str, dp.Lens | None] = {
    "none": None,
    **{f"brown{n}": dp.BrownConrady(torch.tensor(BROWN[:n], dtype=D)) for n in (4, 5, 8, 12, 14)},
    "tilted about x": dp.BrownConrady(torch.tensor([*BROWN[:13], 0.0], dtype=D)),
    "tilted about y": dp.BrownConrady(torch.tensor([*BROWN[:12], 0.0, -0.03], dtype=D)),
    "fisheye": dp.KannalaBrandt(torch.tensor([0.02, -0.01, 0.004, -0.001], dtype=D)),
}


def camera_with(lens: dp.Lens | None, f_y: float = 540.0) -> dp.Camera:
    K = torch.tensor([[530.0, 0, 330], [0, f_y, 236], [0, 0, 1]], dtype=D)
    R = dp.rotation_from_euler(*torch.tensor([0.3, -0.2, 0.4], dtype=D))
    return dp.Camera(K, R, torch.tensor([10.0, -20, 400], dtype=D), lens, (640, 480))


def turn(degrees: float, mirrored: bool = False) -> torch.Tensor:
    """The warp that turns an image clockwise about its middle, mirrored left to right before."""
    a = np.deg2rad(degrees)
    about = torch.tensor([[1.0, 0, 319.5], [0, 1, 239.5], [0, 0, 1]], dtype=D)
    q = torch.tensor([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]], dtype=D)
    flip = torch.diag(torch.tensor([-1.0 if mirrored else 1.0, 1, 1], dtype=D))
    return about @ q @ flip @ about.inverse()


def by_opencv(camera: dp.Camera) -> np.ndarray:
    K, dist, rvec, tvec = camera.to_opencv()
    points = POINTS.numpy()[:, None]
    if isinstance(camera.distortion, dp.KannalaBrandt):
        return cv2.fisheye.projectPoints(points, rvec, tvec, K, dist)[0].reshape(-1, 2)
    return cv2.projectPoints(points, rvec, tvec, K, dist)[0].reshape(-1, 2)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
@pytest.mark.parametrize("name", LENSES)
def test_opencv_projects_with_a_turned_camera(name: str, degrees: int, mirrored: bool) -> None:
    turned = camera_with(LENSES[name]).warped(turn(degrees, mirrored))
    if name == "brown14" and degrees in (90, 270):
        with pytest.raises(ValueError, match=r"K: want an image that is not turned against the tilted sensor"):
            turned.to_opencv()
        return
    want, valid = turned.project(POINTS)
    assert valid.all()
    np.testing.assert_allclose(by_opencv(turned), want.numpy(), rtol=0, atol=1e-9)
    K = turned.to_opencv()[0]
    assert K[0, 1] == K[1, 0] == 0
    assert bool((np.diag(K) > 0).all()) is not mirrored


@pytest.mark.parametrize("degrees", [12.0, 45.0, 133.0, -100.0])
@pytest.mark.parametrize("name", ["none", "brown8", "brown12", "fisheye"])
def test_square_pixels_are_turned_by_any_angle(name: str, degrees: float) -> None:
    turned = camera_with(LENSES[name], f_y=530.0).warped(turn(degrees))
    np.testing.assert_allclose(by_opencv(turned), turned.project(POINTS)[0].numpy(), rtol=0, atol=1e-9)
    oblong = camera_with(LENSES[name]).warped(turn(degrees))
    with pytest.raises(ValueError, match="K: want no skew, for OpenCV ignores it; got axes of the image"):
        oblong.to_opencv()
    upright = oblong.upright()
    torch.testing.assert_close(upright.project(POINTS)[0], oblong.project(POINTS)[0], rtol=0, atol=1e-9)
    assert upright.K[1, 0] == 0
    assert upright.K[0, 1] != 0


def test_an_upright_camera_keeps_its_numbers() -> None:
    skewed = torch.tensor([[530.0, 3, 330], [0, 540, 236], [0, 0, 1]], dtype=D)
    mirror = torch.diag(torch.tensor([1.0, -1, 1], dtype=D))
    for camera in (camera_with(LENSES["brown14"]), dp.Camera(skewed), dp.Camera(mirror @ skewed)):
        upright = camera.upright()
        for name in ("K", "R", "t"):
            assert torch.equal(getattr(upright, name), getattr(camera, name)), name
        if camera.distortion is not None:
            assert torch.equal(upright.distortion.coefficients, camera.distortion.coefficients)


def test_batches_turn_one_by_one_and_carry_gradients() -> None:
    camera = camera_with(LENSES["brown12"])
    turns = torch.stack([turn(a, m) for a, m in ((0, False), (90, False), (180, True), (37, False))])
    cameras = camera.warped(turns)
    upright = cameras.upright()
    assert upright.batch_shape == (4,)
    torch.testing.assert_close(upright.project(POINTS)[0], cameras.project(POINTS)[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(upright.R @ upright.R.mT, torch.eye(3, dtype=D).expand(4, 3, 3))
    assert (torch.linalg.det(upright.R) > 0).all()

    def pixels(K: torch.Tensor) -> torch.Tensor:
        return dp.Camera(K, camera.R, camera.t, camera.distortion).upright().project(POINTS)[0]

    torch.autograd.gradcheck(pixels, cameras.K[3].clone().requires_grad_())


def test_float32_and_the_quarter_turns_of_kornia() -> None:
    from kornia.augmentation import RandomRotation

    augment = RandomRotation((90.0, 90.0), p=1.0)
    augment(torch.rand(1, 1, 480, 640))
    camera = camera_with(LENSES["brown5"]).to(torch.float32).warped(augment.transform_matrix)[0]
    np.testing.assert_allclose(by_opencv(camera), camera.project(POINTS.float())[0].numpy(), rtol=0, atol=1e-3)
    pinhole = camera_with(None).warped(turn(270))
    kornia = pinhole.to_kornia()
    assert float(kornia.fx) == pytest.approx(540)
    assert float(kornia.fy) == pytest.approx(530)
    torch.testing.assert_close(kornia.project(POINTS), pinhole.project(POINTS)[0])


def test_files_of_opencv_hold_what_needs_no_pose(tmp_path: Path) -> None:
    """A turned image needs a turned camera, whose pose such a file cannot hold."""
    turned = camera_with(LENSES["brown5"]).without_pose().warped(turn(90))
    with pytest.raises(ValueError, match=r"hold no pose; use .json, or save camera.upright\(\).without_pose\(\)"):
        dp.save_camera(tmp_path / "camera.yml", turned)
    dp.save_camera(tmp_path / "camera.yml", turned.upright().without_pose())
    torch.testing.assert_close(dp.load_camera(tmp_path / "camera.yml").K, turned.upright().K)


@pytest.mark.parametrize(("f_x", "f_y"), [(500.0, 510.0), (500.0, -510.0), (-500.0, 510.0)])
def test_what_is_upright_already_is_not_turned(f_x: float, f_y: float) -> None:
    """A mirrored image is mirrored and no more: not turned by half a turn as well."""
    K = torch.tensor([[f_x, 0, 320], [0, f_y, 240], [0, 0, 1]], dtype=D)
    found, cosine, sine = upright(K)
    assert torch.equal(found, K)
    assert (float(cosine), float(sine)) == (1.0, 0.0)
