"""Printed pages: true scale, a board that is found in them, and a refusal of what does not fit."""

import re
import shutil
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pytest

import diffproj as dp

BOARDS = {
    "chessboard": dp.Chessboard(9, 6, 25.0),
    "charuco": dp.CharucoBoard(8, 6, 25.0, 18.0, "5X5_100"),
    "april": dp.AprilGrid(6, 6, 22.0, 0.3),
    "circles": dp.CircleGrid(11, 4, 20.0, 15.0, asymmetric=True),
}


def scale_and_error(image: np.ndarray, board: object, dpi: float) -> tuple[float, float]:
    """Found over true size, and how far in px the points lie from where a print at scale has them."""
    found = dp.detect(cv2.GaussianBlur(image, (0, 0), 1.0), board)
    assert bool(found.visible.all())
    world, seen = board.points[:, :2].numpy(), found.pixels[0].numpy()
    design = np.column_stack([world, np.ones(len(world))])
    solution, *_ = np.linalg.lstsq(design, seen, rcond=None)
    scale = np.sqrt(abs(np.linalg.det(solution[:2]))) / dpi * 25.4
    return float(scale), float(np.abs(design @ solution - seen).max())


@pytest.mark.parametrize("kind", BOARDS)
def test_a_print_is_found_at_true_scale(tmp_path, kind):
    """Measured: 0.00002 off, most of it the finder's."""
    dp.draw_target(BOARDS[kind], tmp_path / "board.png", dpi=100)
    image = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert sorted(image.shape) == [826, 1169]
    scale, off = scale_and_error(image, BOARDS[kind], 100)
    assert scale == pytest.approx(1, abs=2e-4)
    assert off < 0.1


@pytest.mark.parametrize("paper", ["A4", "letter"])
def test_a_pdf_has_the_papers_size(tmp_path, paper):
    dp.draw_target(BOARDS["charuco"], tmp_path / "board.pdf", paper)
    content = (tmp_path / "board.pdf").read_bytes()
    box = [float(number) for number in re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content).groups()]
    want = {"A4": (297, 210), "letter": (279.4, 215.9)}[paper]
    assert box == pytest.approx([side / 25.4 * 72 for side in want], abs=1e-6)


@pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="pdftoppm is not installed")
@pytest.mark.parametrize("kind", BOARDS)
def test_a_pdf_is_found_at_true_scale(tmp_path, kind):
    dp.draw_target(BOARDS[kind], tmp_path / "board.pdf")
    subprocess.run(["pdftoppm", "-r", "100", "-png", "-singlefile", "board.pdf", "page"], cwd=tmp_path, check=True)
    image = cv2.imread(str(tmp_path / "page.png"), cv2.IMREAD_GRAYSCALE)
    scale, off = scale_and_error(image, BOARDS[kind], 100)
    assert scale == pytest.approx(1, abs=2e-4)
    assert off < 0.1


def test_units(tmp_path):
    """The same board in metres and in millimetres gives the same page."""
    for unit, factor in (("mm", 1.0), ("m", 0.001)):
        board = dp.AprilGrid(6, 6, 22 * factor, 0.3)
        dp.draw_target(board, tmp_path / f"{unit}.png", dpi=60, unit=unit)
    mm, m = (cv2.imread(str(tmp_path / f"{unit}.png"), 0)[:600] for unit in ("mm", "m"))
    assert np.abs(mm.astype(int) - m).max() <= 1


@pytest.mark.parametrize("kind", BOARDS)
def test_a_board_finer_than_printers_print_is_told(tmp_path, kind):
    """Sides in metres, taken to be in mm, gave a page with a dot, and nothing was said."""
    sides = ("square", "marker", "tag", "diameter", *(["spacing"] if kind == "circles" else []))
    small = replace(BOARDS[kind], **{k: getattr(BOARDS[kind], k) / 1000 for k in sides if hasattr(BOARDS[kind], k)})
    with pytest.warns(UserWarning, match=r"finest parts are 0\.0[\d]+ mm wide, .* is it described in mm\?"):
        dp.draw_target(small, tmp_path / "board.svg")
    dp.draw_target(small, tmp_path / "board.svg", unit="m")


@pytest.mark.plain  # the checks of types put frames of their own between
def test_the_warning_points_at_the_caller_s_line_through_the_package(tmp_path):
    small, inside = dp.Chessboard(9, 6, 0.025), {"__name__": "diffproj.room.part", "dp": dp}
    exec("def draw(board, path):\n    dp.draw_target(board, path)", inside)  # noqa: S102
    with pytest.warns(UserWarning, match="finest parts") as seen:
        inside["draw"](small, tmp_path / "board.svg")
    assert [warning.filename for warning in seen] == [__file__]


def test_what_does_not_fit_is_refused_with_what_does(tmp_path):
    with pytest.raises(ValueError, match=r"such as paper=\(770, 534\) of a print shop\. A board goes on one page"):
        dp.draw_target(dp.Chessboard(14, 9, 50.0), tmp_path / "big.pdf")
    dp.draw_target(dp.Chessboard(14, 9, 50.0), tmp_path / "big.pdf", paper=(770, 534))
    with pytest.raises(ValueError, match=r"277 x 176 mm on A4 .*, got 360 x 270 mm; the largest square .* 19\.5 mm"):
        dp.draw_target(dp.Chessboard(11, 8, 30.0), tmp_path / "board.pdf")
    dp.draw_target(dp.Chessboard(11, 8, 19.5), tmp_path / "board.pdf")
    with pytest.raises(ValueError, match="paper: want one of A0, .*, got 'B4'"):
        dp.draw_target(dp.Chessboard(), tmp_path / "board.pdf", "B4")
    with pytest.raises(ValueError, match="path: want a file ending in .pdf, .svg, .png, got"):
        dp.draw_target(dp.Chessboard(), tmp_path / "board.jpg")


def test_a_picture_that_no_memory_holds_is_refused(tmp_path):
    """A0 at 5000 dpi ended in a MemoryError."""
    with pytest.raises(
        ValueError, match=r"dpi: want at most 622 for a \.png of 1189 x 841 mm, got 5000; a \.pdf or \.svg"
    ):
        dp.draw_target(dp.Chessboard(), tmp_path / "board.png", "A0", dpi=5000)
    assert not list(tmp_path.iterdir())
    dp.draw_target(dp.Chessboard(), tmp_path / "board.svg", "A0", dpi=5000)
