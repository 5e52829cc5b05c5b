"""Numbers at the ends of the floating-point range: values stay finite, and no gradient becomes NaN."""

import itertools
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import diffproj as dp

BROWN = [-0.2, 0.05, 0.001, -0.001, 0.002, 0.01, 0.01, 0.001, 0.001, 0.002, 0.001, 0.002, 0.02, -0.03]
FISHEYE = [0.01, -0.02, 0.001, 0.0]


def ends(dtype: torch.dtype) -> list[float]:
    limits = torch.finfo(dtype)
    powers = [limits.max**power for power in (0.1, 0.3, 0.45, 0.5, 0.52, 0.8, 0.97)]
    signed = [sign * size for size in [*powers, limits.max, 1.0, 1e3] for sign in (-1, 1)]
    return [*signed, 0.0, limits.tiny, math.sqrt(limits.tiny), math.nan, math.inf, -math.inf]


def leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().clone().requires_grad_()


@pytest.mark.parametrize("frontal", [True, False], ids=["frontal", "slanted"])
@pytest.mark.parametrize("name", ["none", "brown5", "brown14", "fisheye"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_values_and_gradients_are_numbers(dtype: torch.dtype, name: str, frontal: bool) -> None:
    K = leaf(torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], dtype=dtype))
    angles = torch.tensor([0.0, 0, 0] if frontal else [0.5, 0.2, 0.1], dtype=dtype)
    R, t = leaf(dp.rotation_from_euler(*angles)), leaf(torch.tensor([0.0, 0, 1000], dtype=dtype))
    normal, offset = leaf(torch.tensor([0.0, 0, 1], dtype=dtype)), leaf(torch.zeros((), dtype=dtype))
    numbers = {"brown5": BROWN[:5], "brown14": BROWN, "fisheye": FISHEYE}.get(name)
    coefficients = leaf(torch.tensor(numbers or [0.0], dtype=dtype))
    kind = dp.KannalaBrandt if name == "fisheye" else dp.BrownConrady
    camera = dp.Camera(K, R, t, kind(coefficients) if numbers else None)
    plane = dp.Plane(normal, offset)
    pixels = torch.tensor(list(itertools.product(ends(dtype), repeat=2)), dtype=dtype)
    points = torch.tensor(list(itertools.product(ends(dtype), [0.0, 1e3], ends(dtype))), dtype=dtype)
    calls: list[tuple[Callable[[Tensor], tuple[Tensor, ...]], Tensor]] = [
        (camera.project, points),
        (camera.directions, pixels),
        (camera.rays, pixels),
        (lambda p: dp.back_project(p, camera, plane), pixels),
        (lambda p: dp.ground_resolution(p, camera, plane), pixels),
    ]
    for call, given in calls:
        given = leaf(given)
        found = [tensor for tensor in call(given) if tensor.is_floating_point()]
        assert all(bool(tensor.isfinite().all()) for tensor in found)
        inputs = [given, K, R, t, normal, offset, coefficients]
        slopes = torch.autograd.grad(sum(tensor.sum() for tensor in found), inputs, allow_unused=True)
        assert not any(bool(slope.isnan().any()) for slope in slopes if slope is not None)


def test_nan_among_the_points_does_not_reach_the_camera() -> None:
    K = torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], dtype=torch.float64)
    points = torch.tensor([[1.0, 2, 10], [math.nan, 0, 1], [math.inf, 0, 1]], dtype=torch.float64)
    slopes = []
    for given in (points, points[:1]):
        R = torch.eye(3, dtype=torch.float64, requires_grad=True)
        pixels, valid = dp.Camera(K, R).project(given)
        assert valid.tolist() == [True, False, False][: len(given)]
        slopes.append(torch.autograd.grad(pixels.sum(), R)[0])
    assert torch.equal(*slopes)
