"""What training code does to modules beside stepping: parametrisations, averages, recomputation, ensembles."""

import copy

import pytest
import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize
from torch.optim.swa_utils import AveragedModel, get_ema_avg_fn, get_ema_multi_avg_fn, get_swa_multi_avg_fn
from torch.utils.checkpoint import checkpoint

import diffproj as dp

EVERY = ("focal", "principal_point", "distortion", "pose", "plane")


class Halved(nn.Module):
    def forward(self, value: Tensor) -> Tensor:
        return value / 2

    def right_inverse(self, value: Tensor) -> Tensor:
        return 2 * value


@pytest.fixture
def learned(lens_camera: dp.Camera) -> dp.PlaneProjector:
    return dp.PlaneProjector(lens_camera, dp.Plane.z(0.0), EVERY)


def gradients(projector: dp.PlaneProjector, pixels: Tensor) -> list[Tensor]:
    projector.zero_grad()
    projector(pixels)[0].square().sum().backward()
    return [parameter.grad for parameter in projector.parameters() if parameter.grad is not None]


def test_gradients_reach_parametrised_parameters(learned: dp.PlaneProjector, pixels: Tensor) -> None:
    want = gradients(learned, pixels)
    assert isinstance(learned.geometry.camera, dp.LearnableCamera)
    for module in (learned.geometry.camera, learned.geometry.plane):
        for name in list(module._parameters):
            parametrize.register_parametrization(module, name, Halved())
    found = gradients(learned, pixels)
    assert len(found) == len(want)
    for half, whole in zip(found, want, strict=True):
        torch.testing.assert_close(2 * half, whole)
    frozen = learned.requires_grad_(False)
    before, _ = frozen(pixels)
    with torch.no_grad():
        frozen.geometry.camera.parametrizations.rotation.original.add_(0.02)
    assert not torch.allclose(frozen(pixels)[0], before)


@pytest.mark.parametrize("learn", [(), EVERY])
def test_an_average_of_one_network_is_that(learn: tuple[str, ...], lens_camera: dp.Camera, pixels: Tensor) -> None:
    """A lens without a fold reaches to infinity, of which an average would be NaN."""
    endless = dp.BrownConrady(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0], dtype=lens_camera.dtype))
    assert endless.domain == torch.inf
    camera = dp.Camera(lens_camera.K, lens_camera.R, lens_camera.t, endless, lens_camera.size)
    projector = dp.PlaneProjector(camera, dp.Plane.z(0.0), learn)
    assert projector.camera.distortion.domain == torch.inf
    average = AveragedModel(projector, use_buffers=True)
    for _ in range(3):
        average.update_parameters(projector)
    for found, want in zip(average(pixels), projector(pixels), strict=True):
        assert torch.equal(found, want)
    assert average.module.camera.distortion.domain == torch.inf


@pytest.mark.parametrize(
    "options",
    [
        {"multi_avg_fn": get_ema_multi_avg_fn(0.9)},
        {"avg_fn": get_ema_avg_fn(0.9)},
        {"multi_avg_fn": get_swa_multi_avg_fn()},
    ],
)
def test_averages_know_which_cameras_they_are_of(options: dict, lens_camera: dp.Camera, pixels: Tensor) -> None:
    """Of whole numbers a moving average cuts off what is behind the point: 0.9 * 6 + 0.1 * 6 is 5."""
    fisheye = dp.KannalaBrandt(torch.tensor([0.01, -0.002, 0, 0], dtype=lens_camera.dtype))
    seen = dp.Camera(lens_camera.K, lens_camera.R, lens_camera.t, fisheye, (641, 479))
    many = [seen.shifted([5.0 * k, 0, 0]) for k in range(8)]
    for learn in ((), ("focal",)):
        bank = dp.ProjectorBank([lens_camera, *many], dp.Plane.z(0.0), learn)
        rig = dp.LearnableRig({"left": seen, "right": many[1]}, learn)
        averages = [AveragedModel(module, use_buffers=True, **options) for module in (bank, rig)]
        for average, module in zip(averages, (bank, rig), strict=True):
            for _ in range(20):
                average.update_parameters(module)
            module.load_state_dict(average.module.state_dict())  # which is refused as another camera's
        each, samples = list(range(9)), pixels.expand(9, *pixels.shape)
        torch.testing.assert_close(averages[0](samples, each)[0], bank(samples, each)[0])


@pytest.mark.parametrize("reentrant", [True, False])
def test_a_forward_pass_that_is_done_again_has_the_same_gradients(
    reentrant: bool, learned: dp.PlaneProjector, pixels: Tensor
) -> None:
    want = gradients(learned, pixels)
    learned.zero_grad()
    points = checkpoint(lambda p: learned(p)[0], pixels.clone().requires_grad_(), use_reentrant=reentrant)
    points.square().sum().backward()
    for parameter, gradient in zip(learned.parameters(), want, strict=True):
        assert torch.equal(parameter.grad, gradient)


@pytest.mark.parametrize("learn", [(), EVERY])
def test_an_ensemble_by_vmap(learn: tuple[str, ...], lens_camera: dp.Camera, pixels: Tensor) -> None:
    members = [dp.PlaneProjector(lens_camera.shifted([5.0 * k, 0, 0]), dp.Plane.z(float(k)), learn) for k in range(3)]
    skeleton = copy.deepcopy(members[0])

    def call(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        return torch.func.functional_call(skeleton, (parameters, buffers), (pixels,))

    points, valid = torch.vmap(call)(*torch.func.stack_module_state(members))
    for k, member in enumerate(members):
        want, seen = member(pixels)
        torch.testing.assert_close(points[k], want, rtol=1e-9, atol=1e-9)
        assert torch.equal(valid[k], seen)


def test_what_is_built_in_inference_mode_learns(lens_camera: dp.Camera, pixels: Tensor) -> None:
    with torch.inference_mode():
        projector = dp.PlaneProjector(lens_camera, dp.Plane.z(0.0), EVERY)
        bank = dp.ProjectorBank([lens_camera], dp.Plane.z(0.0), EVERY)
        rig = dp.LearnableRig({"left": lens_camera, "right": lens_camera.shifted([5.0, 0, 0])})
    bank(pixels[None], camera=[0])[0].sum().backward()
    rig()["right"].project(torch.ones(1, 3, dtype=pixels.dtype))[0].sum().backward()
    assert len(gradients(projector, pixels)) == 7
    for module in (projector, bank, rig):
        assert not any(tensor.is_inference() for tensor in (*module.parameters(), *module.buffers()))
        assert any(parameter.grad is not None for parameter in module.parameters())
