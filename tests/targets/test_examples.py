"""The bundled corners: what they are, how well they fit a camera, and that they are what the photographs show."""

import json
import os
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from diffproj.targets.__main__ import main
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.detection import BoardNotFoundWarning, detect
from diffproj.targets.examples import NUMBERS, example_views, photographs, regenerate

SIDES = ("left", "right")


def record(side):
    return json.loads(resources.files("diffproj.targets").joinpath("data", f"{side}.json").read_text(encoding="utf-8"))


def fitted(side):
    """OpenCV's calibration of one camera with 5 coefficients: RMS in px, and the rotation and translation per view."""
    views = example_views(side)
    points = Chessboard().points.numpy().astype(np.float32)
    pixels = [view.numpy().astype(np.float32).reshape(-1, 1, 2) for view in views.pixels]
    rms, _, _, rotations, translations = cv2.calibrateCamera([points] * len(views), pixels, views.size, None, None)
    return rms, [cv2.Rodrigues(rotation)[0] for rotation in rotations], [t.ravel() for t in translations]


@pytest.mark.parametrize("side", SIDES)
def test_what_they_are(side):
    views = example_views(side)
    assert views.pixels.shape == (13, 54, 2)
    assert views.dtype == torch.float64
    assert views.size == (640, 480)
    assert views.visible.all()
    assert views.names == tuple(f"{side}{number:02d}.jpg" for number in NUMBERS)
    assert (views.pixels > 0).all()
    assert (views.pixels < torch.tensor([639.0, 479.0])).all()


@pytest.mark.parametrize("side", SIDES)
def test_provenance(side):
    """The file itself says where its numbers come from and how to make them again."""
    said = record(side)
    assert said["source"] == {
        "distribution": "Debian",
        "package": "opencv-doc",
        "version": "4.6.0",
        "folder": "examples/data",
    }
    assert said["board"] == {"columns": 9, "rows": 6, "square_mm": 25.0}
    assert said["regenerate"] == "python -m diffproj.targets FOLDER"
    assert said["measured_by"]["opencv"]


@pytest.mark.parametrize(("side", "expected"), [("left", 0.1583), ("right", 0.1560)])
def test_they_fit_a_camera(side, expected):
    """`cv2.cornerSubPix` gives 0.177 and 0.181 at best, one wrong corner more than 0.2."""
    assert fitted(side)[0] == pytest.approx(expected, abs=5e-4)


def test_a_corner_keeps_its_number_over_all_views():
    """The right camera's pose relative to the left one is the same in every pair.

    Had one view of a pair the reversed order, its relative rotation would be off by 180 degrees. A pair reversed on
    both sides would pass here; the colours of the squares, which the tests of `detect` hold, decide that.
    """
    (_, R_left, t_left), (_, R_right, t_right) = fitted("left"), fitted("right")
    R = [right @ left.T for left, right in zip(R_left, R_right, strict=True)]
    t = np.array([right - turn @ left for left, right, turn in zip(t_left, t_right, R, strict=True)])
    angles = [np.degrees(np.linalg.norm(cv2.Rodrigues(turn @ R[0].T)[0])) for turn in R]
    assert max(angles) < 1.0
    assert np.abs(t - np.median(t, axis=0)).max() < 2.0  # mm, of a base of 83


def test_an_unknown_side():
    with pytest.raises(ValueError, match="side: want one of 'left', 'right', got 'middle'"):
        example_views("middle")


# ----------------------------------------------------------------------------------------- against the photographs

PHOTOGRAPHS = Path(os.environ.get("DIFFPROJ_PHOTOS", "/usr/share/doc/opencv-doc/examples/data"))
needs_photographs = pytest.mark.skipif(
    not (PHOTOGRAPHS / "left01.jpg").exists(),
    reason="no photographs here; `apt-get download opencv-doc && dpkg-deb -x opencv-doc_*.deb FOLDER` brings them, "
    "then set DIFFPROJ_PHOTOS=FOLDER/usr/share/doc/opencv-doc/examples/data",
)


TOLERANCE = 0.001
"""In px. OpenCV 4.10 and 5.0 gave the same corners to the last digit that is written."""

TURNED = 0.03
"""In px, for photographs that are turned: measured 0.02 at most, 0.0001 in the median. The fit starts elsewhere, and ends
when its steps are small."""


@needs_photographs
@pytest.mark.parametrize("side", SIDES)
def test_they_are_what_the_photographs_show(side):
    measured, shipped = detect(photographs(PHOTOGRAPHS, side), Chessboard()), example_views(side)
    assert measured.names == shipped.names
    assert (measured.pixels - shipped.pixels).norm(dim=-1).max() < TOLERANCE


