"""Corners that a robust loss holds for wrong, in a rig: told by camera, kept in files, and doubted where they are most."""

from pathlib import Path

import pytest
import torch

import diffproj as dp
from tests.calibration.rigs.rig_scenes import scene


@pytest.mark.parametrize("loss", [dp.Huber(0.5), dp.Cauchy(0.5)], ids=["huber", "cauchy"])
@pytest.mark.parametrize("weights", [None, {"cam0": 25.0, "cam1": 25.0}], ids=["plain", "weighted"])
def test_wrong_corners_are_told(loss: dp.Loss, weights: dict[str, float] | None, tmp_path: Path) -> None:
    right, true = scene(2, 12, missing=0.1, seed=1), scene(2, 12, missing=0.1, outliers=0.02, seed=1)
    rig = dp.calibrate_rig(true.views, true.board, loss=loss, weights=weights)
    for name in rig.names:
        off = (true.views[name].pixels - right.views[name].pixels).norm(dim=-1)
        wrong = (off > 2) & true.views[name].visible  # ten deviations of the noise
        told = rig[name].discounted
        assert told is not None
        assert int(wrong.sum()) >= 5
        assert bool(told[wrong].all())
        assert int((told & ~wrong).sum()) <= 1
        assert not bool((told & ~rig[name].used).any())
        assert torch.equal(rig[name].counting, rig[name].used & ~told)
    dp.save_camera(tmp_path / "rig.json", rig)
    again = dp.load(tmp_path / "rig.json")
    for name in rig.names:
        assert again[name].discounted.equal(rig[name].discounted)  # type: ignore[union-attr]


def test_without_a_loss_none_are() -> None:
    true = scene(2, 10, missing=0.1, seed=1)
    rig = dp.calibrate_rig(true.views, true.board, reject_outliers=True)
    assert all(rig[name].discounted is None for name in rig.names)


def test_a_view_whose_corners_are_mostly_wrong_is_doubted() -> None:
    true = scene(2, 12, missing=0.0, seed=1)
    one = true.views["cam1"]
    pixels = one.pixels.clone()
    draw = torch.Generator().manual_seed(0)
    pixels[2, ::3] += 4 * torch.randn(pixels[2, ::3].shape, generator=draw, dtype=torch.float64)
    pixels[2, 1::3] += 4 * torch.randn(pixels[2, 1::3].shape, generator=draw, dtype=torch.float64)
    views = true.views | {"cam1": dp.Views(pixels, one.visible, one.names, size=(1280, 960))}
    rig = dp.calibrate_rig(views, true.board, loss=dp.Cauchy(0.3))
    assert one.names[2] in rig["cam1"].doubts
    assert rig["cam0"].doubts == ""
    measured = dp.measure(one.pixels[2, :2], rig["cam1"], dp.Plane.z(0.0), one.names[2], 0.3)
    assert one.names[2] in measured.doubts
