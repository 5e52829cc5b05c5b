"""Held-out errors and bootstrap deviations."""

from dataclasses import replace

import pytest
import torch

import diffproj as dp
from diffproj import synthetic

D = torch.float64
BOARD = dp.Chessboard()


def test_folds_are_what_a_loop_gives() -> None:
    views = dp.example_views("left")
    outcome = dp.cross_validate(views, BOARD, folds=4)
    assert outcome.fits.camera.batch_shape == (4,)
    left_out = [i for i in range(13) if i % 4 == 1]
    fitted = [i for i in range(13) if i % 4 != 1]
    alone = dp.calibrate(views[fitted], BOARD)
    torch.testing.assert_close(outcome.in_sample_px[1], alone.rms, rtol=1e-8, atol=0)
    second = torch.arange(54) % 2 == 1
    total, world, count = 0.0, 0.0, 0
    for judges in (second, ~second):
        located = dp.locate(views[left_out].hiding(judges), BOARD, alone.camera)
        seen = views[left_out].pixels.to(D)[:, judges]
        projected, _ = located.cameras.project(BOARD.points[judges])
        landed, _ = dp.back_project(seen, located.cameras, dp.Plane.z(0.0))
        total += float((projected - seen).square().sum())
        world += float((landed - BOARD.points[judges]).square().sum())
        count += seen.shape[0] * seen.shape[1]
    assert float(outcome.held_out_px[1]) == pytest.approx((total / count) ** 0.5, rel=1e-7)
    assert float(outcome.held_out_world[1]) == pytest.approx((world / count) ** 0.5, rel=1e-7)


def test_held_out_errors_are_larger_and_in_their_place() -> None:
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
    truth = synthetic.random_cameras(dp.Camera(K, size=(640, 480)), BOARD, 6)
    views = synthetic.corner_views(truth, BOARD, noise_px=0.2)
    outcome = dp.cross_validate(views, BOARD, "brown5", folds=3)
    assert (outcome.held_out_px > outcome.in_sample_px).all()
    assert (outcome.held_out_world > outcome.in_sample_world).all()
    assert (outcome.held_out_px < 3 * 0.2 * 2**0.5).all()
    lines = outcome.summary().splitlines()
    assert len(lines) == 5
    assert lines[-1].startswith("all")
    assert "evaluated" not in repr(outcome)


def test_folds_without_an_error_are_left_out_of_the_total() -> None:
    found = dp.cross_validate(dp.example_views("left"), BOARD, folds=3)
    gaps = replace(found, held_out_px=torch.tensor([0.3, torch.nan, 0.4], dtype=D))
    assert "held out RMS 0.3536 px" in repr(gaps)
    assert "1 of 3 folds not evaluated" in repr(gaps)
    assert "0.3536" in gaps.summary()
    none = replace(found, held_out_px=torch.full((3,), torch.nan, dtype=D))
    assert "3 of 3 folds not evaluated" in repr(none)


@pytest.mark.parametrize("who", ["camera", pytest.param("rig", marks=pytest.mark.slow)])
def test_corners_that_all_views_reject_are_no_held_out_errors(who: str) -> None:
    """A wrong corner tells nothing of the camera: one that is 40 px off made the held-out error 1.5 px."""
    views = dp.example_views("left")
    pixels = views.pixels.clone()
    pixels[4, 20] += 40.0
    wrong = dp.Views(pixels, views.visible, views.names, views.size)

    def held_out(views: dp.Views, **options: bool) -> float:
        if who == "camera":
            return float(dp.cross_validate(views, BOARD, folds=3, **options).held_out_px.amax())  # type: ignore[arg-type]
        pair = {"left": views, "right": dp.example_views("right")}
        return float(dp.cross_validate_rig(pair, BOARD, folds=3, **options).held_out_px.amax())  # type: ignore[arg-type]

    assert held_out(wrong) > 1
    assert held_out(wrong, reject_outliers=True) == pytest.approx(held_out(views, reject_outliers=True), rel=0.02)


def test_bootstrap_agrees_with_the_covariance() -> None:
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
    truth = synthetic.random_cameras(dp.Camera(K, size=(640, 480)), BOARD, 60)
    views = synthetic.corner_views(truth, BOARD)
    spread = dp.bootstrap(views, BOARD, "none", draws=100)
    predicted = dp.calibrate(views, BOARD, "none").covariance.deviations
    assert list(spread) == ["f_x", "f_y", "c_x", "c_y"]
    for name, value in spread.items():  # 60 views and 100 draws know a deviation to 12 %
        assert 0.6 < value / predicted[name] < 1.6


@pytest.mark.plain
def test_bad_input_is_refused_by_name() -> None:
    views = dp.example_views("left")
    batch = dp.Views(views.pixels[None], size=views.size)
    with pytest.raises(ValueError, match="folds: want a whole number from 2 to the number of views, 13, got 14"):
        dp.cross_validate(views, BOARD, folds=14)
    with pytest.raises(ValueError, match="views: want those of one camera"):
        dp.cross_validate(batch, BOARD)
    with pytest.raises(ValueError, match="views: want those of one camera"):
        dp.bootstrap(batch, BOARD)
    with pytest.raises(ValueError, match="draws: want a whole number of at least 2.* got 1"):
        dp.bootstrap(views, BOARD, draws=1)
    with pytest.raises(ValueError, match="views: want some that show the board differently, got one"):
        dp.bootstrap(views[:1], BOARD, draws=4)
    with pytest.raises(dp.CalibrationError, match="draws determine the camera"):
        dp.bootstrap(views[:2], BOARD, draws=2, seed=1)  # twice the same view


def test_views_alike_are_drawn_together() -> None:
    views = dp.example_views("left")[:6]
    thrice = dp.Views(views.pixels.repeat(3, 1, 1), size=views.size)
    alone, copied = (dp.bootstrap(v, dp.Chessboard(), "brown4", draws=40) for v in (views, thrice))
    for name, spread in alone.items():
        assert float(copied[name]) == pytest.approx(float(spread), rel=1e-3)
    with pytest.raises(ValueError, match="views: want some that show the board differently, got 4 alike"):
        dp.bootstrap(dp.Views(views.pixels[[3] * 4], size=views.size), dp.Chessboard(), fixed=("distortion",))


def test_folds_that_did_not_converge_have_no_error() -> None:
    views = dp.example_views("left")[[0, 0, 0]]
    outcome = dp.cross_validate(views, dp.Chessboard(), folds=3, throw=False)
    assert not outcome.fits.converged.any()
    assert outcome.held_out_px.isinf().all()
    assert "inf" in outcome.summary()


@pytest.mark.plain
def test_wrong_numbers_and_lenses_are_named() -> None:
    views, board = dp.example_views("left"), dp.Chessboard()
    with pytest.raises(TypeError, match="folds: want a whole number from 2 to"):
        dp.cross_validate(views, board, folds=2.5)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"draws: want a whole number of at least 2.* got 2\.5"):
        dp.bootstrap(views, board, draws=2.5)  # type: ignore[arg-type]
    for function in (dp.cross_validate, dp.bootstrap):
        with pytest.raises(ValueError, match="distortion: want the name of a lens, got 'auto'; calibrate with it"):
            function(views, board, "auto")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"camera: want dp\.Camera, got Calibration; give calibration\.camera"):
        dp.refine(views, board, dp.calibrate(views, board))  # type: ignore[arg-type]
