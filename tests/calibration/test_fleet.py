"""A list of cameras that differ: each ends as alone, in its place, whatever happens to the others."""

import pytest
import torch

import diffproj as dp
from diffproj.calibration import fleet
from diffproj.calibration.calibrate import calibrate_and_tell

BOARD = dp.Chessboard()


def cameras() -> list[dp.Views]:
    """Cameras of several sizes and numbers of views; the third has one view alone."""
    left, right = dp.example_views("left"), dp.example_views("right")
    large = dp.Views(left.pixels * 2 + 0.5, size=(1280, 960))
    hidden = right.hiding(torch.arange(54) % 5 == 0)
    return [left, right[:9], left[0], right, hidden[:10], large, right[[1, 2, 2, 3, 5, 6, 7]]]


def check_like_alone(
    found: list[dp.Calibration | dp.CalibrationError], number: int, accuracy: float = 1e-10, **options: object
) -> None:
    one = found[number]
    alone = dp.calibrate(cameras()[number], BOARD, throw=False, **options)
    assert isinstance(one, dp.Calibration)
    assert one.views.names == alone.views.names
    assert (one.shares is None) == (alone.shares is None)
    assert torch.allclose(one.shared, alone.shared, rtol=accuracy, atol=accuracy)
    scale = alone.covariance.shared.abs().max()
    assert (one.covariance.shared - alone.covariance.shared).abs().max() < max(1e-6, 100 * accuracy) * scale
    assert one.verdict == alone.verdict


@pytest.mark.parametrize("options", [{}, {"reject_outliers": True, "pixel_sigma": 0.1}])
def test_each_ends_as_alone(options: dict) -> None:
    found = dp.calibrate(cameras(), BOARD, **options)
    assert len(found) == len(cameras())
    for number in (1, 4, 6):
        check_like_alone(found, number, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{"shape": "bow"}, {"shape": "free", "priors": {"points": 0.1}}, {"distortion": "brown8"}]
)
def test_each_ends_as_alone_whatever_is_fitted(options: dict) -> None:
    found = dp.calibrate(cameras(), BOARD, throw=False, **options)
    # A print's prior weighs against noise that is known to 1e-7, and a denominator's coefficients are hardly known.
    rough = not {"priors", "distortion"}.isdisjoint(options)
    for number in (0, 1, 4, 5, 6):
        check_like_alone(found, number, 1e-6 if rough else 1e-10, **options)


def test_a_failure_is_told_in_its_place() -> None:
    found = dp.calibrate(cameras(), BOARD)
    failed = found[2]
    assert isinstance(failed, dp.CalibrationError)
    with pytest.raises(dp.CalibrationError) as alone:
        dp.calibrate(cameras()[2], BOARD)
    assert str(failed) == str(alone.value)
    shown = dp.calibrate(cameras(), BOARD, throw=False)[2]
    assert isinstance(shown, dp.Calibration)
    assert not bool(shown.converged)


def test_what_does_not_fit_together_is_told_of_its_camera() -> None:
    left = dp.example_views("left")
    outside = dp.Views(left.pixels, size=(320, 240))
    found = dp.calibrate([left, outside, left[:8]], BOARD)
    assert isinstance(found[1], dp.CalibrationError)
    assert str(found[1]).startswith("calibrate: of views[1], views: want corners inside")
    same_size = dp.Views(left.pixels + 300, size=(640, 480))
    found = dp.calibrate([left, same_size], BOARD)
    assert [type(one) for one in found] == [dp.Calibration, dp.CalibrationError]
    with pytest.raises(ValueError, match="views: want corners inside"):
        dp.calibrate([outside, outside], BOARD)


def test_weights_of_each_camera() -> None:
    generator = torch.Generator().manual_seed(0)
    weights = [torch.rand(len(views), 54, generator=generator, dtype=torch.float64) + 0.5 for views in cameras()]
    found = dp.calibrate(cameras(), BOARD, weights=weights, throw=False)
    for number in (1, 6):
        check_like_alone(found, number, weights=weights[number])
    with pytest.raises(ValueError, match="weights: want a number, or a list of 7"):
        dp.calibrate(cameras(), BOARD, weights=weights[:2])


@pytest.mark.slow
def test_circles_and_the_choice_of_a_lens() -> None:
    left = dp.example_views("left")
    found = dp.calibrate([left, left[:8]], BOARD, "auto")
    assert all(isinstance(one, dp.Calibration) and one.comparison is not None for one in found)
    circles = dp.CircleGrid(9, 6, spacing=25.0, diameter=15.0)
    other = dp.calibrate([left, left[:8]], circles)[1]
    assert isinstance(other, dp.Calibration)
    assert torch.equal(other.shared, dp.calibrate(left[:8], circles).shared)


def test_progress_counts_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet, "MOST", 2)
    told = []
    found = dp.calibrate(cameras(), BOARD, progress=lambda done, total: told.append((done, total)), throw=False)
    assert told[-1] == (7, 7)
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    check_like_alone(found, 3)


@pytest.mark.plain
def test_wrong_lists() -> None:
    left = dp.example_views("left")
    with pytest.raises(TypeError, match=r"views\[1\]: want dp.Views, got"):
        dp.calibrate([left, 3], BOARD)
    with pytest.raises(ValueError, match=r"views\[1\]: want the photographs' size"):
        dp.calibrate([left, dp.Views(left.pixels)], BOARD)
    with pytest.raises(ValueError, match=r"views\[1\]: want 54 corners"):
        dp.calibrate([left, dp.Views(torch.rand(3, 20, 2), size=(640, 480))], BOARD)
    with pytest.raises(TypeError, match="views: want dp.Views, got"):
        dp.calibrate([], BOARD)


def test_remarks_worked_out_side_by_side_are_those_of_each_alone() -> None:
    """Of cameras of unlike numbers of views; one with a word to be said, and one that fails."""
    left, right = dp.example_views("left"), dp.example_views("right")
    moved = torch.where(torch.arange(len(left)).reshape(-1, 1, 1) < 4, left.pixels + 20, left.pixels)
    two = dp.Views(moved, left.visible, left.names, size=left.size)
    cameras = [left, right[:11], two, left[0]]
    told = calibrate_and_tell(cameras, dp.Chessboard(), "brown4")
    for one, other in zip(told, dp.calibrate(cameras, dp.Chessboard(), "brown4"), strict=True):
        assert type(one) is type(other)
        if isinstance(one, dp.Calibration) and isinstance(other, dp.Calibration):
            assert one.remarks == other.remarks
            assert one.verdict == other.verdict
    assert isinstance(told[2], dp.Calibration)
    assert told[2].remarks[0]
