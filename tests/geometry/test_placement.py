"""Cameras from matrices of other programs, and back; and the homography of a plane."""

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from kornia.geometry.transform import warp_perspective

import diffproj as dp

D = torch.float64


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("factor", [1.0, -3.0, 1e-6])
def test_a_projection_matrix_gives_its_camera_back(rows: int, factor: float, camera: dp.Camera) -> None:
    for skew in (0.0, 3.0):
        K = camera.K + skew * torch.eye(3, dtype=D).roll(1, 1) * torch.tensor([1.0, 0, 0], dtype=D).unsqueeze(-1)
        matrix = torch.nn.functional.pad(K, (0, 1, 0, 1)) @ camera.world_to_cam()
        matrix = factor * matrix[:3]
        if rows == 4:
            matrix = torch.cat([matrix, torch.tensor([[0.0, 0, 0, 1]], dtype=D)])
        found = dp.Camera.from_matrix(matrix, size=(640, 480))
        torch.testing.assert_close(found.K, K, rtol=1e-12, atol=1e-9)
        torch.testing.assert_close(found.R, camera.R, rtol=0, atol=1e-12)
        torch.testing.assert_close(found.t, camera.t, rtol=1e-12, atol=1e-9)
        assert skew or found.K[0, 1] == 0  # so that OpenCV takes it
    batch, change = torch.stack([matrix[:3], 2 * matrix[:3]]), torch.zeros(2, 3, 4, dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(lambda e: dp.Camera.from_matrix(batch * (1 + e)).t, change)


def test_matrices_that_are_no_cameras() -> None:
    with pytest.raises(ValueError, match="projection: want K .* without inverse"):
        dp.Camera.from_matrix(torch.diag(torch.tensor([1.0, 1, 0, 1]))[:3])
    with pytest.raises(ValueError, match="last row"):
        dp.Camera.from_matrix(torch.ones(4, 4))
    with pytest.raises(ValueError, match="projection: want K .* infinitely far away"):
        dp.Camera.from_matrix([[1e-5, 0, 0, 1e306], [0, 1e-5, 0, 0], [0, 0, 1.0, 0]])
    moved = dp.Camera(torch.eye(3), t=torch.tensor([0.0, 0, 5])).world_to_cam("pytorch3d")
    with pytest.raises(ValueError, match=r"extrinsics: want the last row .* transposed"):
        dp.Camera.from_extrinsics(moved, torch.eye(3))


@pytest.mark.parametrize("convention", ["opencv", "opengl", "pytorch3d"])
@pytest.mark.parametrize("to", ["camera", "world"])
def test_extrinsics_there_and_back(convention: str, to: str, camera: dp.Camera) -> None:
    matrix = camera.world_to_cam(convention) if to == "camera" else camera.cam_to_world(convention)
    found = dp.Camera.from_extrinsics(matrix, camera.K, convention, to)
    torch.testing.assert_close(found.R, camera.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t, camera.t, rtol=1e-12, atol=1e-10)
    inverse = camera.cam_to_world(convention) if to == "camera" else camera.world_to_cam(convention)
    torch.testing.assert_close(matrix @ inverse, torch.eye(4, dtype=D), rtol=0, atol=1e-10)


def test_conventions_are_those_of_the_axes(camera: dp.Camera) -> None:
    """Where a point lies as each program says it: right, up or down, ahead or behind."""
    X = torch.tensor([30.0, -20, 10, 1], dtype=D)
    x, y, z, _ = camera.world_to_cam() @ X
    torch.testing.assert_close(camera.world_to_cam("opengl") @ X, torch.stack([x, -y, -z, x.new_tensor(1)]))
    torch.testing.assert_close(X @ camera.world_to_cam("pytorch3d"), torch.stack([-x, -y, z, x.new_tensor(1)]))
    torch.testing.assert_close(camera.cam_to_world()[:3, 3], camera.center)


def test_quaternions_go_through_kornia(camera: dp.Camera) -> None:
    quaternion = rotation_matrix_to_quaternion(camera.R)
    torch.testing.assert_close(camera.at(quaternion_to_rotation_matrix(quaternion), camera.t).R, camera.R)


def test_looking_at_sees_its_target_upright() -> None:
    torch.manual_seed(0)
    position, target = torch.randn(20, 3, dtype=D) * 5, torch.randn(20, 3, dtype=D)
    camera = dp.Camera.looking_at(position, target, fov_deg=60.0, size=(641, 481))
    torch.testing.assert_close(camera.center, position)
    seen, valid = camera.project(torch.stack([target, target + torch.tensor([0, 0, 0.1], dtype=D)], dim=-2))
    torch.testing.assert_close(seen[:, 0], torch.tensor([320.0, 240], dtype=D).expand(20, 2), rtol=0, atol=1e-9)
    assert valid.all()
    torch.testing.assert_close(seen[:, 1, 0], torch.full((20,), 320.0, dtype=D), rtol=0, atol=1e-9)
    assert (seen[:, 1, 1] < 240).all()
    mast = dp.Camera.mounted(5.0, 20.0, heading_deg=30.0, focal=500.0, size=(641, 481))
    ahead = mast.center + mast.R[2]
    again = dp.Camera.looking_at(mast.center, ahead, focal=500.0, size=(641, 481))
    torch.testing.assert_close(again.R, mast.R)
    torch.testing.assert_close(again.t, mast.t)
    with pytest.raises(ValueError, match="up: want a direction other than"):
        dp.Camera.looking_at([0.0, 0, 5], [0.0, 0, 0], focal=500.0, size=(641, 481))


def test_the_homography_is_the_map(camera: dp.Camera, pixels: torch.Tensor) -> None:
    tilted = dp.Plane(torch.tensor([0.1, -0.2, 2.0], dtype=D), torch.tensor(30.0, dtype=D))
    for plane, axes in ((dp.Plane.z(7.0), None), (tilted, dp.plane_axes(tilted))):
        to_plane = dp.PlaneMap(camera, plane)
        points, valid = to_plane(pixels)
        s, t, w = to_plane.homography(axes) @ torch.nn.functional.pad(pixels, (0, 1), value=1.0).T
        origin, along_s, along_t = dp.plane_axes(plane.like(pixels)) if axes is None else axes
        torch.testing.assert_close(s / w, (points - origin) @ along_s, rtol=1e-10, atol=1e-8)
        torch.testing.assert_close(t / w, (points - origin) @ along_t, rtol=1e-10, atol=1e-8)
        assert torch.equal(w > 0, valid)
    with pytest.raises(ValueError, match="axes: want those of plane_axes"):
        dp.PlaneMap(camera, tilted).homography()
    rounded = camera.to(torch.float32).to(D)  # its R is a rotation to 1e-7, and level is level
    H = dp.PlaneMap(rounded, dp.Plane.z(7.0)).homography()
    s, t, w = H @ torch.nn.functional.pad(pixels, (0, 1), value=1.0).T
    points, _ = dp.back_project(pixels, rounded, dp.Plane.z(7.0))
    torch.testing.assert_close(torch.stack([s / w, t / w], dim=-1), points[:, :2], rtol=1e-10, atol=1e-8)


@pytest.mark.parametrize("tilted", [False, True])
def test_the_normalised_homography_has_the_derivatives_of_the_formula(tilted: bool) -> None:
    """By camera and plane. Those of the entries as they come leave out how the factor changes, which is documented."""
    upper, angles, t, abcd = parts = [
        torch.tensor(values, dtype=D, requires_grad=True)
        for values in (
            [[500.0, 2, 320], [0, 510, 240]],
            [0.5, 0.1, 0.05],
            [10.0, 20, 800],
            [0.1, -0.2, 2.0, 30.0] if tilted else [0.0, 0, 2, 14],
        )
    ]
    K = torch.cat([upper, torch.tensor([[0.0, 0, 1]], dtype=D)])
    R, plane = dp.rotation_from_euler(*angles), dp.Plane(abcd[:3], abcd[3])
    axes = dp.plane_axes(plane) if tilted else None
    H = dp.PlaneMap(dp.Camera(K, R, t), plane).homography(axes)
    if axes is None:  # z of the plane at (0, 0), and its slopes
        x, y, z = torch.eye(3, dtype=D)
        axes = abcd[3] / abcd[2] * z, x - abcd[0] / abcd[2] * z, y - abcd[1] / abcd[2] * z
    origin, along_s, along_t = axes
    want = torch.linalg.inv(K @ torch.stack([R @ along_s, R @ along_t, R @ origin + t], dim=-1))
    weights = torch.randn(3, 3, dtype=D) * torch.tensor([1.0, 1, 1e3], dtype=D).unsqueeze(-1)

    def gradients(H: torch.Tensor) -> list[torch.Tensor]:
        return list(torch.autograd.grad((weights * H).sum(), parts, retain_graph=True))

    ours, theirs = gradients(H / H[2:, 2:]), gradients(want / want[2:, 2:])
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-9 * float(other.abs().amax()))


