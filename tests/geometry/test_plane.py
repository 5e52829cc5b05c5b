"""`Plane`: the sign of its offset, fits and their derivatives, Python numbers, and what is refused."""

import numpy as np
import pytest
import torch
from torch import Tensor

import diffproj as dp

D = torch.float64


def test_convention_by_hand() -> None:
    plane = dp.Plane([0.0, 3.0, 4.0], 10.0)  # 3 y + 4 z = 10; its normal has length 5
    points = torch.tensor([[7.0, 2, 1], [0, 0, 0]], dtype=D)
    assert plane.distance(points).tolist() == [0.0, -2.0]
    assert plane.parallel(2.0).offset.item() == 20.0
    assert plane.unit_normal.tolist() == [0.0, 0.6, 0.8]


def test_numbers_take_on_the_dtype_they_meet(camera: dp.Camera) -> None:
    plane = dp.Plane.z(1.0)
    single = camera.to(torch.float32)
    points, _ = dp.back_project(torch.zeros(1, 2), single, plane.parallel(2.0))
    assert points.dtype == torch.float32
    assert abs(points[0, 2].item() - 3) < 1e-4
    assert not dp.Plane.z(torch.tensor(1.0)).adopts
    assert not plane.parallel(torch.tensor(1.0, dtype=D)).adopts


def test_from_points_finds_the_plane_whatever_its_attitude() -> None:
    normal = torch.nn.functional.normalize(torch.randn(100, 3, dtype=D), dim=-1)
    offset = torch.randn(100, dtype=D) * 100
    in_plane = torch.randn(100, 20, 3, dtype=D) * 50
    points = in_plane - ((in_plane * normal[:, None]).sum(-1) - offset[:, None])[..., None] * normal[:, None]
    plane = dp.Plane.from_points(points)
    assert plane.distance(points).abs().max() < 1e-12 * 1e3
    largest = plane.normal.abs().argmax(dim=-1, keepdim=True)
    assert (plane.normal.gather(-1, largest) > 0).all()


def test_from_points_is_the_least_squares_plane() -> None:
    points = torch.randn(30, 3, dtype=D) * torch.tensor([10.0, 10, 0.5], dtype=D)
    plane = dp.Plane.from_points(points)
    smallest = torch.linalg.svdvals(points - points.mean(dim=0))[-1]
    torch.testing.assert_close(plane.rms(points), smallest / 30**0.5)


def test_derivatives_are_finite_on_a_square_grid() -> None:
    x, y = torch.meshgrid(torch.arange(3.0, dtype=D), torch.arange(3.0, dtype=D), indexing="ij")
    grid = torch.stack([x.flatten(), y.flatten(), 0.01 * torch.randn(9, dtype=D)], dim=-1).requires_grad_()

    def fit(points: Tensor) -> tuple[Tensor, Tensor]:
        plane = dp.Plane.from_points(points)
        return plane.normal, plane.offset

    assert torch.autograd.gradcheck(fit, grid, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(fit, grid)


def test_indexing_and_moving() -> None:
    planes = dp.Plane(torch.randn(4, 1, 3), torch.randn(5))
    assert planes.batch_shape == (4, 5)
    assert planes[1].batch_shape == (5,)
    assert planes[..., 2].batch_shape == (4,)
    assert planes.to(D).dtype == D
    assert planes.detach().device.type == "cpu"
    assert "batch_shape=(4, 5)" in repr(planes)
    per_point = dp.Plane.per_point([0.0, 0.0, 1.0], torch.arange(3.0))
    assert per_point.distance(torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 1]])).tolist() == [1.0, 0.0, -1.0]
    with pytest.raises(IndexError, match="planes per point"):
        per_point[0]


