"""The kernel: against the paper's route, by hand, in float32, its derivatives, and where there is no point."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import diffproj as dp
from diffproj._core import numerics

D = torch.float64
NAN, INF = float("nan"), float("inf")


def draw_scene(seed: int) -> tuple[dp.Camera, dp.Plane, Tensor, Tensor, Tensor]:
    """A random pinhole, plane and pixels; the sine of each ray's angle to the plane, and the size of the scene."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float = -1.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, dtype=D, generator=generator)

    K = torch.eye(3, dtype=D)
    K[0, 0], K[1, 1] = uniform(2, low=300, high=2000)
    K[:2, 2] = uniform(2, low=200, high=800)
    scale = 10 ** uniform(1, low=-2, high=3)
    camera = dp.Camera(K, dp.rotation_from_euler(*(uniform(3) * torch.pi)), uniform(3) * scale)
    plane = dp.Plane(uniform(3) * 10 ** uniform(1, low=-2, high=2), uniform(1)[0] * scale[0])
    pixels = uniform(200, 2, low=0, high=1000)
    origin, direction, _ = camera.rays(pixels)
    slope = (direction * plane.unit_normal).sum(dim=-1)
    reach = plane.distance(origin).abs() / slope.abs()
    return camera, plane, pixels, slope, origin.norm(dim=-1) + reach


# ------------------------------------------------------------------------------------------------------------ values


def test_by_hand() -> None:
    # A camera 10 above the plane z = 2 looks straight down: x to the right, y down in the image is -y in the world.
    K = torch.tensor([[100.0, 0, 50], [0, 200, 40], [0, 0, 1]], dtype=D)
    down = torch.diag(torch.tensor([1.0, -1, -1], dtype=D))
    camera = dp.Camera(K, down, torch.tensor([0.0, 0, 12], dtype=D))
    points, valid = dp.back_project(torch.tensor([[60.0, 80]], dtype=D), camera, dp.Plane.z(2.0))
    torch.testing.assert_close(points, torch.tensor([[1.0, -2.0, 2.0]], dtype=D), rtol=0, atol=1e-14)
    assert valid.tolist() == [True]


@given(seed=st.integers(0, 2**31))
def test_equals_the_papers_route(seed: int) -> None:
    camera, plane, pixels, slope, size = draw_scene(seed)
    points, valid = dp.back_project(pixels, camera, plane)
    in_front = slope * plane.distance(camera.center[None]) < 0
    steep = slope.abs() > torch.tensor(1.0).deg2rad().sin()
    assert torch.equal(valid[steep], in_front[steep])
    error = (points - dp.paper_route(pixels, camera, plane)).norm(dim=-1)
    assert (error <= 1e-10 * size)[valid & steep].all()


@pytest.mark.filterwarnings("ignore:float32:UserWarning")  # a few of the cameras are very close to their plane
@given(seed=st.integers(0, 2**31))
def test_float32_is_right_to_a_millionth_of_the_scene(seed: int) -> None:
    camera, plane, pixels, _, _ = draw_scene(seed)
    camera, plane, pixels = camera.to(torch.float32), plane.to(torch.float32), pixels.float()
    points, valid = dp.back_project(pixels, camera, plane)
    # The same numbers in float64: only the arithmetic differs. R is a rotation to float32's rounding, which is enough.
    camera, plane, pixels = camera.to(D), plane.to(D), pixels.double()
    want, _ = dp.back_project(pixels, camera, plane)
    origin, direction, _ = camera.rays(pixels)
    steep = (direction * plane.unit_normal).sum(dim=-1).abs() > torch.tensor(10.0).deg2rad().sin()
    size = origin.norm(dim=-1) + (want - origin).norm(dim=-1)
    error = (points.double() - want).norm(dim=-1)
    assert (error <= 1e-6 * size)[valid & steep].all()


@pytest.mark.parametrize("name", ["camera", "lens_camera"])
def test_round_trip(name: str, pixels: Tensor, request: pytest.FixtureRequest) -> None:
    camera = request.getfixturevalue(name)
    plane = dp.Plane([0.1, -0.2, 1.0], 30.0)
    points, valid = dp.back_project(pixels, camera, plane)
    assert valid.all()
    assert plane.distance(points).abs().max() < 1e-10
    torch.testing.assert_close(camera.project(points)[0], pixels, rtol=0, atol=1e-9)


