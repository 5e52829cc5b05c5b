"""Boards of every kind on the command line: printed, calibrated with, and measured on."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from tests.cli.commands import runner

GIVEN = ("--charuco", "6x5", "--square", "20mm", "--marker", "15", "--dictionary", "4X4_50")


run = runner()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs of a ChArUco board."""
    place = tmp_path_factory.mktemp("charuco")
    board = dp.CharucoBoard(6, 5, 20.0, 15.0, "4X4_50")
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]], dtype=torch.float64)
    cameras = dp.synthetic.random_cameras(dp.Camera(K, size=(320, 240)), board, 5, distance=(1.3, 2.0), seed=4)
    for number, image in enumerate(dp.synthetic.photograph(cameras, board)):
        assert cv2.imwrite(str(place / f"view{number}.png"), image.numpy())
    return place


def test_calibrate_and_measure(folder, tmp_path, capsys):
    camera = str(tmp_path / "camera.json")
    code, out, err = run(capsys, "calibrate", str(folder), *GIVEN, "--distortion", "none", "-o", camera)
    assert code == 0, err
    assert abs(float(dp.load_camera(camera).K[0, 0]) - 300) < 5
    photo = str(folder / "view0.png")
    code, out, err = run(
        capsys, "measure", photo, "--camera", camera, *GIVEN, "--points", "150,120", "170,120", "--json"
    )
    assert code == 0, err
    assert json.loads(out)["unit"] == "mm"


def test_a_page(tmp_path, capsys):
    page = tmp_path / "board.png"
    code, out, _ = run(
        capsys, "board", str(page), "--aprilgrid", "4x3", "--tag", "2cm", "--spacing", "0.3", "--dpi", "100"
    )
    assert (code, "measure its ruler" in out) == (0, True)
    image = cv2.GaussianBlur(cv2.imread(str(page), cv2.IMREAD_GRAYSCALE), (0, 0), 1)
    found = dp.detect(image, dp.AprilGrid(4, 3, 20.0, 0.3))
    step = (found.pixels[0, 1] - found.pixels[0, 0]).norm()
    assert float(step) / 100 * 25.4 == pytest.approx(20, abs=0.02)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--charuco", "6x5", "--square", "20mm"), 2, "--marker: want it along with --charuco, got none"),
        (("--board", "6x5", "--square", "20mm", "--tag", "5"), 2, "--tag: goes with --aprilgrid, not with --board"),
        (
            ("--aprilgrid", "6x6", "--tag", "8mm", "--spacing", "2mm"),
            2,
            "--spacing: want the gap between tags relative",
        ),
        (("--charuco", "6", "--square", "20mm"), 2, "--charuco: want numbers as COLUMNSxROWS"),
        ((*GIVEN[:-1], "5X9"), 1, "--dictionary: want one of 4X4_100, .*, got '5X9'"),
        (
            ("--circles", "7x5", "--spacing", "20mm", "--diameter", "2m"),
            1,
            "--diameter: want circles apart",
        ),
        (
            ("--circles", "7x5", "--spacing", "20", "--diameter", "2mm"),
            1,
            "--diameter: want it in the unit of the board",
        ),
        (("--board", "9x6", "--square", "5cm"), 1, "the largest square that fits is 25.1 mm"),
        (
            ("--board", "9x6", "--square", "5cm"),
            1,
            "a larger paper takes more, such as --paper 520,384 of a print shop",
        ),
        (("--board", "9x6", "--square", "5mm", "--paper", "B9"), 1, "--paper: want one of A0"),
        (("--target", "none.yaml"), 1, "none.yaml: No such file"),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, arguments, code, message):
    got, _, err = run(capsys, "board", str(tmp_path / "board.pdf"), *arguments)
    assert got == code
    assert np.all([part in err.replace("\n", " ") for part in message.split(", .*, ")]), err
    assert not (tmp_path / "board.pdf").exists()
