"""Poses found with a known noise: where residuals contradict it, whatever is measured from them says so."""

import re
from dataclasses import replace

import pytest
import torch

import diffproj as dp

D = torch.float64
CAMERA = dp.Camera.mounted(8.0, 20.0, 5.0, 30.0, focal=(1000.0, 1100.0), size=(1280, 960), position=[3.0, 4.0])
PIXELS = torch.tensor([[200.0, 500], [1100, 450], [600, 800], [640, 900], [900, 700], [300, 850]], dtype=D)
POINTS = dp.back_project(PIXELS, CAMERA, dp.Plane.z(0.0))[0]
NOISE = 0.5 * torch.randn(6, 2, generator=torch.Generator().manual_seed(1), dtype=D)
WRONG = torch.zeros(6, 2, dtype=D).index_fill(0, torch.tensor([2]), 25.0)
WORDS = "times what pixel_sigma says"


def located(pixels: torch.Tensor, pixel_sigma: float | None) -> dp.Calibration:
    views = dp.Views(pixels.unsqueeze(-3), size=(1280, 960))
    return dp.locate(views, dp.Landmarks(POINTS), CAMERA, pixel_sigma=pixel_sigma)


def test_a_wrong_landmark_is_a_doubt_of_pose_and_measurement() -> None:
    found = located(PIXELS + NOISE + WRONG, 1.0)
    assert WORDS in found.doubts
    assert WORDS in found.verdict
    assert found.message.count(WORDS) == 1
    assert found.summary().count(WORDS) == 2  # as a doubt, and in the verdict
    measured = dp.measure([[600.0, 800.0]], found, dp.Plane.z(0.0), view=0, pixel_sigma=1.0)
    assert WORDS in measured.doubts
    assert WORDS in measured.summary()


def test_nothing_is_said_of_noise_that_is_as_known_or_is_estimated() -> None:
    for pixels, pixel_sigma in ((PIXELS + NOISE, 1.0), (PIXELS, 1.0), (PIXELS + NOISE + WRONG, None)):
        found = located(pixels, pixel_sigma)
        assert not found.doubts
        assert not dp.measure([[600.0, 800.0]], found, dp.Plane.z(0.0), view=0, pixel_sigma=1.0).doubts
        assert "nothing speaks against" in found.verdict
    assert "and landmarks are met to 13 px in each coordinate" in found.verdict  # for people to judge


def test_the_verdict_tells_the_scatter_that_residuals_show_and_not_what_was_said_of_it() -> None:
    landmarks = torch.cat([POINTS, POINTS[:4] + torch.tensor([0.5, 0.5, 1.0], dtype=D)])
    pixels = CAMERA.project(landmarks)[0]
    noise = 0.5 * torch.randn(10, 2, generator=torch.Generator().manual_seed(1), dtype=D)
    views = dp.Views((pixels + noise).unsqueeze(-3), size=(1280, 960))
    held = {"fixed": ("principal_point",), "tied_focal": True}
    found = dp.calibrate(views, dp.Landmarks(landmarks), "none", pixel_sigma=30.0, throw=False, **held)  # type: ignore[arg-type]
    assert float(found.pixel_sigma) == 30  # type: ignore[arg-type]
    shown = float(found.residuals[found.used].square().mean().sqrt())
    assert found._scatter == pytest.approx(shown)
    unsaid = replace(found, pixel_sigma=None, degrees_of_freedom=None)
    assert unsaid._scatter == pytest.approx(shown)


def test_of_many_cameras_those_are_named() -> None:
    found = located(torch.stack([PIXELS + NOISE, PIXELS + NOISE + WRONG, PIXELS]), 1.0)
    assert "cameras 1 are larger than pixel_sigma says" in found.doubts
    measured = dp.measure([[600.0, 800.0]], found, dp.Plane.z(0.0), view=0, pixel_sigma=1.0)
    assert measured.doubts == found.doubts


TOGETHER = "the views contradict each other"


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_noise_that_leaves_out_what_corners_of_a_view_have_in_common_is_told(side: str) -> None:
    """Without it those of the lens are 2.4 and 2.7 times as large; of the focal length views tell more by themselves."""
    views, board = dp.example_views(side), dp.Chessboard()
    plain = dp.calibrate(views, board)
    known = dp.calibrate(views, board, pixel_sigma=float(plain.pixel_sigma))  # type: ignore[arg-type]
    times = float(plain.covariance.deviations["k1"] / known.covariance.deviations["k1"])
    assert times > 2
    said = re.search(f"{TOGETHER} (.*) times as much as corners of that pixel_sigma would", known.remarks[0])
    assert said is not None
    assert float(said[1]) == pytest.approx(times, rel=0.05)
    assert plain.covariance.deviations["f_x"] < 1.5 * known.covariance.deviations["f_x"]
    assert known.verdict.startswith(f"Weak: {TOGETHER}")
    assert TOGETHER not in plain.remarks[0]
    assert TOGETHER not in dp.calibrate(views, board, pixel_sigma=2.5 * float(plain.pixel_sigma)).remarks[0]  # type: ignore[arg-type]


@pytest.mark.parametrize("views", [2, 3, 5, 13])
def test_views_of_independent_corners_do_not_contradict_each_other(views: int) -> None:
    camera = dp.Camera(torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D), size=(640, 480))
    board = dp.Chessboard()
    posed = dp.synthetic.random_cameras(camera, board, 40 * views, seed=1)
    posed = camera.at(posed.R.unflatten(0, (40, views)), posed.t.unflatten(0, (40, views)))
    seen = dp.synthetic.corner_views(posed, board, noise_px=0.1, seed=2)
    found = dp.calibrate(seen, board, "none", pixel_sigma=0.1, throw=False)
    assert not any(TOGETHER in remark for remark in found.remarks)