@pytest.mark.parametrize("reach", [1.0, 1e3, 1e5])
def test_a_camera_that_rests_on_the_plane_says_so(reach: float, K: Tensor) -> None:
    """Also where the plane is seen along its normal, and where it is one of the axes'."""
    R = dp.rotation_from_euler(*torch.randn(3, 200, dtype=D))
    for normal in (R[:, 2], torch.tensor([0.0, 0, 1], dtype=D).expand(200, 3)):
        center = reach * torch.nn.functional.normalize(torch.linalg.cross(normal, torch.randn(200, 3, dtype=D)), dim=-1)
        t = -(R @ center.unsqueeze(-1)).squeeze(-1)
        camera = dp.Camera(K.float(), R.float(), t.float())
        reasons = dp.explain(torch.rand(200, 5, 2) * 400, camera, dp.Plane(normal.float(), torch.zeros(200)))
        assert (reasons == dp.Reason.CAMERA_ON_PLANE).all()


def test_equals_kornia(camera: dp.Camera, pixels: Tensor) -> None:
    pinhole = camera.to_kornia()
    points, valid = dp.back_project(pixels, pinhole, dp.Plane.z(0.0))
    assert points.shape == (1, 200, 3)
    assert valid.all()
    depth = (points @ camera.R.T + camera.t)[..., 2:]
    torch.testing.assert_close(pinhole.unproject(pixels[None], depth), points, rtol=0, atol=1e-9)


def test_scaling_or_turning_the_normal_round_changes_nothing(camera: dp.Camera, pixels: Tensor) -> None:
    points, _ = dp.back_project(pixels, camera, dp.Plane([0.0, 0.1, 1.0], 5.0))
    for factor in (-1.0, 1e-6, 3e5):
        again, valid = dp.back_project(pixels, camera, dp.Plane([0.0, 0.1 * factor, factor], 5.0 * factor))
        assert valid.all()
        torch.testing.assert_close(again, points, rtol=0, atol=1e-10)


# ------------------------------------------------------------------------------------------------------------ shapes


def test_batch_equals_loop_and_broadcasts(lens_camera: dp.Camera, pixels: Tensor) -> None:
    t = lens_camera.t + torch.randn(4, 1, 3, dtype=D)
    cameras = lens_camera.at(lens_camera.R, t)  # (4, 1)
    planes = dp.Plane(torch.tensor([0.0, 0, 1], dtype=D), torch.arange(3.0, dtype=D))  # (3,)
    points, valid = dp.back_project(pixels, cameras, planes)
    assert points.shape == (4, 3, 200, 3)
    assert valid.shape == (4, 3, 200)
    for i in range(4):
        for j in range(3):
            one, _ = dp.back_project(pixels, cameras[i, 0], planes[j])
            torch.testing.assert_close(points[i, j], one, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["camera", "lens_camera"])
def test_a_plane_for_each_point(name: str, pixels: Tensor, request: pytest.FixtureRequest) -> None:
    camera = request.getfixturevalue(name)
    heights = torch.linspace(-20, 20, 200, dtype=D)
    points, valid = dp.back_project(pixels, camera, dp.Plane.per_point([0.0, 0.0, 1.0], heights.tolist()))
    assert points.shape == (200, 3)
    assert valid.all()
    torch.testing.assert_close(points[:, 2], heights, rtol=0, atol=1e-10)
    for i in (0, 77, 199):
        one, _ = dp.back_project(pixels[i : i + 1], camera, dp.Plane.z(heights[i]))
        torch.testing.assert_close(points[i], one[0], rtol=0, atol=1e-12)
    codes = dp.explain(pixels, camera, dp.Plane.per_point([0.0, 0.0, 1.0], heights))
    assert (codes == dp.Reason.VALID).all()


def test_planes_per_point_and_batches_of_cameras_combine(camera: dp.Camera, pixels: Tensor) -> None:
    cameras = camera.at(camera.R, camera.t + torch.randn(3, 3, dtype=D))
    plane = dp.Plane.per_point(torch.tensor([0.0, 0, 1], dtype=D), torch.randn(3, 200, dtype=D))
    points, valid = dp.back_project(pixels.expand(3, 200, 2), cameras, plane)
    assert valid.all()
    torch.testing.assert_close(points[..., 2], plane.offset, rtol=0, atol=1e-10)


def test_no_points(lens_camera: dp.Camera) -> None:
    points, valid = dp.back_project(torch.zeros(0, 2, dtype=D), lens_camera, dp.Plane.z(0.0))
    assert points.shape == (0, 3)
    assert valid.shape == (0,)
    assert dp.explain(torch.zeros(0, 2, dtype=D), lens_camera, dp.Plane.z(0.0)).shape == (0,)


