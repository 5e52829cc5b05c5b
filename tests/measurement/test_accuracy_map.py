"""Maps of resolution and deviation over the image and over the plane."""

import pytest
import torch

import diffproj as dp
from diffproj import figures

D = torch.float64
BOARD = dp.Chessboard()


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(dp.example_views("left"), BOARD)


def test_the_unseen_corner_is_tens_of_times_less_certain(calibration: dp.Calibration) -> None:
    accuracy = dp.AccuracyMap.over_image(calibration, step=16, view=0)
    H, W = accuracy.valid.shape
    middle, corner = accuracy.deviation[H // 2, W // 2], accuracy.deviation[0, 0]
    assert accuracy.valid.all()
    assert accuracy.covered[H // 2, W // 2]
    assert not accuracy.covered[0, 0]
    assert corner > 20 * middle
    # The resolution alone does not say so: it is geometry.
    assert accuracy.resolution[0, 0] < 3 * accuracy.resolution[H // 2, W // 2]
    inside = accuracy.deviation[accuracy.covered]
    assert inside.median() < 0.2


def test_the_grid_reaches_the_edges(calibration: dp.Calibration) -> None:
    accuracy = dp.AccuracyMap.over_image(calibration, step=50, view=0)
    assert accuracy.pixels[0, 0].tolist() == [0, 0]
    assert accuracy.pixels[-1, -1].tolist() == [639, 479]
    assert accuracy.pixels.shape == (11, 14, 2)
    coarse = dp.AccuracyMap.over_image(calibration, step=1000, view=0)
    assert coarse.pixels.tolist() == [[[0, 0], [639, 0]], [[0, 479], [639, 479]]]


def test_resolution_is_a_finite_difference(calibration: dp.Calibration) -> None:
    accuracy = dp.AccuracyMap.over_image(calibration, step=100, view=3)
    camera, plane = calibration.cameras[3], dp.Plane.z(0.0)
    angle = torch.linspace(0, torch.pi, 181, dtype=D)
    around = 1e-4 * torch.stack([angle.cos(), angle.sin()], dim=-1)
    for i, j in ((0, 0), (2, 3), (4, 6)):
        ahead, behind = (dp.back_project(accuracy.pixels[i, j] + s * around, camera, plane)[0] for s in (1, -1))
        worst = (ahead - behind).norm(dim=-1).amax() / 2e-4
        torch.testing.assert_close(accuracy.resolution[i, j], worst, rtol=1e-3, atol=0)


@pytest.mark.parametrize("plane", [None, dp.Plane([0.0, 1.0, 0.02], 300.0)], ids=["board", "upright"])
def test_resolution_is_what_noise_of_one_pixel_does(calibration: dp.Calibration, plane: dp.Plane | None) -> None:
    accuracy = dp.AccuracyMap.over_image(calibration, plane, step=20, view=3)
    flat = accuracy.pixels.flatten(0, 1)
    measured = dp.measure(flat, calibration, plane or dp.Plane.z(0.0), view=3, pixel_sigma=1.0)
    largest = torch.linalg.svdvals(measured._noise.own)[:, 0].reshape(accuracy.valid.shape)
    assert torch.equal(measured.valid, accuracy.valid.flatten())
    assert accuracy.valid.sum() > 100
    # They agree to 1e-15 on the board, and to 3e-14 up to the horizon of the upright plane.
    torch.testing.assert_close(accuracy.resolution[accuracy.valid], largest[accuracy.valid], rtol=1e-13, atol=0)


def test_the_plane_is_the_image_seen_from_the_other_side(calibration: dp.Calibration) -> None:
    table = dp.Plane([0.05, -0.1, 1.0], 3.0)
    accuracy = dp.AccuracyMap.over_plane(calibration, (-50, -50, 250, 175), table, view="left03.jpg", shape=(5, 7))
    assert accuracy.points.shape == (5, 7, 3)
    assert accuracy.points[0, 0, :2].tolist() == pytest.approx([-50, -50])
    assert accuracy.points[-1, -1, :2].tolist() == pytest.approx([250, 175])
    off = (accuracy.points * torch.tensor([0.05, -0.1, 1.0], dtype=D)).sum(-1) - 3.0
    assert off[accuracy.valid].abs().max() < 1e-9
    view = calibration.views.names.index("left03.jpg")
    measured = dp.measure(accuracy.pixels[2, 3][None], calibration, table, view=view, pixel_sigma="detector")
    worst = torch.linalg.eigvalsh(measured.covariance[0])[-1].sqrt()
    torch.testing.assert_close(accuracy.deviation[2, 3], worst)


def test_horizon_and_image_end_the_map(calibration: dp.Calibration) -> None:
    upright = dp.Plane([0.0, 1.0, 0.02], 300.0)
    accuracy = dp.AccuracyMap.over_image(calibration, upright, step=40, view=0)
    assert accuracy.valid.any()
    assert not accuracy.valid.all()
    assert torch.equal(accuracy.deviation.isnan(), ~accuracy.valid)
    far = dp.AccuracyMap.over_plane(calibration, (-5000, -5000, 5000, 5000), shape=(9, 9), view=0)
    assert not far.valid[0, 0]
    assert torch.equal(far.resolution.isnan(), ~far.valid)


def test_picture(calibration: dp.Calibration) -> None:
    image = figures.png(figures.accuracy(dp.AccuracyMap.over_image(calibration, step=32, view=0)))
    assert image[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.plain
def test_bad_input_is_refused_by_name(calibration: dp.Calibration) -> None:
    with pytest.raises(ValueError, match="step: want a positive distance"):
        dp.AccuracyMap.over_image(calibration, step=0, view=0)
    with pytest.raises(ValueError, match="extent: want"):
        dp.AccuracyMap.over_plane(calibration, (0, 0, 0, 1), view=0)
    with pytest.raises(ValueError, match="plane: want one that is a height"):
        dp.AccuracyMap.over_plane(calibration, (0, 0, 1, 1), dp.Plane([1.0, 0, 0], 0.0), view=0)
    with pytest.raises(ValueError, match=r"plane: want one plane, got batch shape \(2,\)"):
        dp.AccuracyMap.over_image(calibration, dp.Plane.z(torch.zeros(2, dtype=D)), view=0)
    both = dp.calibrate(dp.Views(torch.stack([calibration.views.pixels] * 2), size=(640, 480)), BOARD)
    with pytest.raises(ValueError, match="calibration: want one camera"):
        dp.AccuracyMap.over_image(both)
    with pytest.raises(ValueError, match=r"calibration: want one camera, got batch shape \(2,\); index it"):
        dp.AccuracyMap.over_plane(both, (0, 0, 1, 1))


def test_former_names_lead_to_the_new_ones() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'image_map'; it is diffproj.AccuracyMap.over_image now"):
        dp.image_map  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'plane_map'; it is diffproj.AccuracyMap.over_plane now"):
        dp.plane_map  # noqa: B018
    with pytest.raises(AttributeError, match="no attribute 'nothing'$"):
        dp.nothing  # noqa: B018


def test_a_step_that_is_too_fine_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffproj.measurement.accuracy_map.MOST_PLACES", 200)  # 16 x 12 of 40 px each, not 22 x 16
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    assert dp.AccuracyMap.over_image(calibration, view=0, step=40).deviation.shape == (13, 17)
    with pytest.raises(ValueError, match="step: want a positive distance"):
        dp.AccuracyMap.over_image(calibration, view=0, step=36)
