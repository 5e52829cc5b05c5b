"""Errors that all corners of a view share, as of a camera that is late: places hold them, and a remark names them."""

import math
from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj.calibration.rigs.common_errors import _not_negative
from diffproj.calibration.trust.dispersion import FEW_VIEWS
from tests.calibration.rigs.rig_scenes import Scene, off_truth, rotation, scene

D = torch.float64


def late(true: Scene, shift: float, *names: str, turn: float = 0.0, seed: int = 0) -> dict[str, dp.Views]:
    """The views, with all corners of each of some cameras' off by so many px (RMS), another way each time.

    And with the board turned about its middle by so many radians (standard deviation, about each axis).
    """
    draw, views = torch.Generator().manual_seed(10_000 + seed), dict(true.views)
    middle = true.board.points.to(D).mean(0)
    for name in names:
        one, camera = true.views[name], true.cameras[name]
        m = torch.tensor([int(moment.removeprefix("moment ")) for moment in one.names])
        before = camera.R @ true.R[m]
        place = (before @ middle) + (camera.R @ true.t[m].unsqueeze(-1)).squeeze(-1) + camera.t
        after = rotation(turn * torch.randn(len(m), 3, generator=draw, dtype=D)) @ before
        seen, moved = (camera.at(R, place - R @ middle).project(true.board.points)[0] for R in (before, after))
        pixels = one.pixels + moved - seen
        pixels = pixels + shift / math.sqrt(2) * torch.randn(len(one), 1, 2, generator=draw, dtype=D)
        views[name] = dp.Views(pixels, one.visible, one.names, size=(1280, 960))
    return views


def squares(rig: dp.RigCalibration, true: Scene) -> list[float]:
    """Errors of the places, squared, in units of their covariance: 1 in the mean."""
    found = []
    for name in rig.names[1:]:
        off, C = off_truth(rig, true, name), rig.place_covariance(name)
        found.append(float(off @ torch.linalg.solve(C, off)) / 6)
    return found


def said(rig: dp.RigCalibration) -> list[str]:
    return [remark for remark in rig.remarks if "all corners of a view together" in remark]


@pytest.mark.slow
def test_places_hold_that_a_camera_is_late() -> None:
    found, moved = [], []
    for seed in range(16):
        true = scene(2, 12, missing=0.1, seed=seed)
        rig = dp.calibrate_rig(late(true, 0.2, "cam1", seed=seed), true.board)
        found += squares(rig, true)
        moved += [float(remark.split(" px")[0][-4:]) for remark in said(rig)]
    # Measured over 200 rigs: 1.09, and 92 % of the baselines in their intervals; 3.4 and 80 % without. Of these 16: 0.91,
    # and 13 remarks that say .15 to .32 px.
    assert sum(found) / len(found) == pytest.approx(0.91, abs=0.05)
    assert 12 <= len(moved) <= 14
    assert all(0.14 < px < 0.34 for px in moved)


@pytest.mark.slow
def test_places_hold_that_a_turning_board_is_seen_late() -> None:
    found, focal, named = [], [], 0
    for seed in range(16):
        true = scene(2, 15, missing=0.1, seed=seed)
        rig = dp.calibrate_rig(late(true, 0.0, "cam1", turn=0.0016, seed=seed), true.board)  # .2 px at the edge
        found += squares(rig, true)
        focal += [
            float((rig.cameras[name].K[0, 0] - true.cameras[name].K[0, 0]) / rig[name].covariance.deviations["f_x"])
            for name in rig.names
        ]
        named += len(said(rig))
    # Measured over 40 rigs: 0.94 and 1.09; 2.3 and 1.34 without. Of these 16: 1.09 and 1.06, and each has the remark.
    assert sum(found) / len(found) == pytest.approx(1.09, abs=0.05)
    assert float(torch.tensor(focal).square().mean().sqrt()) == pytest.approx(1.06, abs=0.05)
    assert named >= 15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cameras", "moments", "shift", "names"),
    [
        (2, 12, 0.0, ()),
        (2, 12, 0.2, ("cam1",)),
        (2, 20, 0.5, ("cam1",)),
        (4, 15, 0.2, ("cam0",)),
        (4, 15, 0.2, ("cam0", "cam1", "cam2", "cam3")),
    ],
)
def test_places_scatter_as_their_covariance_says(
    cameras: int, moments: int, shift: float, names: tuple[str, ...]
) -> None:
    chi, bases = [], []
    for seed in range(60 if cameras == 2 else 24):
        true = scene(cameras, moments, missing=0.1, seed=seed)
        rig = dp.calibrate_rig(late(true, shift, *names, seed=seed), true.board)
        chi += squares(rig, true)
        for name in rig.names[1:]:
            length, deviation = rig.baseline("cam0", name)
            bases.append(abs(length - float(true.cameras[name].center.norm())) / deviation)
        if not names:
            assert not said(rig)
    # Measured: .9 to 1.2 and, with 200 rigs of a kind, 92 to 97 % (52 of these 60 with .2 px); without, 3.3 to 7.7 and 60
    # to 85 % where some are late.
    assert 0.75 < sum(chi) / len(chi) < 1.35
    assert sum(base < 1.96 for base in bases) > 0.85 * len(bases)