@pytest.mark.parametrize("name", ["camera", "lens_camera"])
def test_blocks_change_no_bit(name: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    camera = request.getfixturevalue(name)
    pixels = torch.rand(1000, 2, dtype=D) * 2000 - 500
    want = dp.back_project(pixels, camera, dp.Plane.z(0.0))
    monkeypatch.setattr(numerics, "BLOCK_POINTS", 37)
    cameras = camera.at(camera.R.expand(2, 3, 3), camera.t)
    for found, once in zip(dp.back_project(pixels, cameras, dp.Plane.z(0.0)), want, strict=True):
        assert torch.equal(found[0], once)
        assert torch.equal(found[1], once)


def test_callers_tensors_are_not_written(lens_camera: dp.Camera) -> None:
    pixels = torch.tensor([[NAN, 1.0], [1, 2]], dtype=D)
    before = pixels.clone()
    dp.back_project(pixels, lens_camera, dp.Plane.z(0.0))
    torch.testing.assert_close(pixels, before, equal_nan=True, rtol=0, atol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_pixels_are_lifted(dtype: torch.dtype, camera: dp.Camera) -> None:
    pixels = torch.tensor([[100.0, 200.0]], dtype=dtype)  # both types hold these numbers exactly
    for precision in (torch.float32, D):
        points, _ = dp.back_project(pixels, camera.to(precision), dp.Plane.z(0.0))
        assert points.dtype == precision
        want, _ = dp.back_project(pixels.to(precision), camera.to(precision), dp.Plane.z(0.0))
        assert torch.equal(points, want)


def test_autocast_leaves_geometry_alone(lens_camera: dp.Camera, pixels: Tensor) -> None:
    camera, pixels = lens_camera.to(torch.float32), pixels.float()
    want, _ = dp.back_project(pixels, camera, dp.Plane.z(0.0))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        points, _ = dp.back_project(pixels, camera, dp.Plane.z(0.0))
    assert torch.equal(points, want)


# ------------------------------------------------------------------------------------------------------- derivatives


def with_parts(K: Tensor, R: Tensor, t: Tensor, normal: Tensor, offset: Tensor, pixels: Tensor) -> Tensor:
    return dp.back_project(pixels, dp.Camera(K, R, t), dp.Plane(normal, offset))[0]


def parts(camera: dp.Camera, pixels: Tensor) -> tuple[Tensor, ...]:
    plane = [torch.tensor([0.1, -0.2, 1.0], dtype=D), torch.tensor(7.0, dtype=D)]
    return tuple(part.detach().clone().requires_grad_() for part in (camera.K, camera.R, camera.t, *plane, pixels))


def test_derivatives_to_every_input(camera: dp.Camera, pixels: Tensor) -> None:
    arguments = parts(camera, pixels[:3])
    assert torch.autograd.gradcheck(with_parts, arguments, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(with_parts, arguments)


def test_derivatives_with_a_lens(lens_camera: dp.Camera, pixels: Tensor) -> None:
    def with_lens(coefficients: Tensor, *arguments: Tensor) -> Tensor:
        K, R, t, normal, offset, pixels = arguments
        camera = dp.Camera(K, R, t, dp.BrownConrady(coefficients))
        return dp.back_project(pixels, camera, dp.Plane(normal, offset))[0]

    assert lens_camera.distortion is not None
    coefficients = lens_camera.distortion.coefficients.clone().requires_grad_()
    arguments = (coefficients, *parts(lens_camera, pixels[:3]))
    assert torch.autograd.gradcheck(with_lens, arguments, check_forward_ad=True)


@pytest.mark.parametrize("name", ["camera", "lens_camera"])
def test_invalid_points_are_finite_and_have_no_gradient(name: str, request: pytest.FixtureRequest) -> None:
    camera = request.getfixturevalue(name)
    bad = torch.tensor([[NAN, 1], [INF, 2], [3, -INF], [-INF, INF], [300, 1e300]], dtype=D)
    plane = dp.Plane([0.0, 1.0, 0.0], 900.0)
    good = torch.tensor([[300.0, 100], [200, 200]], dtype=D)

    def gradients(pixels: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        leaves = [
            pixels.clone().requires_grad_(),
            *(p.clone().requires_grad_() for p in (camera.K, camera.R, camera.t)),
        ]
        moved = dp.Camera(*leaves[1:], camera.distortion)
        points, valid = dp.back_project(leaves[0], moved, plane)
        return points, valid, list(torch.autograd.grad(points.square().sum(), leaves))

    points, valid, alone = gradients(good)
    assert valid.all()
    mixed_points, mixed_valid, mixed = gradients(torch.cat([bad, good]))
    assert mixed_valid.tolist() == [False] * 5 + [True] * 2
    assert (mixed_points[:5] == 0).all()
    assert torch.equal(mixed_points[5:], points)
    assert (mixed[0][:5] == 0).all()
    for found, want in zip([mixed[0][5:], *mixed[1:]], alone, strict=True):
        torch.testing.assert_close(found, want)
    none_points, none_valid, none = gradients(bad)
    assert not none_valid.any()
    assert (none_points == 0).all()
    assert all((gradient == 0).all() for gradient in none)


def test_vmap_and_functional_transforms(lens_camera: dp.Camera, pixels: Tensor) -> None:
    t = lens_camera.t + torch.randn(5, 3, dtype=D)
    want, want_valid = dp.back_project(pixels, lens_camera.at(lens_camera.R, t), dp.Plane.z(0.0))

    def from_translation(t: Tensor) -> tuple[Tensor, Tensor]:
        camera = dp.Camera(lens_camera.K, lens_camera.R, t, lens_camera.distortion)
        return dp.back_project(pixels, camera, dp.Plane.z(0.0))

    points, valid = torch.func.vmap(from_translation)(t)
    torch.testing.assert_close(points, want, rtol=0, atol=1e-10)
    assert torch.equal(valid, want_valid)
    # The camera itself is a tree: a batch of cameras is mapped over as it is.
    cameras = dp.Camera(lens_camera.K.expand(5, 3, 3), lens_camera.R, t)
    points, _ = torch.func.vmap(lambda camera: dp.back_project(pixels, camera, dp.Plane.z(0.0)))(cameras)
    assert points.shape == (5, 200, 3)
    forward = torch.func.jacfwd(lambda t: from_translation(t)[0])(t[0])
    reverse = torch.func.jacrev(lambda t: from_translation(t)[0])(t[0])
    torch.testing.assert_close(forward, reverse, rtol=0, atol=1e-9)


def test_forward_mode_lives_under_no_grad(lens_camera: dp.Camera, pixels: Tensor) -> None:
    def depth(pixels: Tensor) -> Tensor:
        return dp.back_project(pixels, lens_camera, dp.Plane.z(0.0))[0]

    tangent = torch.randn_like(pixels)
    _, want = torch.func.jvp(depth, (pixels,), (tangent,))
    with torch.no_grad():
        _, found = torch.func.jvp(depth, (pixels,), (tangent,))
    assert torch.equal(found, want)
    assert found.abs().max() > 0


# ------------------------------------------------------------------------------------------------- where there is none


def test_explain_names_each_reason(K: Tensor) -> None:
    barrel = dp.BrownConrady(torch.tensor([-0.3, 0, 0, 0], dtype=D))  # folds at a radius of 1 / sqrt(0.9)
    camera = dp.Camera(K, distortion=barrel)
    floor = dp.Plane([0.0, 1.0, 0.0], 1.5)
    cx, cy = K[0, 2].item(), K[1, 2].item()
    pixels = torch.tensor([[cx, cy + 50], [NAN, 0], [cx + 5000, cy], [cx, cy], [cx, cy - 50]], dtype=D)
    reasons = dp.explain(pixels, camera, floor)
    assert [dp.Reason(code) for code in reasons.tolist()] == [
        dp.Reason.VALID,
        dp.Reason.NOT_FINITE,
        dp.Reason.OUTSIDE_LENS,
        dp.Reason.PARALLEL,
        dp.Reason.BEHIND,
    ]
    assert (dp.explain(pixels[:1], camera, dp.Plane([0.0, 1.0, 0.0], 0.0)) == dp.Reason.CAMERA_ON_PLANE).all()


def test_explain_agrees_with_valid(lens_camera: dp.Camera) -> None:
    pixels = torch.randn(2000, 2, dtype=D) * 2000
    pixels[::97] = INF
    plane = dp.Plane([0.3, -1.0, 0.2], 40.0)
    _, valid = dp.back_project(pixels, lens_camera, plane)
    assert torch.equal(dp.explain(pixels, lens_camera, plane) == dp.Reason.VALID, valid)
    assert 0.01 < valid.double().mean() < 0.99


def test_a_camera_on_the_plane_sees_none_of_it(camera: dp.Camera, pixels: Tensor) -> None:
    plane = dp.Plane(
        torch.tensor([0.2, 0.1, 1.0], dtype=D), (camera.center * torch.tensor([0.2, 0.1, 1.0], dtype=D)).sum()
    )
    points, valid = dp.back_project(pixels, camera, plane)
    assert not valid.any()
    assert (points == 0).all()


@pytest.mark.plain
def test_bad_input_is_refused_by_name(camera: dp.Camera, pixels: Tensor) -> None:
    plane = dp.Plane.z(0.0)
    cases = [
        (
            TypeError,
            "pixels: want a tensor, an array or numbers, got 'uv'",
            lambda: dp.back_project("uv", camera, plane),
        ),
        (
            TypeError,
            "pixels: want a floating-point tensor, got torch.int64",
            lambda: dp.back_project(pixels.long(), camera, plane),
        ),
        (TypeError, "pixels: want torch.float64 as camera has", lambda: dp.back_project(pixels.float(), camera, plane)),
        (
            ValueError,
            r"pixels: want shape \(\*B, N, 2\), got \(200, 3\)",
            lambda: dp.back_project(pixels.new_zeros(200, 3), camera, plane),
        ),
        (
            ValueError,
            r"pixels: want shape \(\*B, N, 2\), got \(2,\)",
            lambda: dp.back_project(pixels[0], camera, plane),
        ),
        (
            TypeError,
            "plane: want torch.float64 as camera has",
            lambda: dp.back_project(pixels, camera, dp.Plane.z(torch.tensor(0.0))),
        ),
        (
            ValueError,
            "pixels: want device cpu as camera has, got meta",
            lambda: dp.back_project(pixels.to("meta"), camera, plane),
        ),
        (
            ValueError,
            "batch shapes do not broadcast",
            lambda: dp.back_project(pixels.expand(2, 200, 2), camera, dp.Plane(pixels.new_ones(3, 3), 0.0)),
        ),
        (
            ValueError,
            "the paper neglects the lens",
            lambda: dp.paper_route(
                pixels, dp.Camera(camera.K, distortion=dp.BrownConrady(torch.zeros(5, dtype=D))), plane
            ),
        ),
    ]
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()


def test_maps_one_after_the_other(camera: dp.Camera, pixels: Tensor) -> None:
    planes = dp.Plane([0.0, 0.0, 1.0], torch.tensor([0.0, 20.0, 50.0], dtype=D))
    maps = dp.PlaneMap(camera, planes)
    for one, plane in zip(maps, planes, strict=True):
        assert torch.equal(one(pixels)[0], dp.PlaneMap(camera, plane)(pixels)[0])
    with pytest.raises(TypeError, match="map: want a batch of maps to go through, got a single one"):
        list(dp.PlaneMap(camera, planes[0]))
    per_point = dp.Plane.per_point([0.0, 0.0, 1.0], torch.zeros(len(pixels), dtype=D))
    with pytest.raises(TypeError, match="map: want a batch of maps to go through, got planes per point"):
        list(dp.PlaneMap(camera, per_point))


def test_a_camera_without_a_pose_is_warned_of(camera: dp.Camera, pixels: Tensor) -> None:
    for lost in (camera.without_pose(), dp.Camera.stack([camera.without_pose()] * 2)):
        with pytest.warns(UserWarning, match=r"camera: want one with a pose.*calibration.cameras\[view\]"):
            _, valid = dp.back_project(pixels, lost, dp.Plane.z(0.0))
        assert not valid.any()
    dp.back_project(pixels, camera.without_pose(), dp.Plane.z(900.0))  # a wall in front of it
    dp.back_project(pixels, camera, dp.Plane.z(0.0))


@pytest.mark.parametrize("name", ["undistort", "unproject"])
def test_a_lens_derived_from_the_packages_own_has_the_last_word(name: str, camera: dp.Camera, pixels: Tensor) -> None:
    """In the map too, which has a short way through the lenses that it knows."""

    class Doubled(dp.BrownConrady):
        pass

    def doubled(lens: dp.BrownConrady, xy: Tensor) -> tuple[Tensor, Tensor]:
        found, valid = getattr(dp.BrownConrady, name)(lens, xy)
        return torch.cat([2 * found[..., :2], found[..., 2:]], dim=-1), valid

    setattr(Doubled, name, doubled)
    t = torch.tensor([0.0, 0, 500], dtype=camera.dtype)
    derived = dp.Camera(camera.K, t=t, distortion=Doubled(torch.zeros(5, dtype=camera.dtype)))
    points, _ = dp.back_project(pixels, derived, dp.Plane.z(0.0))
    torch.testing.assert_close(points, 2 * dp.back_project(pixels, dp.Camera(camera.K, t=t), dp.Plane.z(0.0))[0])
