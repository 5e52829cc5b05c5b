"""Thousands of landmarks, as of a laser scan: what is needed of them grows as they do, and not as their pairs."""

from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import diffproj as dp

COUNT = 4000


class Largest(TorchDispatchMode):
    """The number of elements of the largest tensor that is made."""

    def __init__(self) -> None:
        super().__init__()
        self.numel = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        sizes = [part.numel() for part in tree_leaves(made) if isinstance(part, torch.Tensor)]
        self.numel = max([self.numel, *sizes])
        return made


def scan(depth: float = 4.0) -> tuple[torch.Tensor, dp.Camera, dp.Views]:
    """Points of a building, or of its floor, the camera that sees them, and its pixels."""
    noise = torch.Generator().manual_seed(0)
    points = torch.rand(COUNT, 3, generator=noise, dtype=torch.float64) * torch.tensor(
        [10.0, 8, depth], dtype=torch.float64
    )
    K = torch.tensor([[1000.0, 0, 640], [0, 1000, 360], [0, 0, 1]], dtype=torch.float64)
    R = torch.tensor([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]], dtype=torch.float64)
    camera = dp.Camera(K, R, -R @ torch.tensor([22.0, 4, 2.5], dtype=torch.float64), size=(1280, 720))
    pixels = camera.project(points)[0]
    pixels = pixels + 0.3 * torch.randn(pixels.shape, generator=noise, dtype=torch.float64)
    return points, camera, dp.Views(pixels.unsqueeze(0), size=(1280, 720))


@pytest.mark.parametrize("depth", [4.0, 0.0], ids=["solid", "flat"])
def test_a_scan_is_located_without_a_table_of_all_pairs(depth: float) -> None:
    """The pose and what is said of it, and the largest tensor on the way to it."""
    points, camera, views = scan(depth)
    with Largest() as largest:
        found = dp.locate(views, dp.Landmarks(points), dp.Camera(camera.K, size=camera.size))
        assert found.message.startswith("converged")
    torch.testing.assert_close(found.cameras.center[0], camera.center, rtol=0, atol=5e-3)
    assert largest.numel < COUNT**2 / 2


@pytest.mark.parametrize("pair", [(3, 7), (5, 3990), (2500, 2501), (3998, 3999)])
def test_two_alike_among_thousands_are_named(pair: tuple[int, int]) -> None:
    """Wherever they stand, and to the bit: distances by products would leave some of them 1e-8 apart."""
    points, camera, views = scan()
    points[pair[1]] = points[pair[0]]
    with pytest.raises(ValueError, match=f"all distinct, got {COUNT} with {pair[0]} and {pair[1]} alike"):
        dp.locate(views, dp.Landmarks(points), dp.Camera(camera.K, size=camera.size))
