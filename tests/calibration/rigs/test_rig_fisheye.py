"""Rigs of fisheyes that see half of all directions: no term of theirs is held, and their deviations hold the truth."""

import math

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj.geometry.cayley import turned
from diffproj.lens.models import MODELS, Model

D = torch.float64
BOARD = dp.Chessboard(9, 6, 60.0)
LENS = dp.KannalaBrandt(torch.tensor([-0.02, 0.005, -0.002, 0.0002], dtype=D))


def rotation(vectors: Tensor) -> Tensor:
    return turned(torch.eye(3, dtype=D).expand(*vectors.shape[:-1], 3, 3), vectors)


def pair(seed: int, moments: int = 24) -> tuple[dict[str, dp.Camera], dict[str, dp.Views]]:
    """Two cameras of 200 degrees side by side, and boards all around up to 65 degrees off their axes."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=draw, dtype=D)

    K = torch.tensor([[286.0, 0, 506], [0, 289, 494], [0, 0, 1]], dtype=D)
    one = dp.Camera(K, distortion=LENS, size=(1000, 1000))
    R = rotation(torch.tensor([-0.003, -0.14, 0.0], dtype=D))
    cameras = {"one": one, "two": one.at(R, -R @ torch.tensor([300.0, 20, -15], dtype=D))}
    off, around = uniform(0, 1.15, moments), uniform(0, 2 * math.pi, moments)
    toward = torch.stack([off.sin() * around.cos(), off.sin() * around.sin(), off.cos()], dim=-1)
    axis = torch.stack([-around.sin(), around.cos(), torch.zeros_like(off)], dim=-1)
    R = rotation(2 * (off / 2).tan().unsqueeze(-1) * axis) @ rotation(uniform(-0.5, 0.5, moments, 3))
    t = toward * uniform(500, 1200, moments, 1) + torch.tensor([150.0, 0, 0], dtype=D) - R @ BOARD.points.mean(0).to(D)
    views = {}
    for name, camera in cameras.items():
        seen = camera.at(camera.R @ R, (camera.R @ t.unsqueeze(-1)).squeeze(-1) + camera.t)
        pixels, visible = seen.project(BOARD.points)
        pixels = pixels + 0.2 * torch.randn(pixels.shape, generator=draw, dtype=D)
        names = [f"moment {m}" for m in range(moments)]
        views[name] = dp.Views(pixels, visible & camera.in_image(pixels), names, size=camera.size)
    return cameras, views


@pytest.mark.parametrize("seed", [2, 3])
def test_the_fourth_term_of_a_fisheye_is_none_below_a_line(seed: int) -> None:
    """It is called k4 as one of a rational lens is, and was held, with a deviation of 0, in 13 of 30 such rigs."""
    _, views = pair(seed)
    rig = dp.calibrate_rig(views, BOARD, "fisheye")
    assert not any("k4" in remark for remark in rig.remarks)
    for name in rig:
        found, deviation = rig.cameras[name].distortion, float(rig[name].covariance.deviations["k4"])
        assert isinstance(found, dp.KannalaBrandt)
        assert 1e-5 < deviation < 1e-3
        assert abs(float(found.coefficients[3] - LENS.coefficients[3])) < 3 * deviation


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
def test_only_rational_lenses_have_terms_below_the_line(model: Model) -> None:
    assert model.below == (("k4", "k5", "k6") if model.count >= 8 else ())
