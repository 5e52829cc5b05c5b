"""Simulated rigs: cameras of 1280 x 960 px that look at a board together, with views missing."""

from typing import NamedTuple

import torch
from torch import Tensor

import diffproj as dp
from diffproj.geometry.cayley import turned

D = torch.float64


class Scene(NamedTuple):
    """A rig, and what its cameras see.

    Attributes:
        board: the target.
        views: by camera; the names of views are the moments'.
        cameras: the true ones, in the frame of the first.
        R, t: the target at each moment, in that frame.
    """

    board: dp.Chessboard
    views: dict[str, dp.Views]
    cameras: dict[str, dp.Camera]
    R: Tensor
    t: Tensor


def rotation(vectors: Tensor) -> Tensor:
    return turned(torch.eye(3, dtype=D).expand(*vectors.shape[:-1], 3, 3), vectors)


def scene(
    cameras: int = 3,
    moments: int = 15,
    missing: float = 0.3,
    noise: float = 0.2,
    unit: float = 1.0,
    outliers: float = 0.0,
    chain: bool = False,
    seed: int = 0,
) -> Scene:
    """A rig of cameras .2 to 1 m apart, of which each misses so many of the moments.

    Args:
        cameras: how many.
        moments: how many.
        missing: part of the views that are missing.
        noise: of the corners, in px.
        unit: of the world, in millimetres.
        outliers: part of the corners that are up to 30 px off.
        chain: no moment is seen by more than two neighbours.
        seed: of all draws.
    """
    draw = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=draw, dtype=D)

    board = dp.Chessboard(9, 6, 60.0 / unit)
    found: dict[str, dp.Camera] = {}
    for c in range(cameras):
        K = torch.eye(3, dtype=D)
        K[[0, 1], [0, 1]] = 1000 + uniform(-20, 20, 2)
        K[:2, 2] = torch.tensor([639.5, 479.5], dtype=D) + uniform(-15, 15, 2)
        lens = torch.tensor([-0.2, 0.08, 5e-4, -4e-4, -0.01], dtype=D) * uniform(0.9, 1.1, 5)
        across = 1000 * (c / max(cameras - 1, 1) - 0.5) * uniform(0.7, 1, 1)
        center = torch.cat([across, uniform(-100, 100, 2)]) / unit
        R = rotation(torch.cat([uniform(-0.05, 0.05, 1), (center[:1] * unit / 2000).atan(), uniform(-0.1, 0.1, 1)]))
        found[f"cam{c}"] = dp.Camera(K, R, -R @ center, dp.BrownConrady(lens), (1280, 960))
    first = found["cam0"]
    in_rig = {name: camera.at(R := camera.R @ first.R.T, camera.t - R @ first.t) for name, camera in found.items()}
    R = rotation(uniform(-0.6, 0.6, moments, 3) * torch.tensor([1, 1, 0.5], dtype=D))
    places = [uniform(-500, 500, moments), uniform(-350, 350, moments), uniform(1400, 2600, moments)]
    t = torch.stack(places, dim=-1) / unit - R @ board.points.mean(0).to(D)
    R, t = first.R @ R, (first.R @ t.unsqueeze(-1)).squeeze(-1) + first.t
    views = {}
    for c, (name, camera) in enumerate(in_rig.items()):
        seen = camera.at(camera.R @ R, (camera.R @ t.unsqueeze(-1)).squeeze(-1) + camera.t)
        pixels, visible = seen.project(board.points)
        pixels = pixels + noise * torch.randn(pixels.shape, generator=draw, dtype=D)
        off = uniform(0, 1, *visible.shape) < outliers
        pixels = torch.where(off.unsqueeze(-1), pixels + uniform(-30, 30, *pixels.shape), pixels)
        visible = visible & camera.in_image(pixels)
        there = uniform(0, 1, moments) >= missing
        if chain:
            there = torch.tensor([c in (m % (cameras - 1), m % (cameras - 1) + 1) for m in range(moments)])
        visible = visible & there.unsqueeze(-1)
        rows = (visible.sum(-1) >= 4).nonzero().flatten()
        names = [f"moment {int(row)}" for row in rows]
        views[name] = dp.Views(pixels[rows], visible[rows], names, size=(1280, 960))
    return Scene(board, views, in_rig, R, t)


def off_truth(rig: "dp.RigCalibration", scene: Scene, name: str) -> Tensor:
    """How far a camera's place in the rig is from the true one: omega and tau `(6,)`, as the covariance has them."""
    true = scene.cameras[name]
    turn = rig.cameras[name].R @ true.R.T
    axis = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return torch.cat([2 * axis / (1 + turn.trace()), rig.cameras[name].t - true.t])
