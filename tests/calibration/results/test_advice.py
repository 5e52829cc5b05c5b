"""The verdict on a calibration, in words that a newcomer understands."""

from pathlib import Path

import pytest
import torch

import diffproj as dp
from diffproj.calibration.results.advice import _second_spread
from diffproj.lens.models import LensModel

D = torch.float64
BOARD = dp.Chessboard()
LEFT = dp.example_views("left")


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(LEFT, BOARD)


def test_good_views(calibration: dp.Calibration) -> None:
    assert calibration.verdict.startswith(
        "Good: 13 views differ, cover 56 % of the image and are tilted by up to 41 deg"
    )
    assert "focal lengths and principal point are known to 0.2 % of the focal length" in calibration.verdict
    assert "Better still: the board in the top left and bottom left of the image" in calibration.verdict
    assert calibration.summary().splitlines()[-1] == calibration.verdict
    assert "top right" in dp.calibrate(dp.example_views("right"), BOARD).verdict


def test_few_views_and_copies() -> None:
    few = dp.calibrate(LEFT[[0, 4]], BOARD).verdict
    assert few.startswith("Weak: only 2 views differ")
    assert "Next: 8 more photographs" in few
    tells_little = dp.calibrate(LEFT[[0, 6]], BOARD, "brown8").verdict
    assert "principal point are known only to 12 % of the focal length" in tells_little
    copies = dp.calibrate(dp.Views(LEFT.pixels[[0, 0, 0, 0, 3, 4]], size=LEFT.size), BOARD).verdict
    assert copies.startswith("Weak: only 3 of 6 views differ")


def test_a_board_that_was_hardly_tilted() -> None:
    setup = dp.paper_setup()
    angles = torch.tensor([[8.0, 0, 3], [-8, 4, 5], [0, 9, 20], [5, -9, 90], [-6, -6, 45], [9, 3, 10]], dtype=D)
    R = setup.fit.R[0] @ dp.rotation_from_euler(*torch.deg2rad(angles).unbind(-1))
    middle = setup.board.points.mean(0)
    t = torch.tensor([0.0, 0, 420], dtype=D) - R @ middle
    pixels, _ = setup.fit[0].at(R, t).project(setup.board.points)
    views = dp.Views(pixels + 0.1 * torch.randn(pixels.shape, dtype=D), size=(640, 480))
    found = dp.calibrate(views, setup.board, "none", throw=False)
    assert "the board was tilted by" in found.verdict
    assert "the board tilted by 20 to 50 degrees, about both axes" in found.verdict


def test_noise_and_a_wrong_lens() -> None:
    noisy = dp.Views(LEFT.pixels + torch.randn(13, 54, 2), size=LEFT.size)
    assert "corners scatter by 1 px" in dp.calibrate(noisy, BOARD).verdict
    assert "sharper photographs" in dp.calibrate(noisy, BOARD).verdict
    bare = dp.calibrate(LEFT, BOARD, "none").verdict
    assert "this lens model does not fit the lens. Next: first the lens model that the remark" in bare
    assert "; the board in the top left" in bare  # what the lens alone does not mend


def test_a_view_that_fits_badly(calibration: dp.Calibration) -> None:
    pixels = LEFT.pixels.clone()
    pixels[6] += torch.randn(54, 2)
    assert (
        "another look at left07.jpg" in dp.calibrate(dp.Views(pixels, names=LEFT.names, size=LEFT.size), BOARD).verdict
    )
    assert "another look" not in calibration.verdict


def test_what_is_no_calibration(calibration: dp.Calibration) -> None:
    assert dp.calibrate(LEFT[0], BOARD, throw=False).verdict.startswith("Not usable: one view does not tell")
    located = dp.locate(LEFT[:2], BOARD, calibration.camera)
    assert located.verdict.startswith("Poses only, the camera was given")
    assert located.judgement.views == 0  # none is asked for
    both = dp.calibrate(dp.Views(torch.stack([LEFT.pixels, dp.example_views("right").pixels]), size=LEFT.size), BOARD)
    with pytest.raises(ValueError, match=r"verdict: want one camera, got batch shape \(2,\); index it"):
        _ = both.verdict
    assert both[0].verdict == calibration.verdict