def test_cv2_and_kornia_warp_by_it_as_rectify_does(camera: dp.Camera) -> None:
    """To the top view's pixels: column (s - s_min) / step - 1/2."""
    rows, columns = torch.meshgrid(torch.arange(480.0, dtype=D), torch.arange(640.0, dtype=D), indexing="ij")
    image = ((columns / 23).sin() + (rows / 17).cos()).unsqueeze(0)
    extent, step = (-100.0, -60.0, 60.0, 60.0), 2.0
    plane = dp.Plane.z(0.0)
    top, valid = dp.rectify(image, camera, plane, extent, step, samples=1)
    shift = torch.tensor([[1 / step, 0, 100 / step - 0.5], [0, 1 / step, 60 / step - 0.5], [0, 0, 1]], dtype=D)
    H = shift @ dp.PlaneMap(camera, plane).homography()
    by_kornia = warp_perspective(image.unsqueeze(0), H.unsqueeze(0), (60, 80), align_corners=True)[0]
    by_cv2 = cv2.warpPerspective(image[0].numpy(), H.numpy(), (80, 60), flags=cv2.INTER_LINEAR)
    inner = valid & torch.nn.functional.avg_pool2d(valid[None].double(), 3, 1, 1)[0].eq(1)
    assert inner.sum() > 1000
    torch.testing.assert_close(by_kornia[0][inner], top[0][inner], rtol=0, atol=1e-6)
    assert np.abs(by_cv2 - top[0].numpy())[inner.numpy()].max() < 5e-3  # which rounds places to 1/32 px


def test_a_lens_has_no_homography(lens_camera: dp.Camera) -> None:
    with pytest.raises(ValueError, match="homography: want a pinhole"):
        dp.PlaneMap(lens_camera, dp.Plane.z(0.0)).homography()


@pytest.mark.parametrize("wrong", ["position", "target", "up"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_looking_at_refuses_what_is_not_finite_by_that_name(wrong: str, value: float) -> None:
    given = {"position": [0.0, 0, 5], "target": [1.0, 2, 0], "up": [0.0, 0, 1], wrong: [0.0, 1, value]}
    with pytest.raises(ValueError, match="position, target, up: want finite numbers"):
        dp.Camera.looking_at(**given, size=(640, 480), focal=500.0)
