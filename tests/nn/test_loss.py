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


HORIZON = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=D)
"""A camera that looks level along y, z up."""


@pytest.mark.parametrize("lens", [None, "brown", "fisheye"])
def test_what_misses_the_plane_is_pulled_back(lens: str | None, K: torch.Tensor) -> None:
    kinds = {
        "brown": dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.0], dtype=D)),
        "fisheye": dp.KannalaBrandt(torch.tensor([0.01, -0.002, 0, 0], dtype=D)),
    }
    camera = dp.Camera(K, HORIZON, torch.tensor([0.0, 1.5, 0], dtype=D), kinds.get(lens), (640, 480))
    projector = dp.PlaneProjector(camera, dp.Plane.z(0.0), ("focal", "pose", "plane"))
    sky = torch.rand(10, 2, dtype=D) * torch.tensor([640.0, 200], dtype=D)
    outside = torch.tensor([[9000.0, 200.0], [342.0, -9000.0]], dtype=D)
    pixels = torch.cat([sky, outside]).requires_grad_()
    points, valid = projector(pixels)
    assert not valid.any()
    loss, invalid, total = dp.PlaneLoss(pull=2.0).counted(
        points, torch.zeros_like(points), valid, miss=projector.miss(pixels)
    )
    assert (int(invalid), total) == (12, 12)
    gradients = torch.autograd.grad(loss, [pixels, *projector.parameters()])
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert (gradients[0].norm(dim=-1) > 0).all()
    assert (gradients[0][:10, 1] < 0).all()  # a step against it leads down, to the ground
    assert (
        projector.miss(pixels - 1e-1 * gradients[0] / gradients[0].norm(dim=-1, keepdim=True)) < projector.miss(pixels)
    ).all()
    assert torch.autograd.gradcheck(projector.miss, pixels)
    # Steps of an optimiser bring the sky to the ground.
    moved = sky.clone().requires_grad_()
    optimiser = torch.optim.Adam([moved], lr=20.0)
    for _ in range(16):
        optimiser.zero_grad()
        points, valid = projector(moved)
        dp.PlaneLoss(pull=1.0)(0 * points, torch.zeros_like(points), valid, miss=projector.miss(moved)).backward()
        optimiser.step()
    assert projector(moved)[1].all()


def test_the_pull_is_continuous_at_the_horizon(K: torch.Tensor) -> None:
    to_plane = dp.PlaneMap(dp.Camera(K, HORIZON, torch.tensor([0.0, 1.5, 0], dtype=D)), dp.Plane.z(0.0))
    steps = torch.tensor([-1e-3, -1e-6, 0.0, 1e-6, 1e-3], dtype=D)
    pixels = torch.stack([torch.full_like(steps, 342.0), 235.0 - steps], dim=-1)
    want = (steps / 534).atan().clamp_min(0)
    torch.testing.assert_close(to_plane.miss(pixels), want, rtol=1e-6, atol=1e-15)
    strange = torch.tensor([[torch.nan, 0], [torch.inf, 1], [1e300, 0], [342.0, -1e20]], dtype=D).requires_grad_()
    missed = to_plane.miss(strange)
    assert missed.isfinite().all()
    assert torch.autograd.grad(missed.sum(), strange)[0].isfinite().all()
    on_plane = dp.PlaneMap(dp.Camera(K, HORIZON), dp.Plane.z(0.0))
    assert (on_plane.miss(pixels) == 0).all()
    zenith = dp.PlaneMap(dp.Camera(K, t=torch.tensor([0.0, 0, 5], dtype=D)), dp.Plane.z(9.0))
    straight = torch.tensor([[342.0, 235.0]], dtype=D).requires_grad_()
    up = dp.PlaneMap(
        dp.Camera(K, torch.diag(torch.tensor([1.0, -1, -1], dtype=D)), torch.tensor([0.0, 0, -5], dtype=D)),
        dp.Plane.z(-9.0),
    )
    for to_plane in (zenith, up):
        missed = to_plane.miss(straight)
        assert torch.autograd.grad(missed.sum(), straight)[0].isfinite().all()


@pytest.mark.plain
def test_a_loss_that_pulls_asks_for_angles() -> None:
    points = torch.zeros(2, 3)
    with pytest.raises(ValueError, match="miss: want angles"):
        dp.PlaneLoss(pull=1.0)(points, points)
    with pytest.raises(ValueError, match="pull: want"):
        dp.PlaneLoss(pull=-1.0)
    nothing = dp.PlaneLoss(pull=1.0).counted(points[:0], points[:0], miss=torch.zeros(0))
    assert (nothing.loss.item(), nothing.invalid.item(), nothing.total) == (0, 0, 0)
