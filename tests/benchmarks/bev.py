"""Feature maps of six cameras on the ground, as networks for bird's-eye views make them, against a grid by hand."""

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

import diffproj as dp

from .comparing import Comparison

BATCH, CAMERAS, CHANNELS, HEIGHT, WIDTH, CELLS = 4, 6, 32, 32, 88, 100


def comparisons(device: str = "cpu") -> Iterator[Comparison]:
    count = BATCH * CAMERAS
    features = torch.rand(count, CHANNELS, HEIGHT, WIDTH, device=device, requires_grad=True)
    K = torch.tensor([[80.0, 0, 43.5], [0, 80.0, 15.5], [0, 0, 1]])
    down = dp.rotation_from_euler(*torch.tensor([-2.0, 0.0, 0.0]))
    camera = dp.Camera(K.expand(count, 3, 3), down, torch.tensor([0.0, 1.5, 0.2]), size=(WIDTH, HEIGHT)).to(device)
    ground, extent, cell = dp.Plane.z(torch.zeros((), device=device)), (-25.0, -25.0, 25.0, 25.0), 50.0 / CELLS
    x = torch.linspace(-24.75, 24.75, CELLS, device=device)
    cells = torch.stack((*torch.meshgrid(x, x, indexing="xy"), torch.zeros(CELLS, CELLS, device=device)), dim=-1)
    center, half = torch.tensor([43.5, 15.5], device=device), torch.tensor([WIDTH / 2, HEIGHT / 2], device=device)

    def by_hand() -> Tensor:
        seen = cells @ camera.R.mT[:, None] + camera.t[:, None, None]
        uv = seen[..., :2] / seen[..., 2:].clamp_min(1e-3) * 80.0 + center
        grid = (uv + 0.5) / half - 1
        return torch.nn.functional.grid_sample(features, grid, align_corners=False)

    def ours() -> Tensor:
        return dp.rectify(features, camera, ground, extent, cell, samples=1)[0]

    which = "rectify(samples=1), six cameras, batch 4"
    if device == "cpu":
        yield Comparison(f"{which}, learning features", ours, by_hand, "grid by hand", 1.0, seconds=3.0)
    yield Comparison(
        f"{which}, both ways",
        lambda: _both(ours, features),
        lambda: _both(by_hand, features),
        "grid by hand",
        1.0,
        seconds=3.0,
    )
    size = 4 * count * CHANNELS * CELLS * CELLS
    yield Comparison(
        f"{which}, peak memory both ways", lambda: _both(ours, features), lambda: size, "output", 2.6, memory=True
    )


def _both(work: Callable[[], Tensor], features: Tensor) -> object:
    return torch.autograd.grad(work().sum(), features)
