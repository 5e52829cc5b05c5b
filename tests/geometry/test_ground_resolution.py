"""World units that a pixel covers: against finite differences, for every lens, and with gradients everywhere."""

import pytest
import torch
from torch import Tensor

import diffproj as dp

D = torch.float64
COEFFICIENTS = [-0.2, 0.05, 0.001, -0.001, 0.002, 0.01, 0.01, 0.001, 0.001, 0.002, 0.001, 0.002, 0.02, -0.03]


class Stereographic(dp.Lens):
    """A lens of another package: only what `dp.Lens` asks for, and 20 lines of it."""

    def __init__(self, scale: Tensor) -> None:
        self.scale = scale

    batch_shape = property(lambda self: self.scale.shape)
    dtype = property(lambda self: self.scale.dtype)
    device = property(lambda self: self.scale.device)
    domain = property(lambda self: torch.full_like(self.scale, 3.0))

    def project_direction(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        length = direction.norm(dim=-1, keepdim=True)
        xy = 2 * self.scale[..., None, None] * direction[..., :2] / (length + direction[..., 2:])
        return xy, torch.ones_like(xy[..., 0], dtype=torch.bool)

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        half = xy / (2 * self.scale[..., None, None])
        r2 = half.square().sum(-1, keepdim=True)
        return torch.cat([2 * half, 1 - r2], -1) / (1 + r2), torch.ones_like(xy[..., 0], dtype=torch.bool)

    def expand(self, *shape: int) -> "Stereographic":
        return Stereographic(self.scale.expand(shape))

    def to(self, *args: object, **kwargs: object) -> "Stereographic":
        return Stereographic(self.scale.to(*args, **kwargs))

    def detach(self) -> "Stereographic":
        return Stereographic(self.scale.detach())

    def __getitem__(self, index: object) -> "Stereographic":
        return Stereographic(self.scale[index])


def lens(name: str, dtype: torch.dtype = D) -> dp.Lens | None:
    if name == "none":
        return None
    if name == "fisheye":
        return dp.KannalaBrandt(torch.tensor([0.01, -0.02, 0.001, 0.0], dtype=dtype))
    if name == "other":
        return Stereographic(torch.tensor(1.0, dtype=dtype))
    return dp.BrownConrady(torch.tensor(COEFFICIENTS[: int(name)], dtype=dtype))


LENSES = ["none", "4", "5", "8", "12", "14", "fisheye", "other"]


def seen_through(name: str, K: Tensor) -> dp.Camera:
    angles = torch.tensor([2.7, 0.25, 0.4], dtype=D)
    return dp.Camera(K, dp.rotation_from_euler(*angles), torch.tensor([10.0, -20, 500], dtype=D), lens(name))


def pixels() -> Tensor:
    return torch.rand(7, 2, dtype=D) * torch.tensor([640.0, 480], dtype=D)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("plane", [dp.Plane.z(0.0), dp.Plane([0.1, 0.2, 1.0], 3.0)], ids=["level", "slanted"])
def test_the_larger_singular_value_of_the_points_derivative(name: str, plane: dp.Plane, K: Tensor) -> None:
    camera, uv = seen_through(name, K), pixels()
    found, valid = dp.ground_resolution(uv, camera, plane)
    assert bool(valid.all())
    step = 1e-3
    columns = [
        (dp.back_project(uv + e, camera, plane)[0] - dp.back_project(uv - e, camera, plane)[0]) / (2 * step)
        for e in step * torch.eye(2, dtype=D)
    ]
    want = torch.linalg.svdvals(torch.stack(columns, -1))[:, 0]
    torch.testing.assert_close(found, want, rtol=1e-8, atol=0)
    exact = torch.func.vmap(torch.func.jacrev(lambda p: dp.back_project(p[None], camera, plane)[0][0]))(uv)
    torch.testing.assert_close(found, torch.linalg.svdvals(exact)[:, 0], rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    "name", ["none", "5", *(pytest.param(name, marks=pytest.mark.slow) for name in ("14", "fisheye", "other"))]
)
def test_derivatives_to_second_order(name: str, K: Tensor) -> None:
    uv, R = pixels()[:1], seen_through(name, K).R

    def resolution(uv: Tensor, K: Tensor, t: Tensor) -> Tensor:
        return dp.ground_resolution(uv, dp.Camera(K, R, t, lens(name)), dp.Plane.z(0.0))[0]

    # K moves as focal lengths and principal point do: its last row is fixed.
    def of(uv: Tensor, intrinsics: Tensor, t: Tensor) -> Tensor:
        f_x, f_y, c_x, c_y = intrinsics
        zero, one = torch.zeros_like(f_x), torch.ones_like(f_x)
        rows = [torch.stack(row) for row in ([f_x, zero, c_x], [zero, f_y, c_y], [zero, zero, one])]
        return resolution(uv, torch.stack(rows), t)

    inputs = uv, torch.tensor([533.0, 534, 342, 235], dtype=D), torch.tensor([10.0, -20, 500], dtype=D)
    inputs = tuple(tensor.requires_grad_() for tensor in inputs)
    assert torch.autograd.gradcheck(of, inputs, rtol=1e-5, atol=1e-7, fast_mode=True)
    assert torch.autograd.gradgradcheck(of, inputs, rtol=1e-4, atol=1e-6, fast_mode=True)


@pytest.mark.parametrize("name", ["none", "5", "fisheye"])
def test_in_every_mode_and_transform(name: str, K: Tensor) -> None:
    camera, plane, uv = seen_through(name, K), dp.Plane.z(0.0), pixels()[:6]

    def of(uv: Tensor) -> Tensor:
        return dp.ground_resolution(uv, camera, plane)[0]

    want = of(uv)
    torch.testing.assert_close(torch.vmap(of)(uv.reshape(2, 3, 2)).flatten(), want, rtol=1e-13, atol=0)
    many = torch.vmap(lambda c: dp.ground_resolution(uv, c, plane)[0])(dp.Camera.stack([camera, camera]))
    torch.testing.assert_close(many, want.expand(2, -1), rtol=1e-13, atol=0)
    slopes = torch.func.jacrev(of)(uv).sum((1, 2))
    torch.testing.assert_close(torch.func.jvp(of, (uv,), (torch.ones_like(uv),))[1], slopes, rtol=1e-10, atol=1e-13)
    with torch.autograd.forward_ad.dual_level():  # forward mode of the caller's own
        dual = torch.autograd.forward_ad.make_dual(uv, torch.ones_like(uv))
        tangent = torch.autograd.forward_ad.unpack_dual(of(dual)).tangent
    torch.testing.assert_close(tangent, slopes, rtol=1e-10, atol=1e-13)
    with torch.inference_mode():
        torch.testing.assert_close(of(uv), want, rtol=1e-13, atol=0)
    assert dp.ground_resolution(uv.to("meta"), camera.to("meta"), dp.Plane.z(torch.zeros((), dtype=D)).to("meta"))


def test_expanded_pixels(camera: dp.Camera) -> None:
    one = torch.tensor([300.0, 200], dtype=D)
    many, _ = dp.ground_resolution(one.expand(5, 2), camera, dp.Plane.z(0.0))
    assert torch.equal(many, dp.ground_resolution(one[None], camera, dp.Plane.z(0.0))[0].expand(5))


@pytest.mark.parametrize("name", ["none", "5", "fisheye"])
def test_many_cameras_give_what_each_gives(name: str, K: Tensor) -> None:
    camera, uv = seen_through(name, K), pixels()
    scales = torch.tensor([1.0, 1.5, 0.7], dtype=D)
    cameras = camera.at(camera.R.expand(3, 3, 3), scales[:, None] * camera.t)
    together, _ = dp.ground_resolution(uv.expand(3, *uv.shape), cameras, dp.Plane.z(0.0))
    for k in range(3):
        torch.testing.assert_close(together[k], dp.ground_resolution(uv, cameras[k], dp.Plane.z(0.0))[0])


@pytest.mark.parametrize("name", ["none", "5", "fisheye"])
def test_gradients_straight_above_the_plane_and_where_there_is_none(name: str, K: Tensor) -> None:
    """Straight above all directions are alike, and the root of the difference of both has no slope."""
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D, requires_grad=True)
    camera = dp.Camera(K, t=torch.tensor([0.0, 0, 1000], dtype=D), distortion=lens(name))
    uv = torch.tensor([[320.0, 240], [torch.nan, 1], [1e300, 0], [torch.inf, 0]], dtype=D, requires_grad=True)
    found, valid = dp.ground_resolution(uv, camera, dp.Plane.z(0.0))
    torch.testing.assert_close(found[0], torch.tensor(2.0, dtype=D), rtol=1e-12, atol=0)
    assert valid.tolist() == [True, False, False, False]
    by_uv, by_K = torch.autograd.grad(found.sum(), [uv, K])
    assert torch.equal(by_uv[1:], torch.zeros(3, 2, dtype=D))
    assert bool(by_uv.isfinite().all() and by_K.isfinite().all())
    # Of f_x and f_y each stretches one direction: the mean of both takes half of it.
    torch.testing.assert_close(by_K.diagonal()[:2], torch.full((2,), -0.002, dtype=D), rtol=1e-9, atol=0)


@pytest.mark.parametrize("unit", [1e-15, 1e-6, 1e9, 1e15])
def test_any_unit_in_float32(unit: float) -> None:
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    camera = dp.Camera(K, t=torch.tensor([0.0, 0, 1000 * unit]))
    found, _ = dp.ground_resolution(torch.tensor([[320.0, 240], [100, 50]]), camera, dp.Plane.z(0.0))
    torch.testing.assert_close(found, torch.full((2,), 2 * unit), rtol=1e-6, atol=0)
