"""Rigs on landmarks that were surveyed with an error of their own, which all cameras at all moments share."""

from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

import diffproj as dp
from tests.calibration.rigs.rig_scenes import off_truth, rotation

D = torch.float64
SIZE = (1280, 960)
UTM = torch.tensor([500_000.0, 5_600_000.0, 30.0], dtype=D)


class Seen(NamedTuple):
    """A rig and what it sees; as the scenes of boards are."""

    views: dict[str, dp.Views]
    landmarks: dp.Landmarks
    points: Tensor
    cameras: dict[str, dp.Camera]


def covariances(count: int, level: bool) -> Tensor:
    """Landmarks off by centimetres, in directions of their own; the first is exact, the second exact in height."""
    root = 0.03 * torch.randn(count, 3, 3, dtype=D, generator=torch.Generator().manual_seed(5))
    root[0], root[1, 2] = 0, 0
    if level:
        root[:, 2] = 0
    return root @ root.mT


def scene(seed: int = 0, relief: float = 4.0, moments: int = 6, count: int = 14, noise: float = 0.5) -> Seen:
    """Two cameras, .8 m apart, that go around landmarks of UTM together."""
    random = torch.Generator().manual_seed(1)
    points = (torch.rand(count, 3, dtype=D, generator=random) - 0.5) * torch.tensor([10.0, 10, relief], dtype=D)
    angle = torch.linspace(-1.1, 1.1, moments, dtype=D)
    center = torch.stack([14 * angle.sin() + 1, -14 * angle.cos(), 5.0 + angle], dim=-1)
    z = torch.nn.functional.normalize(torch.tensor([0.5, 0.5, 0.0], dtype=D) - center, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0, -1], dtype=D).expand_as(z), z), dim=-1)
    R = torch.stack([x, torch.linalg.cross(z, x), z], dim=-2)
    t = -(R @ (center + UTM).unsqueeze(-1)).squeeze(-1)
    draw = torch.Generator().manual_seed(100 + seed)
    cameras, views = {}, {}
    for name, turn, at, f in (
        ("a", [0.0, 0, 0], [0.0, 0, 0], 1000.0),
        ("b", [0.02, -0.05, 0.1], [-0.8, 0.1, 0], 900.0),
    ):
        K = torch.tensor([[f, 0, 639.5], [0, f, 479.5], [0, 0, 1]], dtype=D)
        place = rotation(torch.tensor(turn, dtype=D)), torch.tensor(at, dtype=D)
        cameras[name] = dp.Camera(K, *place, size=SIZE)
        posed = cameras[name].at(place[0] @ R, (place[0] @ t.unsqueeze(-1)).squeeze(-1) + place[1])
        pixels, _ = posed.project(points + UTM)
        pixels = pixels + noise * torch.randn(pixels.shape, dtype=D, generator=draw)
        inside = ((pixels > 0) & (pixels < torch.tensor(SIZE, dtype=D) - 1)).all(-1)
        views[name] = dp.Views(pixels, inside, [str(i) for i in range(moments)], size=SIZE)
    spread = covariances(count, relief == 0)
    values, axes = torch.linalg.eigh(spread)
    off = (axes * values.clamp(min=0).sqrt().unsqueeze(-2)) @ torch.randn(count, 3, 1, dtype=D, generator=draw)
    return Seen(views, dp.Landmarks(points + UTM + off.squeeze(-1), sigma=spread), points + UTM, cameras)


OPTIONS: dict[str, Any] = {"distortion": "none", "fixed": ("principal_point",)}


def known(true: Seen) -> dict[str, Any]:
    """The options of landmarks on a plane, which from so few heights tell too little of the focal lengths."""
    return {"cameras": true.cameras, "fixed": ("intrinsics",)}


@pytest.mark.parametrize("weights", [None, 4.0])
def test_landmarks_are_found_along_with_the_rig(weights: float | None) -> None:
    true = scene()
    rig = dp.calibrate_rig(true.views, true.landmarks, weights=weights, **OPTIONS)
    assert rig.shape == "free"
    before, after = ((points - true.points).square().sum().sqrt() for points in (true.landmarks.points, rig.points))
    assert float(after) < 0.7 * float(before)
    assert torch.allclose(rig.points[0], true.landmarks.points[0], rtol=0, atol=1e-4)  # exact
    assert float((rig.points[1] - true.landmarks.points[1])[2].abs()) < 1e-4
    assert true.landmarks.covariances is not None
    said = true.landmarks.covariances.diagonal(dim1=-2, dim2=-1).sqrt()
    assert bool((rig.points_deviation <= said + 1e-4).all())
    named = dp.calibrate_rig(true.views, true.landmarks, shape="free", weights=weights, **OPTIONS)
    assert torch.equal(named.points, rig.points)
    exact = dp.Landmarks(true.landmarks.points)
    taken = dp.calibrate_rig(true.views, exact, weights=weights, **OPTIONS)
    assert taken.rms > 1.5 * rig.rms


@pytest.mark.slow
@pytest.mark.parametrize("relief", [4.0, 0.0])
@pytest.mark.parametrize("weights", [None, 4.0])
def test_errors_are_what_the_covariance_says(weights: float | None, relief: float) -> None:
    squares: dict[str, list[float]] = {"place": [], "f_x": [], "points": []}
    for seed in range(30):
        true = scene(seed, relief)
        options = OPTIONS if relief else known(true)
        rig = dp.calibrate_rig(true.views, true.landmarks, weights=weights, **options)
        off, C = off_truth(rig, true, "b"), rig.place_covariance("b")  # type: ignore[arg-type]
        squares["place"].append(float(off @ torch.linalg.solve(C, off)) / 6)
        for name in rig.names if relief else ():
            spread = rig[name].covariance.deviations["f_x"]
            squares["f_x"].append(float((rig.cameras[name].K[0, 0] - true.cameras[name].K[0, 0]) / spread) ** 2)
        deviation = rig.points_deviation
        loose = deviation > 1e-4
        squares["points"].append(float(((rig.points - true.points) / deviation)[loose].square().mean()))
    for what, values in squares.items():
        assert not values or sum(values) / len(values) == pytest.approx(1, abs=0.4), what
