"""`PlaneLoss`: its value, its gradients, and the ground resolution that it may divide by."""

import pytest
import torch

import diffproj as dp

D = torch.float64


def test_loss_counts_what_is_valid() -> None:
    points, target = torch.randn(3, 8, 3, dtype=D), torch.randn(3, 8, 3, dtype=D)
    valid, weights = torch.rand(3, 8) > 0.3, torch.rand(3, 8, dtype=D)
    resolution = 0.5 + torch.rand(3, 8, dtype=D)
    squared = (points - target).square().sum(-1)
    got = dp.PlaneLoss()(points, target, valid, weights, resolution)
    torch.testing.assert_close(got, (valid * weights * squared / resolution**2).sum() / 24)
    robust = dp.PlaneLoss(dp.Huber(1.0))(points, target, valid)
    torch.testing.assert_close(robust, (valid * dp.Huber(1.0).value(squared)).sum() / 24)
    poisoned = torch.where(valid.unsqueeze(-1), points, torch.nan).requires_grad_()
    value = dp.PlaneLoss(dp.Cauchy(1.0))(poisoned, target, valid, resolution=torch.where(valid, resolution, 0.0))
    gradient = torch.autograd.grad(value, poisoned)[0]
    assert gradient.isfinite().all()
    assert (gradient[~valid] == 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("behind_lens", [False, True])
def test_invalid_pixels_change_no_gradient_of_the_others(
    behind_lens: bool, dtype: torch.dtype, camera: dp.Camera, lens_camera: dp.Camera, pixels: torch.Tensor
) -> None:
    projector = dp.PlaneProjector((lens_camera if behind_lens else camera).to(dtype), dp.Plane.z(0.0), "pose")
    pixels = pixels.to(dtype)
    target = torch.zeros(len(pixels), 3, dtype=dtype)
    broken = torch.rand(len(pixels)) < 0.3
    wrong = pixels.clone()
    wrong[broken] = torch.tensor([torch.inf, 1e9], dtype=dtype)

    def gradient(pixels: torch.Tensor) -> torch.Tensor:
        pixels = pixels.clone().requires_grad_()
        points, valid = projector(pixels)
        return torch.autograd.grad(dp.PlaneLoss(dp.Huber(10.0))(points, target, valid), pixels)[0]

    assert torch.equal(gradient(pixels)[~broken], gradient(wrong)[~broken])
    assert (gradient(pixels)[broken] != 0).all()
    assert (gradient(wrong)[broken] == 0).all()


def test_ground_resolution_is_a_finite_difference(lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    plane = dp.Plane.z(0.0)
    got, valid = dp.ground_resolution(pixels, lens_camera, plane)
    angle = torch.linspace(0, torch.pi, 361, dtype=D)
    around = 1e-4 * torch.stack([angle.cos(), angle.sin()], dim=-1)
    for i in range(0, 200, 40):
        ahead, behind = (dp.back_project(pixels[i] + s * around, lens_camera, plane)[0] for s in (1, -1))
        torch.testing.assert_close(got[i], (ahead - behind).norm(dim=-1).amax() / 2e-4, rtol=1e-4, atol=0)
    assert valid.all()


def test_what_counts_nothing_and_what_does_not_fit() -> None:
    points, target = torch.rand(3, 3, requires_grad=True), torch.rand(3, 3)
    nothing = dp.PlaneLoss()(points[:0], target[:0])
    assert nothing.item() == 0
    assert torch.equal(torch.autograd.grad(nothing, points)[0], torch.zeros(3, 3))
    valid, weights = torch.tensor([True, True, False]), torch.tensor([1.0, 2, float("nan")])
    found = dp.PlaneLoss()(points, target, valid, weights)
    torch.testing.assert_close(found, ((points - target).square().sum(-1) * torch.tensor([1.0, 2, 0])).mean())
    assert bool(torch.autograd.grad(found, points)[0].isfinite().all())


@pytest.mark.plain
@pytest.mark.parametrize("name", ["valid", "weights", "resolution", "target"])
def test_shapes_that_stretch_the_points(name: str) -> None:
    points = torch.rand(4, 3, 3)
    given = {"target": points, "valid": None, "weights": None, "resolution": None}
    for shape in ((4, 1), (5, 4, 3), (2, 3)):
        wrong = torch.ones(*shape, dtype=torch.bool if name == "valid" else torch.float32)
        given[name] = wrong.unsqueeze(-1).expand(*shape, 3) if name == "target" else wrong
        if name == "target" and shape == (4, 1):
            continue  # one target for all points of a camera
        with pytest.raises(ValueError, match=f"{name}: want a shape that broadcasts to"):
            dp.PlaneLoss()(points, **given)
    with pytest.raises(TypeError, match="valid: want booleans"):
        dp.PlaneLoss()(points, points, torch.ones(4, 3))


@pytest.mark.parametrize(
    ("name", "values", "want"),
    [
        ("resolution", (0.0, -1.0, torch.nan, torch.inf), "positive finite numbers"),
        ("weights", (-1.0, torch.nan, torch.inf), "finite numbers that are not negative"),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_factors_that_cannot_be(name: str, values: tuple[float, ...], want: str, dtype: torch.dtype) -> None:
    points, target = torch.rand(2, 4, 3, dtype=dtype, requires_grad=True), torch.zeros(2, 4, 3, dtype=dtype)
    for value in values:
        factors = torch.ones(2, 4, dtype=dtype)
        factors[1, 2] = value
        with pytest.raises(ValueError, match=f"{name}: want {want} at the points that count, got {value:g}; `valid`"):
            dp.PlaneLoss()(points, target, **{name: factors})
        # Where the point does not count, neither does what it came with.
        valid = factors == 1
        got = dp.PlaneLoss()(points, target, valid, **{name: factors})
        torch.testing.assert_close(got, (points.square().sum(-1) * valid).mean())
        assert torch.autograd.grad(got, points)[0].isfinite().all()
    assert dp.PlaneLoss()(points, target, weights=torch.zeros(4, dtype=dtype)) == 0