def test_the_late_one_of_four_is_named() -> None:
    true = scene(4, 15, missing=0.1, seed=1)
    rig = dp.calibrate_rig(late(true, 0.2, "cam2"), true.board)
    (remark,) = said(rig)
    assert remark.startswith("cam2 sees the target 0.")
    before = dp.calibrate_rig(true.views, true.board)
    assert not said(before)
    for name, measured in (("cam1", 1.31), ("cam2", 2.36), ("cam3", 1.27)):  # 1 without
        ratio = rig.place_covariance(name).diagonal().sqrt() / before.place_covariance(name).diagonal().sqrt()
        assert float(ratio.square().mean().sqrt()) == pytest.approx(measured, rel=0.05)
    every = dp.calibrate_rig(late(true, 0.4, *true.views), true.board)
    assert said(every)[0].count(" by 0.") >= 3
    # A moment's own pose is as uncertain as that makes it: its variances, measured, by 19.
    widened = every.covariance.poses.diagonal(dim1=-2, dim2=-1) / before.covariance.poses.diagonal(dim1=-2, dim2=-1)
    assert float(widened.median()) == pytest.approx(19.2, rel=0.1)


def test_the_shift_itself_is_found() -> None:
    """Two cameras tell the sum of their variances: half of it stands at each."""
    told = []
    for seed in range(12):
        true = scene(2, 20, missing=0.0, seed=seed)
        rig = dp.calibrate_rig(late(true, 0.3, "cam0", seed=seed), true.board)
        told.append(rig._covariance.common.variance[:, 0])  # type: ignore[union-attr]
    mean = torch.stack(told).mean(0)
    # It counts more where few moments tell it. The mean of 12 is known to 10 %; measured is 1.056 times as much.
    assert float(mean.sum()) == pytest.approx(0.3**2 / 2 * (1 + FEW_VIEWS / 19), rel=0.1)
    assert float(mean[0]) == pytest.approx(float(mean[1]), rel=0.02)


@pytest.mark.parametrize("loss", [dp.Huber(0.1), dp.Cauchy(0.2)], ids=["huber", "cauchy"])
def test_noise_alone_is_nothing_in_common_whatever_the_loss(loss: dp.Loss) -> None:
    """A loss lowers the curvature by its mean slope, and the variance of the scores by another factor."""
    true = scene(2, 20, missing=0.0, seed=1)
    rig = dp.calibrate_rig(true.views, true.board, loss=loss)
    common = rig._covariance.common  # type: ignore[union-attr]
    # Measured: 2.9 and 2.4 deviations of chance; with the scores' variance not over the bend, 15.8 and 17.0.
    assert common is None or common.beyond < 3.5


def test_remarks_keep_no_panel() -> None:
    """Also where nothing is found in common, and no covariance asked for."""
    true = scene(2, 12, missing=0.1, seed=0)
    rig = dp.calibrate_rig(true.views, true.board)
    assert not said(rig)
    groups = rig._covariance.found.problem.groups  # type: ignore[union-attr]
    assert all("_panel" not in vars(group.reprojection) for group in groups)


@pytest.mark.parametrize(
    "options",
    [
        {"shape": "free", "priors": {"points": 0.5}},
        {"shape": "bow"},
        {"loss": dp.Huber(0.5)},
        {"weights": {"cam0": 4.0, "cam1": 2.0}},
        {"reject_outliers": True},
    ],
    ids=lambda options: next(iter(options)),
)
def test_whatever_is_fitted(options: dict[str, Any]) -> None:
    true = scene(2, 14, missing=0.1, seed=3)
    before, after = (dp.calibrate_rig(late(true, shift, "cam1"), true.board, **options) for shift in (0.0, 0.4))
    assert said(after)
    assert not said(before)
    assert after.baseline("cam0", "cam1").deviation > 1.5 * before.baseline("cam0", "cam1").deviation
    assert bool((torch.linalg.eigvalsh(after.place_covariance("cam1")) > 0).all())


def test_with_a_rig_that_is_held() -> None:
    """Nothing moves the places; the target's poses know less."""
    true = scene(2, 14, missing=0.1, seed=3)
    known: dict[str, Any] = {"cameras": true.cameras, "fixed": ("rig", "intrinsics")}
    before, after = (dp.calibrate_rig(late(true, shift, "cam1"), true.board, **known) for shift in (0.0, 0.4))
    assert float(after.place_covariance("cam1").abs().amax()) == 0
    assert not said(after)
    widened = after.covariance.poses.diagonal(dim1=-2, dim2=-1) / before.covariance.poses.diagonal(dim1=-2, dim2=-1)
    assert float(widened.median()) > 2


def test_corners_without_noise_have_nothing_in_common() -> None:
    true = scene(2, 12, missing=0.1, noise=0.0, seed=1)
    rig = dp.calibrate_rig(true.views, true.board)
    assert not said(rig)
    assert rig.baseline("cam0", "cam1").deviation < 1e-6


def test_variances_are_not_negative() -> None:
    A = torch.tensor([[4.0, 1.0], [1.0, 3.0]], dtype=D)
    assert torch.allclose(_not_negative(A, A @ torch.tensor([0.5, 2.0], dtype=D)), torch.tensor([0.5, 2.0], dtype=D))
    held = _not_negative(A, torch.tensor([-1.0, 3.0], dtype=D))
    # The least squares with the first at 0: A[:, 1] @ b / |A[:, 1]|^2.
    assert held.tolist() == pytest.approx([0.0, 0.8], abs=1e-3)
    assert _not_negative(torch.ones(2, 2, dtype=D), torch.tensor([1.0, 1.0], dtype=D)).tolist() == [0.5, 0.5]
