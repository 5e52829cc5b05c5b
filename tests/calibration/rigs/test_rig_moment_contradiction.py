"""A moment of a rig at which one camera saw the target where it no longer was, too near to be set apart."""

import pytest
import torch

import diffproj as dp
from tests.calibration.rigs.rig_scenes import D, Scene, scene

SAID = "more clearly than at any other moment"


def late(true: Scene, moment: int, name: str, shift: float, noise: float = 0.2) -> dict[str, dp.Views]:
    """The views, of which one camera saw the target at one moment so far to the right and away of where it was."""
    views, camera, draw = true.views[name], true.cameras[name], torch.Generator().manual_seed(0)
    row, t = views.names.index(f"moment {moment}"), true.t[moment] + torch.tensor([shift, 0, shift], dtype=D)
    seen, valid = camera.at(camera.R @ true.R[moment], camera.R @ t + camera.t).project(true.board.points)
    pixels, visible = views.pixels.clone(), views.visible.clone()
    pixels[row] = seen + noise * torch.randn(seen.shape, generator=draw, dtype=D)
    visible[row] &= valid & camera.in_image(pixels[row])
    return true.views | {name: dp.Views(pixels, visible, views.names, views.size)}


def said(rig: dp.RigCalibration) -> list[str]:
    return [remark for remark in rig.remarks if SAID in remark]


@pytest.mark.parametrize("options", [{}, {"loss": dp.Huber(0.5)}, {"reject_outliers": True}])
def test_a_moment_at_which_one_camera_was_late_is_named(options: dict) -> None:
    """By 3 mm of a board of half a metre, which hardly shows in the residuals."""
    true = scene(3, 16, missing=0.2, seed=5)
    rig = dp.calibrate_rig(late(true, 3, "cam1", 3.0), true.board, **options)
    (remark,) = said(rig)
    assert remark.startswith("at moment 3 cam1 contradicts the others, by about ")
    assert remark in rig.summary()


def test_of_two_cameras_both_are_named_and_the_places_behind_them() -> None:
    """In a chain nothing else tells: a fault between two cameras is one of all places behind it."""
    true = scene(cameras=4, moments=21, chain=True, seed=3)
    (remark,) = said(dp.calibrate_rig(late(true, 4, "cam2", 4.0), true.board))
    assert remark.startswith("at moment 4 cam1 and cam2 contradict each other, by about ")
    assert "without it cam2 would be" in remark or "without it cam3 would be" in remark
    assert not said(dp.calibrate_rig(true.views, true.board))


def test_how_far_places_hang_on_it_is_what_leaving_it_out_does() -> None:
    true = scene(3, 16, missing=0.2, seed=5)
    views = late(true, 3, "cam1", 3.0)
    rig = dp.calibrate_rig(views, true.board)
    (remark,) = said(rig)
    rows = [v for v, name in enumerate(views["cam1"].names) if name != "moment 3"]
    without = dp.calibrate_rig(views | {"cam1": views["cam1"][rows]}, true.board)
    assert not said(without)
    moved = without.cameras["cam1"].t - rig.cameras["cam1"].t
    turn = without.cameras["cam1"].R @ rig.cameras["cam1"].R.mT
    omega = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    far = torch.cat([omega, moved]).abs() / rig.place_covariance("cam1").diagonal().sqrt()
    told = float(remark.split("without it cam1 would be ")[1].split(" of its")[0])
    assert told == pytest.approx(float(far.amax()), rel=0.15)  # 2.8 and 2.6


@pytest.mark.parametrize("seed", range(4))
def test_noise_alone_and_a_blurred_view_are_none(seed: int) -> None:
    """Of 287 rigs of 2 to 5 cameras at 5 to 24 moments one had the remark."""
    true = scene(3, 14, missing=0.2, seed=seed)
    assert not said(dp.calibrate_rig(true.views, true.board))
    views, draw = true.views["cam1"], torch.Generator().manual_seed(seed)
    pixels = views.pixels.clone()
    pixels[1] += 0.6 * torch.randn(pixels[1].shape, generator=draw, dtype=D)
    blurred = true.views | {"cam1": dp.Views(pixels, views.visible, views.names, views.size)}
    assert not said(dp.calibrate_rig(blurred, true.board))


def test_of_the_bundled_pair_no_moment_is() -> None:
    """Its corners err together in all views; the ninth contradicts most, and moves no place by its deviation."""
    pair = {name: dp.example_views(name) for name in ("left", "right")}
    assert not said(dp.calibrate_rig(pair, dp.Chessboard()))
