"""Which view, and how good the pixels are: what `measure` asks for, and what hand-picked lengths then are."""

import warnings

import pytest
import torch

import diffproj as dp

D = torch.float64
BOARD = dp.Chessboard()
Z = dp.Plane.z(0.0)
LEFT = dp.example_views("left")
CLICKS = torch.tensor([[240.0, 100], [300, 150]], dtype=D)


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(LEFT, BOARD)


def test_the_view_is_asked_for(calibration: dp.Calibration) -> None:
    with pytest.raises(ValueError, match=r"view: want one of the calibration's 13 views.*'left01.jpg'"):
        dp.measure(CLICKS, calibration, Z, pixel_sigma=0.5)
    for make in (dp.AccuracyMap.over_image, lambda c: dp.AccuracyMap.over_plane(c, (0, 0, 9, 9))):
        with pytest.raises(ValueError, match="view: want one of the calibration's 13 views"):
            make(calibration)
    alone = dp.locate(LEFT[3], BOARD, calibration)
    one = dp.measure(CLICKS, alone, Z, pixel_sigma=0.5)
    assert torch.equal(one.points, dp.measure(CLICKS, alone, Z, view=0, pixel_sigma=0.5).points)
    assert dp.AccuracyMap.over_image(alone, step=160).valid.any()


def test_the_noise_is_asked_for(calibration: dp.Calibration) -> None:
    with pytest.warns(dp.PixelNoiseWarning, match=r"to 0.12 px.*0.5 for points that a hand picked"):
        silent = dp.measure(CLICKS, calibration, Z, view=0)
    said = dp.measure(CLICKS, calibration, Z, view=0, pixel_sigma="detector")
    assert torch.equal(silent.deviations, said.deviations)
    assert (dp.measure(CLICKS, calibration, Z, view=0, pixel_sigma=0.5).deviations >= said.deviations).all()
    for camera in (calibration.cameras[0], calibration.cameras[0].to(D)):
        for sigma in (None, "detector"):
            with pytest.raises(ValueError, match="pixel_sigma: want the noise of the pixels in px, for a camera alone"):
                dp.measure(CLICKS, camera, Z, pixel_sigma=sigma)  # type: ignore[arg-type]


@pytest.mark.plain
def test_other_words_mean_nothing(calibration: dp.Calibration) -> None:
    with pytest.raises(ValueError, match="pixel_sigma: want px, or 'detector'.*got 'hand'"):
        dp.measure(CLICKS, calibration, Z, view=0, pixel_sigma="hand")  # type: ignore[arg-type]


def test_corners_of_the_view_are_the_detectors(calibration: dp.Calibration) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dp.measure(LEFT.pixels[0, [8, 0]], calibration, Z, view=0)
        dp.measure(LEFT.pixels[0, :0], calibration, Z, view=0)
    with pytest.warns(dp.PixelNoiseWarning):
        dp.measure(LEFT.pixels[1, [8, 0]], calibration, Z, view=0)


def test_hand_picked_lengths_are_covered() -> None:
    """300 calibrations and one picked length in each of three places, picks good to 0.5 px; measured: 94 to 96 %.

    With the detector's noise, 0.1 px here, it is about 31 %.
    """
    setup, generator = dp.paper_setup(), torch.Generator().manual_seed(4)
    exact, _ = setup.fit.project(setup.board.points)
    corners = exact + 0.1 * torch.randn(300, *exact.shape, generator=generator, dtype=D)
    found = dp.calibrate(dp.Views(corners, size=(640, 480)), setup.board, "none")
    ends = torch.tensor([[10.0, 15, 0], [95, 40, 0], [60, 140, 0], [120, 180, 0]], dtype=D)
    seen, _ = setup.fit[3].project(ends)
    clicks = seen + 0.5 * torch.randn(300, 4, 2, generator=generator, dtype=D)
    truth = ends.diff(dim=0).norm(dim=-1)

    def covered(pixel_sigma: float | str) -> float:
        measured = dp.measure(clicks, found, Z, view=3, pixel_sigma=pixel_sigma)  # type: ignore[arg-type]
        low, high = measured.lengths().interval()
        return float(((low <= truth) & (truth <= high)).double().mean())

    assert 0.93 < covered(0.5) < 0.97
    assert covered("detector") < 0.5


@pytest.mark.parametrize("sigma", [0.01, 0.5, 3.0])
def test_deviations_and_covariances_of_pixels_say_the_same(calibration: dp.Calibration, sigma: float) -> None:
    each = torch.full((2, 2), sigma, dtype=D)
    spread = [
        dp.measure(CLICKS, calibration, Z, view=0, pixel_sigma=given).covariance
        for given in (sigma, each, torch.diag_embed(each.square()))
    ]
    for found in spread[1:]:
        torch.testing.assert_close(found, spread[0], rtol=1e-12, atol=0)


def test_a_covariance_is_not_read_as_deviations_of_two_pixels() -> None:
    """Of two pixels both have the same shape, and the error bars would be several times too small."""
    down = dp.Camera(
        torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]).double(), t=torch.tensor([0, 0, 500.0]).double()
    )
    ends, table = [[300.0, 240.0], [340.0, 240.0]], dp.Plane.z(0.0)
    for given in ([[0.09, 0.0], [0.0, 0.09]], [[0.3, 0.1], [0.1, 0.2]]):
        with pytest.raises(ValueError, match=r"want deviations or covariances, .* give covariances as \(2, 2, 2\)"):
            dp.measure(ends, down, table, pixel_sigma=given)
        for one in (ends[:1], [*ends, [320.0, 200.0]]):
            with pytest.raises(ValueError, match="pixel_sigma"):  # for any other number they do not fit
                dp.measure(one, down, table, pixel_sigma=given)
    as_covariances = dp.measure(ends, down, table, pixel_sigma=[[[0.09, 0.0], [0.0, 0.09]]] * 2)
    torch.testing.assert_close(as_covariances.lengths().deviation, torch.tensor([0.3 * 2**0.5]).double())
    for given in ([[0.3, 0.3], [0.3, 0.3]], [[0.3, 0.4], [0.2, 0.3]], [0.3, 0.4]):
        assert bool((dp.measure(ends, down, table, pixel_sigma=given).deviations[:, 0] > 0.19).all())
    many = down[None].expand(3)
    with pytest.raises(ValueError, match=r"give covariances as \(3, 2, 2, 2\)"):
        dp.measure(ends, many, table, pixel_sigma=[[[0.09, 0.0], [0.0, 0.09]]])
