"""Photographs of another camera, zoom or focus are told from those of the calibrated one, and error bars follow."""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
import torch

import diffproj as dp

D = torch.float64
BOARD = dp.Chessboard()
LEFT, RIGHT = dp.example_views("left"), dp.example_views("right")
Z = dp.Plane.z(0.0)


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(LEFT, BOARD)


def located(views: dp.Views, target: object, calibration: dp.Calibration) -> tuple[dp.Calibration, int]:
    """What `locate` finds, and how many warnings of another camera it gave."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = dp.locate(views, target, calibration)  # type: ignore[arg-type]
    return found, sum(issubclass(one.category, dp.CameraMismatchWarning) for one in caught)


def folds(views: dp.Views, k: int) -> Iterator[tuple[dp.Views, dp.Views]]:
    for fold in range(k):
        yield views[[i for i in range(len(views)) if i % k != fold]], views[list(range(fold, len(views), k))]


@pytest.mark.parametrize("numbers", [[0, 6, 12], pytest.param(range(13), marks=pytest.mark.slow)], ids=["some", "all"])
def test_every_photograph_of_the_other_camera_is_warned_of(calibration: dp.Calibration, numbers: Sequence[int]) -> None:
    for view in (RIGHT[number] for number in numbers):
        found, warned = located(view, BOARD, calibration)
        assert warned == 1
        assert found.mismatch.doubtful.all()
        with pytest.warns(
            dp.CameraMismatchWarning, match=rf"measure: the residuals of {view.names[0]} are \d\.\d times"
        ):
            measured = dp.measure(view.pixels[0, [0, 53]], found, Z)
        assert "another camera, zoom or focus" in measured.doubts
        assert "Doubtful: the residuals of " in measured.summary()
        assert "another camera" in found.summary()
        assert "another camera" in found.message


def test_few_views_of_a_calibration_raise_no_alarm() -> None:
    """Of the bundled views the eighth contradicts the others most; it is their camera's all the same."""
    for count in (5, 6):
        assert not located(LEFT[count:], BOARD, dp.calibrate(LEFT[:count], BOARD, "brown4"))[1]


def test_wrong_corners_are_weighed_as_the_loss_weighs_them(calibration: dp.Calibration) -> None:
    wrong = LEFT.pixels[:3].clone()
    wrong[:, 20] += 40.0
    views = dp.Views(wrong, size=LEFT.size)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.CameraMismatchWarning)
        plain = dp.locate(views, BOARD, calibration)
        robust = dp.locate(views, BOARD, calibration, loss=dp.Cauchy(0.3))
        clean = dp.locate(LEFT[:3], BOARD, calibration, loss=dp.Cauchy(0.3))
    assert plain.mismatch.doubtful.all()
    assert not robust.mismatch.doubtful.any()
    torch.testing.assert_close(robust.mismatch.ratio, clean.mismatch.ratio, rtol=0.1, atol=0)


def test_none_of_its_own(calibration: dp.Calibration) -> None:
    for fit, test in folds(LEFT, 5):
        found, warned = located(test, BOARD, dp.calibrate(fit, BOARD))
        assert warned == 0
        assert not found.doubts
        assert (found.mismatch.scale == 1).all()
    assert not located(LEFT, BOARD, calibration)[1]
    assert "nothing speaks against" in dp.locate(LEFT, BOARD, calibration).verdict


@pytest.mark.slow
def test_none_left_out_one_by_one() -> None:
    for views in (LEFT, RIGHT):
        assert not any(located(test, BOARD, dp.calibrate(fit, BOARD))[1] for fit, test in folds(views, 13))


def changed(calibration: dp.Calibration, zoom: float = 1.0, lens: float = 1.0) -> dp.Views:
    """The bundled poses through a camera of another zoom or focus, with the detector's noise."""
    assert isinstance(calibration.camera.distortion, dp.BrownConrady)
    K = calibration.camera.K.clone()
    K[:2, :2] *= zoom
    glass = dp.BrownConrady(lens * calibration.camera.distortion.coefficients)
    cameras = dp.Camera(K, calibration.cameras.R, calibration.cameras.t, glass)
    exact, _ = cameras.project(BOARD.points)
    return dp.Views(exact + 0.13 * torch.randn(exact.shape, dtype=D), size=LEFT.size)


