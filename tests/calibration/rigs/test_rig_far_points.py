"""Points whose rays are nearly parallel: that their deviations mislead is told, and of all others they hold the truth."""

from collections.abc import Callable

import pytest
import torch

import diffproj as dp
from diffproj.calibration.rigs.curved import BENT, curved

D = torch.float64
SIGMA = 0.3


@pytest.fixture(scope="module")
def rig() -> dp.RigCalibration:
    """Two cameras 83 mm apart, of 534 px: deviations at 2 m are 2 % of the distance, at 10 m 11 %."""
    return dp.calibrate_rig({name: dp.example_views(name) for name in ("left", "right")}, dp.Chessboard())


def found_at(rig: dp.RigCalibration, distance: float, count: int = 1000) -> tuple[dp.Triangulation, torch.Tensor]:
    draw = torch.Generator().manual_seed(int(distance))
    place = torch.tensor([[0.1, 0.05, 1.0]], dtype=D).expand(count, 3) * distance
    noise = {name: SIGMA * torch.randn(count, 2, generator=draw, dtype=D) for name in rig}
    pixels = {name: camera.project(place)[0] + noise[name] for name, camera in rig.cameras.items()}
    return rig.triangulate(pixels, pixel_sigma=SIGMA), place


@pytest.mark.parametrize(("distance", "far"), [(300.0, 0.0), (2000.0, 0.0), (10_000.0, 1.0), (1_000_000.0, 1.0)])
def test_far_points_are_told(rig: dp.RigCalibration, distance: float, far: float) -> None:
    """At 1 km, 37 % of the intervals of the points that are valid hold the truth: the others end before it."""
    found, place = found_at(rig, distance)
    told, valid = found.nonlinear, found.valid
    assert float(told[valid].double().mean()) == far
    assert not told[~valid].any()
    off = (found.points - place)[:, 2] / found.deviations[:, 2]
    held = float((off[valid].abs() < 1.96).double().mean())
    assert 0.93 < held < 0.97 if far == 0 else held < 0.97
    if distance == 1_000_000.0:
        assert held < 0.5
        assert (off[valid] < 1.96).all()
    assert found.to_dict()["nonlinear"] == told.tolist()
    assert ("nonlinear" in repr(found)) == (far > 0)


def _pixel(camera: dp.Camera) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda place: camera.project(place[None])[0][0]


def test_of_two_pinholes_it_is_the_step_over_the_distance() -> None:
    """And with any unit of length."""
    for unit in (1.0, 1000.0):
        K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D)
        side = torch.tensor([-0.1 * unit, 0, 0], dtype=D)
        cameras = {"one": dp.Camera(K), "two": dp.Camera(K, t=side)}
        X = torch.tensor([[0.0, 0, 10 * unit]], dtype=D).expand(3, 3)
        part = torch.tensor([0.95, 1.05, 2.0], dtype=D) * BENT / (1 + BENT) / 1.96
        deviation = part * 10 * unit
        spread = torch.diag_embed(torch.stack([1e-12 * deviation, 1e-12 * deviation, deviation], dim=-1).square())
        J = torch.cat([torch.autograd.functional.jacobian(_pixel(one), X[0]) for one in cameras.values()])
        weights = dict.fromkeys(cameras, torch.ones(3, 1, 1, dtype=D))
        told = curved(cameras, X, weights, J.expand(3, 4, 3), spread)
        assert told.tolist() == [False, True, True]