@pytest.mark.plain
def test_bad_planes_are_refused_by_name() -> None:
    up = torch.tensor([0.0, 0, 1])
    cases = [
        (ValueError, "normal: want a vector other than zero", lambda: dp.Plane(0 * up, 1.0)),
        (ValueError, "plane: want a finite normal and offset", lambda: dp.Plane(up, float("inf"))),
        (TypeError, "normal: want a floating-point tensor", lambda: dp.Plane(up.int(), 1.0)),
        (TypeError, "offset: want torch.float32 as normal has", lambda: dp.Plane(up, torch.tensor(1.0, dtype=D))),
        (ValueError, r"normal: want shape \(\*B, 3\), got \(2,\)", lambda: dp.Plane(up[:2], 1.0)),
        (TypeError, "normal: want a tensor, an array or numbers, got 'up'", lambda: dp.Plane("up", 1.0)),
        (ValueError, "batch shapes do not broadcast", lambda: dp.Plane(up.expand(2, 3), torch.zeros(3))),
        (ValueError, "per_point: want", lambda: dp.Plane.per_point(up, 1.0)),
        (ValueError, "points: want at least 3, got 2", lambda: dp.Plane.from_points(torch.rand(2, 3))),
        (
            ValueError,
            "points: want three that are not on one line",
            lambda: dp.Plane.from_points(torch.arange(5.0)[:, None] * up),
        ),
        (ValueError, "points: want finite", lambda: dp.Plane.from_points(torch.full((4, 3), float("nan")))),
        (TypeError, "plane: want a dp.Plane, got Tensor", lambda: dp.PlaneMap(dp.Camera(torch.eye(3)), up)),
    ]
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()


@pytest.mark.parametrize("length", [1e-38, 1e-24, 1e-12, 1e20, 1e38])
def test_normals_of_any_length_in_float32(length: float) -> None:
    direction = torch.tensor([0.0, 0.6, 0.8])
    plane, unit = dp.Plane(direction * length, torch.tensor(3.0 * length)), dp.Plane(direction, torch.tensor(3.0))
    points = torch.tensor([[0.0, 0, 10], [1, 2, 3]])
    for found, want in (
        (plane.unit_normal, direction),
        (plane.tangents(), unit.tangents()),
        (plane.distance(points), unit.distance(points)),
        (plane.parallel(0.25).offset / length, torch.tensor(3.25)),
        (torch.stack(dp.plane_axes(plane)), torch.stack(dp.plane_axes(unit))),
        (dp.LearnablePlane(plane)().unit_normal, direction),
    ):
        torch.testing.assert_close(found, want, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-30, 1e-20, 1e20, 1e30])
def test_points_in_any_unit_in_float32(unit: float) -> None:
    points = torch.tensor([[0.0, 0, 1], [4, 0, 1], [0, 4, 1], [4, 4, 1.4]])
    plane, want = dp.Plane.from_points(points * unit), dp.Plane.from_points(points)
    torch.testing.assert_close(plane.normal, want.normal)
    torch.testing.assert_close(plane.rms(points * unit) / unit, want.rms(points), rtol=1e-4, atol=0)


def test_points_exactly_on_a_plane_have_an_rms_with_a_gradient() -> None:
    points = torch.tensor([[0.0, 0, 1], [4, 0, 1], [0, 4, 1]], requires_grad=True)
    rms = dp.Plane.z(1.0).rms(points)
    assert rms.item() == 0
    assert torch.equal(torch.autograd.grad(rms, points)[0], torch.zeros(3, 3))


@pytest.mark.plain
def test_parallels_at_no_distance() -> None:
    for distance in (float("nan"), float("inf"), torch.tensor(float("nan"))):
        with pytest.raises(ValueError, match="distance: want (a )?finite numbers?, got"):
            dp.Plane.z(0.0).parallel(distance)
    with pytest.raises(TypeError, match="distance: want a tensor, an array or numbers, got None"):
        dp.Plane.z(0.0).parallel(None)


@pytest.mark.plain
def test_an_array_is_copied() -> None:
    normal = np.array([0.0, 0, 1])
    plane = dp.Plane(normal, 0.0)
    normal[:] = 7
    assert plane.normal.tolist() == [0, 0, 1]


def test_tangents_of_many_planes_are_those_of_each() -> None:
    normals = torch.tensor([[0.0, 0, 1], [1, 2, 3], [-3, 1, 0.5], [0, 1, 0]], dtype=torch.float64)
    tangents = dp.Plane(normals, torch.zeros(4, dtype=torch.float64)).tangents()
    for normal, found in zip(normals, tangents, strict=True):
        torch.testing.assert_close(found, dp.Plane(normal, 0.0).tangents())
        torch.testing.assert_close(found.mT @ found, torch.eye(2, dtype=torch.float64))
        torch.testing.assert_close(normal @ found, torch.zeros(2, dtype=torch.float64))


def test_three_points_make_a_plane() -> None:
    corners = torch.tensor([[0.0, 0, 1], [4, 0, 1], [0, 4, 5]], dtype=torch.float64)
    assert float(dp.Plane.from_points(corners).rms(corners)) < 1e-12
    with pytest.raises(ValueError, match="points: want at least 3, got 2"):
        dp.Plane.from_points(corners[:2])
