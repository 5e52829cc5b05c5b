"""The kernel under `torch.compile(fullgraph=True)` and `torch.export`, also where the camera is built inside."""

import pytest
import torch
from torch import Tensor

import diffproj as dp

D = torch.float64


@pytest.fixture(autouse=True)
def _fresh() -> None:
    torch._dynamo.reset()


def project(
    K: Tensor, R: Tensor, t: Tensor, coefficients: Tensor | None, offset: Tensor, pixels: Tensor
) -> tuple[Tensor, Tensor]:
    lens = None if coefficients is None else dp.BrownConrady(coefficients)
    return dp.back_project(pixels, dp.Camera(K, R, t, lens), dp.Plane.z(offset))


@pytest.mark.parametrize("name", ["camera", "lens_camera"])
def test_camera_built_inside(name: str, pixels: Tensor, request: pytest.FixtureRequest) -> None:
    camera = request.getfixturevalue(name)
    coefficients = None if camera.distortion is None else camera.distortion.coefficients
    leaves = [part.clone().requires_grad_() for part in (camera.K, camera.R, camera.t)]
    arguments = (*leaves, coefficients, torch.tensor(3.0, dtype=D), pixels)
    want, want_valid = project(*arguments)
    points, valid = torch.compile(project, fullgraph=True)(*arguments)
    torch.testing.assert_close(points, want, rtol=0, atol=1e-9)
    assert torch.equal(valid, want_valid)
    gradients = torch.autograd.grad(points.square().sum(), leaves)
    for found, expected in zip(gradients, torch.autograd.grad(want.square().sum(), leaves), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("name", ["camera", "lens_camera"])
def test_camera_handed_in(name: str, pixels: Tensor, request: pytest.FixtureRequest) -> None:
    camera = request.getfixturevalue(name)
    plane = dp.Plane([0.0, 0.1, 1.0], 4.0)
    points, valid = torch.compile(dp.back_project, fullgraph=True)(pixels, camera, plane)
    want, want_valid = dp.back_project(pixels, camera, plane)
    torch.testing.assert_close(points, want, rtol=0, atol=1e-9)
    assert torch.equal(valid, want_valid)


def test_map_built_once_and_vmapped(camera: dp.Camera, pixels: Tensor) -> None:
    to_plane = dp.PlaneMap(camera, dp.Plane.z(0.0))
    compiled = torch.compile(torch.func.vmap(lambda pixels: to_plane(pixels)), fullgraph=True)
    points, _ = compiled(pixels.reshape(4, 50, 2))
    torch.testing.assert_close(points.flatten(0, 1), to_plane(pixels)[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["camera", pytest.param("lens_camera", marks=pytest.mark.slow)])
def test_ground_resolution(name: str, pixels: Tensor, request: pytest.FixtureRequest) -> None:
    camera, plane = request.getfixturevalue(name), dp.Plane.z(torch.tensor(3.0, dtype=D))

    class Resolution(torch.nn.Module):
        def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
            return dp.ground_resolution(pixels, camera, plane)

    want, want_valid = Resolution()(pixels)
    for form in (torch.compile(Resolution(), fullgraph=True), torch.export.export(Resolution(), (pixels,)).module()):
        found, valid = form(pixels)
        torch.testing.assert_close(found, want, rtol=1e-12, atol=0)
        assert torch.equal(valid, want_valid)