@needs_photographs
@pytest.mark.parametrize("quarters", [1, 2, 3])
@pytest.mark.parametrize("side", SIDES)
def test_the_order_follows_the_board_when_photographs_are_turned(side, quarters):
    """Each corner keeps its number."""
    images = [
        np.rot90(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), quarters) for file in photographs(PHOTOGRAPHS, side)
    ]
    turned = detect(images, Chessboard()).pixels
    expected = example_views(side).pixels
    width, height = 640, 480
    for _ in range(quarters):
        expected = torch.stack([expected[..., 1], width - 1 - expected[..., 0]], dim=-1)
        width, height = height, width
    distance = (turned - expected).norm(dim=-1)
    assert distance.median() < 0.001
    assert distance.max() < TURNED


# --------------------------------------------------------------------------------------------------- regenerating


@pytest.fixture
def folder(tmp_path):
    """26 files under the right names, all of the same drawn board."""
    squares = np.indices((7, 10)).sum(axis=0) % 2
    image = np.full((340, 460), 255, dtype=np.uint8)
    image[30:310, 30:430] = np.kron(squares, np.ones((40, 40))) * 255
    folder = tmp_path / "photographs"
    folder.mkdir()
    for side in SIDES:
        for file in photographs(folder, side):
            assert cv2.imwrite(str(file), image)
    return folder


@pytest.fixture
def target(tmp_path):
    target = tmp_path / "target"
    target.mkdir()
    return target


def test_regenerate(folder, target, capsys):
    assert main([str(folder), "--target", str(target)]) == 0
    said = capsys.readouterr()
    assert said.out.split() == [str(target / "left.json"), str(target / "right.json")]
    assert said.err.endswith("26 of 26 photographs\n")
    assert sorted(file.name for file in target.iterdir()) == ["left.json", "right.json"]
    for side in SIDES:
        written = json.loads((target / f"{side}.json").read_text(encoding="utf-8"))
        assert {key: value for key, value in written.items() if key not in ("measured_by", "views", "size_px")} == {
            key: value for key, value in record(side).items() if key not in ("measured_by", "views", "size_px")
        }
        assert written["measured_by"] == {**record(side)["measured_by"], "opencv": cv2.__version__}
        assert written["size_px"] == [460, 340]
        assert [view["file"] for view in written["views"]] == [file.name for file in photographs(folder, side)]
        corners = np.array([view["corners_px"] for view in written["views"]])
        assert corners.shape == (13, 6, 9, 2)
        assert np.abs(corners[:, 2, 3] - (69.5 + 40 * 3, 69.5 + 40 * 2)).max() < 0.01


@pytest.mark.filterwarnings("ignore::diffproj.BoardNotFoundWarning")
def test_regenerate_writes_nothing_unless_all_is_well(folder, target, capsys):
    (target / "left.json").write_text("as it was")
    assert cv2.imwrite(str(folder / "right14.jpg"), np.zeros((340, 460), dtype=np.uint8))
    with pytest.raises(ValueError, match="want the board in all 26 photographs, found it in 25"):
        regenerate(folder, target)
    (folder / "right14.jpg").unlink()
    assert main([str(folder), "--target", str(target)]) == 1
    assert "right14.jpg" in capsys.readouterr().err
    assert [(file.name, file.read_text()) for file in target.iterdir()] == [("left.json", "as it was")]


def test_regenerate_names_what_was_missed(folder, target):
    assert cv2.imwrite(str(folder / "left02.jpg"), np.zeros((340, 460), dtype=np.uint8))
    with pytest.warns(BoardNotFoundWarning, match=r"left02\.jpg"), pytest.raises(ValueError, match="all 26"):
        regenerate(folder, target)


@needs_photographs
def test_the_shipped_files_come_from_the_command(target):
    """Regenerating from the photographs gives the shipped files: the same text, with the same OpenCV."""
    regenerate(PHOTOGRAPHS, target)
    for side in SIDES:
        written = json.loads((target / f"{side}.json").read_text(encoding="utf-8"))
        shipped = record(side)
        difference = np.subtract(
            [view["corners_px"] for view in written.pop("views")], [view["corners_px"] for view in shipped.pop("views")]
        )
        assert np.abs(difference).max() < TOLERANCE
        assert written.pop("measured_by")["function"] == shipped.pop("measured_by")["function"]
        assert written == shipped