@pytest.mark.parametrize("model", ["brown5", "none"])
def test_a_file_keeps_it(model: LensModel, tmp_path: Path) -> None:
    """With what its remarks say, of a lens that does not fit."""
    calibration = dp.calibrate(LEFT, BOARD, model)
    dp.save_camera(tmp_path / "camera.json", calibration)
    found = dp.load_calibration(tmp_path / "camera.json")
    assert (found.verdict, found.remarks) == (calibration.verdict, calibration.remarks)


def test_of_a_file_that_has_remarks_alone_these_are_read(calibration: dp.Calibration) -> None:
    fields = calibration.to_fields()
    del fields["findings"]
    assert dp.Calibration.from_fields(fields, calibration.camera).remarks == calibration.remarks != ("",)
    with pytest.raises(ValueError, match="remarks: want 1, one for each camera, got 2"):
        dp.Calibration.from_fields(fields | {"remarks": ["a", "b"]}, calibration.camera)


@pytest.mark.parametrize(
    ("kind", "next_"),
    [
        ("other lens", "Next: first the lens model that the remark on the residuals names; "),
        ("skew", "Next: first the skew that the remark on the residuals names; "),
        ("two cameras", "Next: first another look at the views that the remark names"),
        ("contradiction", "Next: the board in the top left"),
    ],
)
def test_advice_goes_by_what_a_remark_says_and_not_by_its_words(
    calibration: dp.Calibration, kind: str, next_: str
) -> None:
    remark = {"camera": 0, "kind": kind, "sentence": "in other words", "reason": "it is so"}
    found = dp.Calibration.from_fields(calibration.to_fields() | {"findings": [remark]}, calibration.camera)
    assert found.remarks == ("in other words",)
    assert found.verdict.startswith(f"Weak: it is so. {next_}")


def test_words_alone_give_no_advice(calibration: dp.Calibration) -> None:
    words = "as through another lens, 3 times what want another camera than"
    remark = {"camera": 0, "kind": "other", "sentence": words, "reason": ""}
    found = dp.Calibration.from_fields(calibration.to_fields() | {"findings": [remark]}, calibration.camera)
    assert found.verdict == calibration.verdict


def test_a_k_with_skew_is_named() -> None:
    cameras = dp.calibrate(LEFT, BOARD).cameras
    K = cameras.K.clone()
    K[..., 0, 1] = 30.0
    pixels, _ = dp.Camera(K, cameras.R, cameras.t, cameras.distortion).project(BOARD.points)
    views = dp.Views(pixels + 0.1 * torch.randn(pixels.shape, dtype=D), size=LEFT.size)
    verdict = dp.calibrate(views, BOARD).verdict
    assert "a K without skew does not fit the camera. Next: first the skew that the remark on the res" in verdict
    assert dp.calibrate(views, BOARD, skew=True).verdict.startswith("Good")


def test_a_board_seen_from_behind_leans_as_from_the_front() -> None:
    normals = torch.nn.functional.normalize(
        torch.tensor([[0.1, 0.2, 1], [-0.3, 0.1, 1], [0.2, -0.4, 1]], dtype=D), dim=-1
    )
    turned = normals * torch.tensor([[1.0], [-1], [-1]], dtype=D)
    assert _second_spread(turned) == pytest.approx(_second_spread(normals))
    along = torch.nn.functional.normalize(torch.tensor([[0.3, 0.0, 1], [-0.1, 0.0, 1]], dtype=D), dim=-1)
    assert _second_spread(along) == pytest.approx(0, abs=1e-9)  # leaning to the left and right alone


def test_a_normal_may_point_either_way() -> None:
    """Boards seen from behind have the normals of boards seen from in front, reversed: the spread is the same."""
    normals = torch.nn.functional.normalize(torch.randn(9, 3, dtype=torch.float64) + torch.tensor([0.0, 0, 3]), dim=-1)
    turned = normals * torch.tensor([1, -1, 1, 1, -1, -1, 1, -1, 1]).unsqueeze(-1)
    own = normals[:, :2] - normals[:, :2].mean(0)
    least = float(torch.linalg.svdvals(own)[-1]) / 3
    assert _second_spread(normals) == pytest.approx(least)
    assert _second_spread(turned) == pytest.approx(least)
