"""Gradients of `adjust` by the camera that it is given: what it holds, and what its priors are about."""

from typing import Any

import pytest
import torch

import diffproj as dp

D = torch.float64
MAST = dp.Camera.mounted(6.0, 22.0, roll_deg=2.0, heading_deg=30.0, fov_deg=70.0, size=(640, 480)).to(D)
POINTS = torch.tensor([[6.0, 10, 0], [8, 14, 0.5], [3, 12, 1], [3, 9, 0], [7, 20, 2], [1, 7, 0]], dtype=D)
LENS = torch.tensor([-0.1, 0.02, 0.001, -0.001], dtype=D)


def numbers(x: torch.Tensor, differentiable: bool, options: dict[str, Any]) -> torch.Tensor:
    """Pose, focal lengths and lens, of a camera with f_x, f_y, c_x, c_y and coefficients that much larger."""
    f_x, f_y, c_x, c_y = torch.stack([MAST.K[0, 0], 1.02 * MAST.K[1, 1], MAST.K[0, 2], MAST.K[1, 2]]) * (1 + x[:4])
    zero, one = torch.zeros_like(f_x), torch.ones_like(f_x)
    K = torch.stack([f_x, zero, c_x, zero, f_y, c_y, zero, zero, one]).reshape(3, 3)
    camera = dp.Camera(K, MAST.R, MAST.t, dp.BrownConrady(LENS * (1 + x[4:])), (640, 480))
    truth = dp.Camera(MAST.K, MAST.R, MAST.t, dp.BrownConrady(LENS), (640, 480))
    off = torch.tensor([[0.5, -0.3], [-0.2, 0.4], [0.1, 0.1], [-0.6, -0.4], [0.3, 0.2], [0.2, -0.5]], dtype=D)
    seen = dp.Seen(POINTS, truth.project(POINTS)[0] + off, 1.0)
    found = dp.adjust(camera.expand(2), seen, differentiable=differentiable, **options)[1].camera
    posed = dp.adjust(camera, seen, differentiable=differentiable, **options).cameras
    assert isinstance(found.distortion, dp.BrownConrady)
    parts = [posed.t[0], 100 * posed.R[0].flatten(), found.K[0, 0] / 100, found.K[1, 1] / 100, found.K[0, 2] / 100]
    return torch.cat([part.flatten() for part in (*parts, 10 * found.distortion.coefficients)])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"free": ("focal",)},
        {"free": ("focal",), "tied_focal": False},
        {"priors": {"focal": 5.0, "k1": 0.05}},
        {"priors": {"focal": (450.0, 5.0)}},
    ],
)
def test_gradients_by_the_camera(options: dict[str, Any]) -> None:
    """Where f_x and f_y keep the camera's ratio, that the ratio is the camera's was left out: off by all of it."""
    x = torch.zeros(8, dtype=D, requires_grad=True)
    found = numbers(x, True, options)
    slopes = torch.stack([torch.autograd.grad(part, x, retain_graph=True)[0] for part in found])
    direction = 1e-4 * torch.tensor([1.0, -2, 0.5, 1, -1, 3, 0.5, 1], dtype=D)
    numeric = (numbers(direction, False, options) - numbers(-direction, False, options)) / 2
    torch.testing.assert_close(slopes @ direction, numeric, rtol=1e-4, atol=1e-6 * float(numeric.abs().max()))


def test_second_derivatives_are_warned_of() -> None:
    seen = dp.Seen(POINTS, MAST.project(POINTS)[0].requires_grad_(), 1.0)
    height = dp.adjust(MAST, seen, differentiable=True).cameras.t.sum()
    with pytest.warns(UserWarning, match="create_graph: want False for the gradient of a minimum"):
        torch.autograd.grad(height, seen.pixels, create_graph=True)