def turned(mirrored: bool) -> dp.Views:
    """The photographs turned by 180 degrees, or mirrored with the corners numbered as the detector would."""
    if mirrored:
        flipped = LEFT.pixels.unflatten(-2, (6, 9)).flip(-2).flatten(-3, -2)
        return dp.Views(torch.stack([639 - flipped[..., 0], flipped[..., 1]], dim=-1), size=LEFT.size)
    return dp.Views(torch.tensor([639.0, 479.0]) - LEFT.pixels, size=LEFT.size)


def test_another_zoom_or_focus_and_other_edits(calibration: dp.Calibration) -> None:
    """Measured of 13 views: 13 at 10 % more zoom, 11 at a fifth more distortion, 13 without a lens, turned, mirrored."""
    assert located(changed(calibration, zoom=1.1), BOARD, calibration)[0].mismatch.doubtful.all()
    assert int(located(changed(calibration, lens=1.2), BOARD, calibration)[0].mismatch.doubtful.sum()) >= 9
    without_lens, _ = located(changed(calibration, lens=0.0), BOARD, calibration)
    assert without_lens.mismatch.doubtful.all()
    assert (without_lens.mismatch.ratio > 4).all()
    for mirrored in (False, True):
        assert located(turned(mirrored), BOARD, calibration)[0].mismatch.doubtful.all()
    assert not located(changed(calibration), BOARD, calibration)[1]


@pytest.mark.slow
@pytest.mark.parametrize("corners", [4, 12, 54])
def test_false_alarms_are_rare(corners: int) -> None:
    """Of 400 calibrations and a new view of each at most 1 %, also where its noise is 1.4 times as large: 2 %."""
    generator = torch.Generator().manual_seed(corners)
    setup = dp.paper_setup()
    points = setup.board.points
    exact, _ = setup.fit.project(points)
    noise = 0.2 * torch.randn(400, *exact.shape, generator=generator, dtype=D)
    calibrations = dp.calibrate(dp.Views(exact + noise, size=(640, 480)), setup.board, "brown4")
    new, _ = setup.test[3:4].project(points)
    seen = torch.zeros(1, 54, dtype=torch.bool)
    seen[0, [0, 8, 45, 53, *range(1, 8), *range(9, 54)][:corners]] = True
    for larger, most in ((1.0, 4), (1.4, 10)):
        shown = new + larger * 0.2 * torch.randn(400, *new.shape, generator=generator, dtype=D)
        found, _ = located(dp.Views(shown, seen.expand(400, 1, -1), size=(640, 480)), setup.board, calibrations)
        assert int(found.mismatch.doubtful.sum()) <= most


def test_four_corners_are_no_alarm_by_chance(calibration: dp.Calibration) -> None:
    """Of 400 views of the camera's own, with noise as in its calibration, at most 1 % are doubtful."""
    generator = torch.Generator().manual_seed(0)
    ends = [0, 8, 45, 53]
    exact, _ = calibration.cameras[3].project(BOARD.points[ends].to(D))
    noise = float(calibration.pixel_sigma) * torch.randn(400, 4, 2, generator=generator, dtype=D)  # type: ignore[arg-type]
    pixels = torch.zeros(400, 54, 2, dtype=D)
    pixels[:, ends] = exact + noise
    visible = torch.zeros(400, 54, dtype=torch.bool)
    visible[:, ends] = True
    found, _ = located(dp.Views(pixels, visible, size=LEFT.size), BOARD, calibration)
    assert int(found.mismatch.doubtful.sum()) <= 4


