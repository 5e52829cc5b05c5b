"""Tags that do not stand as far apart as the board says: lengths are wrong, and hardly anything else is."""

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic

D = torch.float64
SAID = dp.AprilGrid(6, 6, tag=25.0, spacing=0.3)
TOLD = "of their side apart, not 0.3"
SIZE = (640, 480)


def camera() -> dp.Camera:
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
    lens = dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001], dtype=D))
    return dp.Camera(K, distortion=lens, size=SIZE)


def photographed(points: Tensor, views: int = 12, noise: float = 0.1, aside: float = 0.0) -> dp.Views:
    """Views of an AprilGrid whose tags' corners are at these points, by a camera so far aside."""
    posed = synthetic.random_cameras(camera(), SAID, views, seed=3)
    shift = torch.tensor([aside, 0, 0], dtype=D)
    pixels, valid = posed.at(posed.R, posed.t + shift).project(points)
    generator = torch.Generator().manual_seed(int(aside))
    inside = ((pixels > 0) & (pixels < torch.tensor(SIZE) - 1)).all(-1)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=D)
    return dp.Views(pixels, valid & inside, size=SIZE)


def of_spacing(spacing: float) -> Tensor:
    return dp.AprilGrid(6, 6, tag=25.0, spacing=spacing).points


@pytest.mark.parametrize("spacing", [0.04, 0.2, 0.29, 0.31, 0.5])
@pytest.mark.parametrize("views", [5, 12])
def test_another_spacing_is_told(spacing: float, views: int) -> None:
    found = dp.calibrate(photographed(of_spacing(spacing), views), SAID)
    told = float(found.remarks[0].partition("the tags stand ")[2].partition(" of their side")[0])
    assert abs(told - spacing) < 0.005
    assert TOLD in found.remarks[0]
    assert found.verdict.startswith("Weak: ")
    assert "the tags do not stand as far apart as the board says" in found.verdict


def test_sides_measured_with_their_rims_are_told_as_well() -> None:
    """What counts is how far apart they stand in their own sides: here a tag of 24.6 where 25 was said, each 32.5."""
    real = dp.AprilGrid(6, 6, tag=24.6, spacing=32.5 / 24.6 - 1).points
    found = dp.calibrate(photographed(real), SAID)
    assert f"the tags stand 0.321 {TOLD}" in found.remarks[0]


def test_free_points_tell_it_too() -> None:
    found = dp.calibrate(photographed(of_spacing(0.29)), SAID, shape="free")
    assert f"the tags stand 0.29 {TOLD}" in found.remarks[0]
    assert TOLD not in dp.calibrate(photographed(of_spacing(0.3)), SAID, shape="free").remarks[0]


def test_several_cameras_and_rigs_tell_it() -> None:
    points = of_spacing(0.29)
    views = [photographed(points), photographed(points, aside=40.0)]
    for one in dp.calibrate(views, SAID):
        assert TOLD in one.remarks[0]
    for shape in ("flat", "free"):
        rig = dp.calibrate_rig(dict(zip("ab", views, strict=True)), SAID, shape=shape)
        assert sum(TOLD in remark for remark in rig.remarks) == 2


@pytest.mark.parametrize("fault", ["none", "bent", "wide", "inside", "other lens"])
def test_nothing_else_is_taken_for_it(fault: str) -> None:
    """Corners drawn inside of their tags by .06 px are what blur and gamma do; some 100 px are between tags here."""
    points = SAID.points.clone()
    middle = points.mean(0)
    if fault == "bent":
        points[:, 2] += 1.5 * ((points[:, 0] - middle[0]) / middle[0]) ** 2
    if fault == "wide":
        points[:, 0] *= 1.005
    views = photographed(points)
    if fault == "inside":
        tags = views.pixels.unflatten(-2, (6, 2, 6, 2))
        off = tags.mean((2, 4), keepdim=True) - tags
        tags = tags + 0.06 * off.sign()
        views = dp.Views(tags.flatten(1, 4), views.visible, size=SIZE)
    lens = "none" if fault == "other lens" else "brown5"
    assert TOLD not in dp.calibrate(views, SAID, lens, throw=False).remarks[0]


def test_how_points_move_with_the_spacing() -> None:
    moves = dp.AprilGrid(3, 2, tag=7.0, spacing=0.3).by_spacing
    far, near = (dp.AprilGrid(3, 2, tag=7.0, spacing=s).points for s in (0.4, 0.2))
    torch.testing.assert_close(moves, (far - near) / 0.2)
