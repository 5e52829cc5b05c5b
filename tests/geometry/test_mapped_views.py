"""Top views and photographs of many cameras under `vmap`, where no values tell how many samples a pixel takes."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import diffproj as dp

D = torch.float64
K = torch.tensor([[50.0, 0, 32], [0, 51, 24], [0, 0, 1]], dtype=D)
T = torch.tensor([[1.0, 2, 80], [-2, 0, 95], [0, 0, 70]], dtype=D)
EXTENT = (-10.0, -10.0, 10.0, 6.0)


def top_view(image: Tensor, t: Tensor, **options: Any) -> Tensor:
    return dp.rectify(image, dp.Camera(K, t=t, size=(64, 48)), dp.Plane.z(0.0), EXTENT, 2.0, **options)[0]


def photograph(texture: Tensor, t: Tensor, **options: Any) -> Tensor:
    return dp.render(texture, dp.Camera(K, t=t), dp.Plane.z(0.0), EXTENT, size=(64, 48), **options)[0]


@pytest.mark.parametrize("call", [top_view, photograph])
def test_of_cameras_the_number_is_asked_for(call: Callable[..., Tensor]) -> None:
    """PyTorch spoke of data-dependent control flow."""
    images = torch.rand(3, 1, 48, 64, dtype=D)
    with pytest.raises(ValueError, match="samples: want how many a pixel takes, got None where no values say it"):
        torch.vmap(call)(images, T)
    for samples in (1, 2):
        mapped = torch.vmap(lambda image, t, n=samples: call(image, t, samples=n))(images, T)
        torch.testing.assert_close(mapped, call(images, T, samples=samples))
    torch.testing.assert_close(torch.vmap(lambda image: call(image, T[0]))(images), call(images, T[0]))