@pytest.mark.filterwarnings("ignore:measure. pixel .* outside of the photograph")
def test_error_bars_hold_the_other_camera(calibration: dp.Calibration) -> None:
    """Points 60 mm above the board. Measured: 98 % within 1.96 deviations; without the scale, 81 %."""
    truth = dp.calibrate(RIGHT, BOARD)
    found, _ = located(RIGHT, BOARD, calibration)
    raised = BOARD.points[[0, 8, 45, 53, 22, 13, 40]] + torch.tensor([0.0, 0, -60], dtype=D)
    held, alone = [], []
    for view in range(0, 13, 2):
        pixels, _ = truth.cameras[view].project(raised)
        with pytest.warns(dp.CameraMismatchWarning):
            measured = dp.measure(pixels, found, dp.Plane.z(-60.0), view=view, pixel_sigma=0.0)
        known = measured.deviations[:, :2].isfinite().all(-1)
        error = ((measured.points - raised)[:, :2].abs() / measured.deviations[:, :2])[known].flatten()
        held.append(error < 1.96)
        alone.append(error * found.mismatch.scale[view] < 1.96)
    assert float(torch.cat(held).double().mean()) > 0.93
    assert float(torch.cat(alone).double().mean()) < 0.88


def test_where_nothing_is_known_nothing_is_said(calibration: dp.Calibration) -> None:
    for found in (calibration, located(LEFT, BOARD, calibration.camera)[0]):  # type: ignore[arg-type]
        assert found.mismatch.ratio.isnan().all()
        assert not found.mismatch.doubtful.any()
        assert not found.doubts
    weighted = dp.locate(RIGHT, BOARD, calibration, weights=torch.full((13, 54), 2.0, dtype=D))
    assert weighted.mismatch.ratio.isnan().all()


def test_many_cameras_are_what_each_is_alone(calibration: dp.Calibration) -> None:
    both = dp.calibrate(dp.Views(torch.stack([LEFT.pixels, RIGHT.pixels]), size=LEFT.size), BOARD)
    crossed = dp.Views(torch.stack([RIGHT.pixels[:3], LEFT.pixels[:3]]), size=LEFT.size)
    together, _ = located(crossed, BOARD, both)
    alone, _ = located(RIGHT[:3], BOARD, calibration)
    for part, other in zip(together.mismatch, alone.mismatch, strict=True):
        torch.testing.assert_close(part[0], other, rtol=1e-4, atol=0)


def test_exact_corners_fit() -> None:
    setup = dp.paper_setup()
    fit, test = (dp.Views(part.project(setup.board.points)[0], size=(640, 480)) for part in (setup.fit, setup.test))
    found, warned = located(test, setup.board, dp.calibrate(fit, setup.board))
    assert warned == 0
    assert not found.doubts


def test_a_file_keeps_the_doubt(calibration: dp.Calibration, tmp_path: Path) -> None:
    found, _ = located(RIGHT[2:4], BOARD, calibration)
    dp.save_camera(tmp_path / "located.json", found)
    again = dp.load_calibration(tmp_path / "located.json")
    assert again.doubts == found.doubts
    assert torch.equal(again.mismatch.scale, found.mismatch.scale)


def test_landmarks_that_a_hand_picked_are_thought_of(calibration: dp.Calibration) -> None:
    generator = torch.Generator().manual_seed(0)
    points = BOARD.points[::5].to(D) + torch.tensor([0.0, 0.0, -40.0], dtype=D) * (torch.arange(11) % 2)[:, None]
    seen, _ = calibration.cameras[0].project(points)
    picked = seen + 0.6 * torch.randn(seen.shape, generator=generator, dtype=D)
    views = dp.Views(picked.unsqueeze(0), size=LEFT.size)
    with pytest.warns(dp.CameraMismatchWarning, match="picked by hand .* pixel_sigma=0.5"):
        dp.locate(views, dp.Landmarks(points), calibration)
    with warnings.catch_warnings():
        warnings.simplefilter("error", dp.CameraMismatchWarning)
        dp.locate(views, dp.Landmarks(points), calibration, pixel_sigma=0.6)
