"""The calls of `test_cuda.py`, and those of training, on the device of `device.py`; started by `test_elsewhere.py`.

They give what they give on the CPU, their tensors are there, and where a training step is not to wait for the device,
nothing is read from it.
"""

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

import diffproj as dp
from tests.elsewhere.device import NAME, Elsewhere, There, inner, register
from tests.test_cuda import CALLS as OF_CUDA
from tests.test_cuda import Scene, flat

pytestmark = pytest.mark.plain
D = torch.float64
BOARD = dp.Chessboard()
LONG = ("choose a lens", "calibrate robustly", "cross_validate", "bootstrap", "calibrate a fisheye", "landmarks")
READS = ("aten::_local_scalar_dense", "aten::equal", "aten::nonzero", "aten::_unique2")
"""What waits for a GPU."""


def plane_of_numbers(scene: Scene) -> list[Any]:
    plane = dp.Plane.z(2.0)
    found = dp.measure(scene.pixels[::9], scene.calibration, plane, view=0, pixel_sigma=0.5)
    alone = dp.measure(scene.pixels[::9], scene.camera, plane, pixel_sigma=0.5)
    points, _ = dp.back_project(scene.pixels, scene.camera, plane)
    return [
        found.points,
        found.covariance,
        alone.covariance,
        points,
        dp.PlaneProjector(scene.camera, plane).plane.normal,
    ]


def banks(scene: Scene) -> list[Any]:
    bank = dp.ProjectorBank([scene.camera, scene.fisheye, scene.pinhole], scene.plane, ("focal", "distortion", "pose"))
    bank = bank.to("cpu").to(scene.device)
    pixels, found = scene.views.pixels[:4], []
    for chosen in ([0, 1, 2, 2], torch.tensor([0, 1, 2, 2]), torch.tensor([0, 1, 2, 2], device=scene.device)):
        points, valid = bank(pixels, camera=chosen)
        loss = dp.PlaneLoss(dp.Huber(1.0), pull=2.0)(points, points.detach() + 1, valid, miss=bank.miss(pixels, chosen))
        found += [points, valid, *torch.autograd.grad(loss, list(bank.parameters()), allow_unused=True)]
    return [part for part in found if part is not None]


def batches(scene: Scene) -> list[Any]:
    found: list[Any] = []
    warp = torch.tensor([[1.1, 0.02, 3.0], [0.01, 0.95, -4.0], [0, 0, 1]], dtype=D, device=scene.device)
    for learn in ((), ("focal", "principal_point", "distortion", "pose", "plane"), ("pitch", "yaw", "roll", "height")):
        projector = dp.PlaneProjector(scene.calibration.cameras, scene.plane, learn)
        pixels = scene.views.pixels
        resolution, _ = projector.map().resolution(pixels)
        found += [projector(pixels), projector(pixels, warp=warp), projector.miss(pixels), resolution]
        found += [projector(pixels[:2], camera=[1, 0]), projector(pixels[:2], camera=torch.tensor([1, 0]))]
    return found


def learned_rig(scene: Scene) -> list[Any]:
    moments = torch.eye(3, dtype=D).expand(6, 3, 3), torch.zeros(6, 3, dtype=D)  # from a file, say
    rig = dp.LearnableRig({"a": scene.camera, "b": scene.fisheye}, moments=moments)
    cameras = rig()
    loss = torch.stack(
        [dp.image_residuals(camera, scene.views, BOARD)[0].square().mean() for camera in cameras.values()]
    )
    return list(torch.autograd.grad(loss.sum(), list(rig.parameters()), allow_unused=True))


def differentiable(scene: Scene) -> list[Any]:
    found: list[Any] = []
    robust: dict[str, Any] = {"priors": {"focal": (530.0, 2.0)}, "loss": dp.Huber(0.3)}
    several: list[dict[str, Any]] = [{"shape": "bow"}, robust]
    for options in several:
        pixels = scene.views.pixels[:4].clone().requires_grad_()
        views = dp.Views(pixels, scene.views.visible[:4], size=(640, 480))
        refined = dp.refine(views, BOARD, scene.calibration.camera, differentiable=True, **options)
        found += torch.autograd.grad(refined.camera.K.sum() + refined.cameras.t.sum(), pixels)
    return found


CALLS = OF_CUDA | {
    "plane of numbers": plane_of_numbers,
    "banks": banks,
    "batches": batches,
    "learned rig": learned_rig,
    "differentiable": differentiable,
}


@pytest.fixture(scope="module")
def device() -> torch.library.Library:
    return register()  # not when this file is imported, which those who look for doctests do


@pytest.fixture(autouse=True)
def _elsewhere(device: torch.library.Library) -> Iterator[None]:
    with Elsewhere():
        yield


@pytest.fixture(scope="module")
def scenes(device: torch.library.Library) -> tuple[Scene, Scene]:
    with Elsewhere():
        return Scene("cpu"), Scene(NAME)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in CALLS])
def test_a_call_gives_the_same_there(name: str, scenes: tuple[Scene, Scene]) -> None:
    here, there = (flat(CALLS[name](scene)) for scene in scenes)
    assert len(here) == len(there)
    for want, got in zip(here, there, strict=True):
        if isinstance(want, Tensor):
            assert isinstance(got, There)
            torch.testing.assert_close(inner(got).detach(), want.detach(), rtol=1e-6, atol=1e-7, equal_nan=True)
        else:
            assert got == pytest.approx(want)


class Reading(Elsewhere):
    """Notes what reads values from there."""

    def __init__(self) -> None:
        super().__init__()
        self.read: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func._schema.name in READS:
            self.read.append(func._schema.name)
        return super().__torch_dispatch__(func, types, args, kwargs)


@pytest.mark.parametrize("learn", [(), ("focal", "principal_point", "pose", "plane")])
def test_a_training_step_of_pinholes_does_not_wait(learn: tuple[str, ...], scenes: tuple[Scene, Scene]) -> None:
    scene = scenes[1]
    projector, pixels = dp.PlaneProjector(dp.stack([scene.pinhole] * 6), scene.plane, learn), scene.views.pixels
    ones, loss = torch.ones_like(pixels[..., 0]), dp.PlaneLoss(dp.Huber(1.0), pull=1.0)
    chosen = torch.tensor([5, 4, 3, 2, 1, 0], device=NAME)
    with Reading() as reading:
        for which in (None, chosen):
            points, valid = projector(pixels, camera=which)
            cost = loss(points, torch.zeros_like(points), valid, ones, ones, projector.miss(pixels, camera=which))
            if learn:
                cost.backward()
    assert reading.read == []
