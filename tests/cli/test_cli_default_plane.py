"""The plane that commands take by themselves: z = 0, and a warning where the landmarks are all far above it."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj import cli

MAST = dp.Camera.mounted(9.0, 20.0, focal=700.0, size=(640, 480))
GROUND = torch.tensor([[-8.0, 20, 0], [9, 22, 0.1], [-6, 35, 0.3], [7, 30, -0.1], [0, 26, 0]], dtype=torch.float64)
TOLD = (
    "no plane is given, and z = 0, which is taken, is not where the landmarks are, from z = 511.9 to 512.3 m: if they "
    "stand on the ground, points and lengths on it come out wrong; give its height, such as --height 511.9, or "
    "--height 0 if z = 0 is meant"
)


@pytest.fixture
def mast(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A camera that was found from landmarks 512 m over the sea, and the photograph that shows them."""
    monkeypatch.chdir(tmp_path)
    world = GROUND + GROUND.new_tensor([0.0, 0.0, 512.0])
    pixels, camera = MAST.project(GROUND)[0], dp.Camera(MAST.K, size=MAST.size)
    dp.save_camera("camera.yaml", camera)
    rows = [",".join(f"{x:.4f}" for x in row) for row in torch.cat([pixels, world], dim=-1).tolist()]
    Path("survey.csv").write_text("\n".join(["u,v,x,y,z", *rows]))
    cv2.imwrite("mast.png", np.full((480, 640), 120, np.uint8))
    locate = ["locate", "mast.png", "--camera", "camera.yaml", "--landmarks", "survey.csv", "--pixel-sigma", "0.5"]
    assert cli.main([*locate, "--unit", "m", "-o", "located.json", "--quiet"]) == 0
    return "located.json"


def test_what_is_measured_far_below_the_ground_is_told(mast: str, capsys: pytest.CaptureFixture[str]) -> None:
    """4 m on the ground are 232 m on z = 0, with an error bar of one per cent."""
    ends = MAST.project(torch.tensor([[-2.0, 24, 0], [2, 24, 0]], dtype=torch.float64))[0].tolist()
    measure = ["measure", "--camera", mast, "--view", "mast.png", "--points", *(f"{u},{v}" for u, v in ends), "--json"]
    capsys.readouterr()
    for plane, length, warnings in (
        ([], 231.56, [TOLD]),
        (["--height", "0"], 231.56, []),
        (["--height", "512"], 4, []),
    ):
        assert cli.main([*measure, *plane]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["lengths"][0]["value"] == pytest.approx(length, abs=0.01)
        assert found["warnings"] == warnings


def test_pages_and_top_views_tell_it(mast: str, capsys: pytest.CaptureFixture[str]) -> None:
    shown = ["mast.png", "--camera", mast, "--view", "mast.png"]
    capsys.readouterr()
    assert cli.main(["measure", *shown, "--page", "page.html"]) == 0
    assert TOLD in capsys.readouterr().err
    assert cli.main(["rectify", *shown, "-o", "top.png"]) == 1
    assert TOLD in capsys.readouterr().err
    assert cli.main(["rectify", *shown, "-o", "top.png", "--height", "512m"]) == 0
    assert capsys.readouterr().err == ""
