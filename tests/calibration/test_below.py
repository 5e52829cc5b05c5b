"""Landmarks of a level plane in a left-handed frame: the camera comes to stand below them, and that is said."""

import re
from pathlib import Path

import pytest
import torch

import diffproj as dp
from diffproj import cli
from diffproj.calibration.results.remark import Kind

SIZE = (1920, 1080)
GROUND = torch.tensor([[x, y, 0.0] for x in (-5, 0, 5) for y in (0, 5, 12)], dtype=torch.float64)
ABOVE = dp.Camera.looking_at([0.0, -12.0, 6.0], [0.0, 6.0, 0.0], fov_deg=77.0, size=SIZE).to(torch.float64)
DRONE = dp.Camera.looking_at([1.0, 5.0, 30.0], [1.0, 5.5, 0.0], fov_deg=50.0, size=SIZE).to(torch.float64)
UTM = torch.tensor([642735.0, 8304292.0, 12.0], dtype=torch.float64)


def _located(camera, points, landmarks, **options):
    pixels, visible = camera.project(points)
    assert visible.all()
    noise = 0.3 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return dp.locate(
        dp.Views((pixels + noise)[None], size=SIZE, names=["mast.jpg"]), dp.Landmarks(landmarks), camera, **options
    )


def _said(found):
    return [remark.sentence for remark in found.findings[0] if remark.kind == Kind.BELOW]


@pytest.mark.parametrize("camera", [ABOVE, DRONE], ids=["mast", "drone"])
@pytest.mark.parametrize("offset", [torch.zeros(3, dtype=torch.float64), UTM], ids=["near", "far"])
@pytest.mark.parametrize("wrong", ["exchanged", "y"])
def test_left_handed_ground_is_told(camera, offset, wrong):
    """The camera stands 6 and 30 below it, with small residuals."""
    points = GROUND[:, [1, 0, 2]] if wrong == "exchanged" else GROUND * torch.tensor([1.0, -1.0, 1.0]).double()
    found = _located(camera, GROUND, points + offset)
    assert found.positions.points[0, 2] < offset[2] - 5
    assert found.rms < 1
    (said,) = _said(found)
    assert said.startswith("in mast.jpg the camera is below the landmarks' plane")
    assert "x and y are exchanged" in said
    assert said in found.message
    assert said in found.summary()
    assert found.doubts == ""  # points on the plane are right


@pytest.mark.parametrize("camera", [ABOVE, DRONE], ids=["mast", "drone"])
def test_right_ground_is_left_alone(camera):
    assert not _said(_located(camera, GROUND, GROUND + UTM))


def test_a_ceiling_and_walls_are_left_alone():
    """A camera that stands upright below a ceiling, and one before a wall, whichever way its normal points."""
    ceiling = GROUND + torch.tensor([0.0, 0, 9]).double()
    below = dp.Camera.looking_at([0.0, -9.0, 1.5], [0.0, 6.0, 9.0], fov_deg=77.0, size=SIZE).to(torch.float64)
    assert not _said(_located(below, ceiling, ceiling))
    wall = GROUND[:, [0, 2, 1]]  # x and z
    before = dp.Camera.looking_at([0.0, -14.0, 1.5], [0.0, 0.0, 6.0], fov_deg=77.0, size=SIZE).to(torch.float64)
    assert not _said(_located(before, wall, wall))
    behind = dp.Camera.looking_at([0.0, 14.0, 1.5], [0.0, 0.0, 6.0], fov_deg=77.0, size=SIZE).to(torch.float64)
    assert not _said(_located(behind, wall, wall))


def test_boards_are_left_alone():
    """Their z points away from the camera."""
    camera = dp.calibrate(dp.example_views("left"), dp.Chessboard()).camera
    found = dp.locate(dp.example_views("left")[:1], dp.Chessboard(), camera)
    assert not _said(found)


def test_what_a_prior_contradicts_is_told_beside_it():
    """That the camera is 6 above the ground, where it is found 6 below."""
    found = _located(ABOVE, GROUND, GROUND[:, [1, 0, 2]], priors={"height": (6.0, 1.0)}, pixel_sigma=0.3)
    assert "look for a wrong prior" in found.remarks[0]
    assert len(_said(found)) == 1
    assert "below the landmarks" not in found.contradiction


def test_the_command_warns(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    dp.save_camera(tmp_path / "camera.json", ABOVE.without_pose())
    pixels, _ = ABOVE.project(GROUND)
    for name, columns in (("right.csv", "u,v,x,y"), ("exchanged.csv", "u,v,y,x")):
        rows = torch.cat([pixels, GROUND[:, :2]], dim=1).tolist()
        (tmp_path / name).write_text("\n".join([columns, *(",".join(map(repr, row)) for row in rows)]))
        given = ["locate", "--camera", str(tmp_path / "camera.json"), "--landmarks", str(tmp_path / name)]
        assert cli.main([*given, "--pixel-sigma", "0.5"]) == 0
        told = re.sub(r"\s+", " ", capsys.readouterr().err)
        assert ("below the landmarks' plane" in told) == (name == "exchanged.csv")


def test_adjust_tells_it_too():
    """Whose world has z up: six level landmarks with x and y exchanged leave small residuals, 6 below the ground."""
    pixels = ABOVE.project(GROUND)[0]
    right = dp.adjust(ABOVE, dp.Seen(GROUND, pixels, 0.5))
    assert "below all landmarks" not in right.message
    wrong = dp.adjust(ABOVE, dp.Seen(GROUND[:, [1, 0, 2]], pixels, 0.5))
    assert float(wrong.mounting.height) < -5
    assert "the camera is below all landmarks and not upright: are x and y exchanged" in wrong.message
    assert "below all landmarks" in wrong.summary()
    both = dp.adjust(dp.stack([ABOVE, ABOVE]), dp.Seen(GROUND, torch.stack([pixels, pixels.flip(0)]), 0.5), throw=False)
    assert "below" not in both.remarks[0]
    ceiling = GROUND + torch.tensor([0.0, 0, 9]).double()
    looks_up = dp.Camera.looking_at([0.0, -9.0, 1.5], [0.0, 6.0, 9.0], fov_deg=77.0, size=SIZE).to(torch.float64)
    assert not any(dp.adjust(looks_up, dp.Seen(ceiling, looks_up.project(ceiling)[0], 0.5)).remarks)
