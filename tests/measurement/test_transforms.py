"""Measuring under the transforms of `torch.func`: derivatives work, and `vmap`, which hides values, is refused."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import diffproj as dp

D = torch.float64
K = torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], dtype=D)
PIXELS = torch.tensor([[300.0, 200], [400, 260], [350, 420]], dtype=D)
TABLE = dp.Plane.z(torch.tensor(0.0, dtype=D))


def camera(t: Tensor) -> dp.Camera:
    return dp.Camera(K, t=t, distortion=dp.BrownConrady(t.new_tensor([-0.2, 0.05, 0, 0])), size=(640, 480))


T = torch.tensor([10.0, 20, 800], dtype=D)


def measured(pixels: Tensor) -> Tensor:
    return dp.measure(pixels, camera(T), TABLE, pixel_sigma=0.5).lengths().deviation


def fused(pixels: Tensor) -> Tensor:
    found = [dp.measure(pixels + shift, camera(T + 5 * shift), TABLE, pixel_sigma=0.5) for shift in (0.0, 0.1)]
    return dp.fuse(found).points


@pytest.mark.parametrize("call", [measured, fused])
def test_derivatives_work_under_every_transform(call: Callable[[Tensor], Tensor]) -> None:
    want = torch.autograd.functional.jacobian(call, PIXELS)
    func = torch.func
    for transform in (func.jacrev, func.jacfwd):
        torch.testing.assert_close(transform(call)(PIXELS), want)
    along = (want * PIXELS).sum((-2, -1))
    torch.testing.assert_close(func.jvp(call, (PIXELS,), (PIXELS,))[1], along)
    torch.testing.assert_close(func.grad(lambda p: call(p).sum())(PIXELS), want.sum(tuple(range(want.ndim - 2))))
    assert func.hessian(lambda p: call(p).sum())(PIXELS).isfinite().all()
    torch.testing.assert_close(
        torch.vmap(lambda n: n * call(PIXELS))(T), T.reshape(3, *(1,) * (want.ndim - 2)) * call(PIXELS)
    )


MAPPED: dict[str, tuple[Callable[[Tensor], Any], Tensor]] = {
    "pixels": (measured, PIXELS.expand(2, 3, 2)),
    "fused": (fused, PIXELS.expand(2, 3, 2)),
    "camera": (lambda t: dp.measure(PIXELS, camera(t), TABLE, pixel_sigma=0.5).points, T.expand(2, 3)),
    "plane": (lambda z: dp.measure(PIXELS, camera(T), dp.Plane.z(z), pixel_sigma=0.5).points, T),
    "sigma": (lambda s: dp.measure(PIXELS, camera(T), TABLE, pixel_sigma=s).covariance, T),
    "plane's covariance": (
        lambda s: dp.measure(PIXELS, camera(T), TABLE, None, 0.5, s * torch.eye(4, dtype=D)).covariance,
        T,
    ),
    "gradients": (torch.func.grad(lambda pixels: measured(pixels).sum()), PIXELS.expand(2, 3, 2)),
}


@pytest.mark.parametrize("case", MAPPED)
def test_a_map_over_samples_is_refused(case: str) -> None:
    """PyTorch spoke of data-dependent control flow; `(*B, N, 2)` in one call is what is meant."""
    call, argument = MAPPED[case]
    with pytest.raises(ValueError, match=r"measure: want a call outside of vmap, .* take batch axes"):
        torch.vmap(call)(argument)
    with pytest.raises(ValueError, match=r"measure: want a call outside of vmap"):
        torch.func.grad(lambda x: torch.vmap(call)(x).sum())(argument)
