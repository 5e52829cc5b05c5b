"""Whatever is given to a command: one line names the argument or the file and what to do, and nothing is written."""

import io
import json
import re
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import diffproj as dp
from diffproj import cli, synthetic

BOARD = ("--board", "8x5", "--square", "25mm")
POINTS = ("--points", "210,133", "402,140")
VIEW = ("measure", "--camera", "camera.json", "--view", "1.png")
TOP = ("rectify", "photo.png", *BOARD)
PHOTO = ("measure", "photo.png", *BOARD, *POINTS, "--camera")


def changed(document: dict[str, Any], room: str, key: str, value: Any) -> str:
    """A camera file with one thing in it replaced."""
    return json.dumps({**document, room: {**document[room], key: value}})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photograph, a camera file, and files of all kinds that are not what they should be."""
    folder = tmp_path_factory.mktemp("bad")
    setup, board = dp.paper_setup(), dp.Chessboard(8, 5, 25.0)
    upright = dp.Chessboard(8, 5, 25.0, axes="paper")
    cv2.imwrite(str(folder / "photo.png"), synthetic.photograph(setup.test[3], upright).numpy())
    cv2.imwrite(str(folder / "grey.png"), np.full((480, 640), 90, np.uint8))
    cv2.imwrite(str(folder / "small.png"), np.full((240, 320), 90, np.uint8))
    seen = synthetic.corner_views(setup.fit, upright)
    views = dp.Views(seen.pixels, seen.visible, [f"{i}.png" for i in range(1, 11)], seen.size)
    dp.save_camera(folder / "camera.json", dp.calibrate(views, board, "none"))
    document = json.loads((folder / "camera.json").read_text())
    (folder / "no_points.json").write_text(changed(document, "calibration", "points", []))
    (folder / "no_used.json").write_text(changed(document, "calibration", "used", []))
    (folder / "odd_unit.json").write_text(changed(document, "calibration", "unit", 5))
    (folder / "no_camera.json").write_text(changed(document, "camera", "K", None))
    (folder / "newer.json").write_text(json.dumps({**document, "version": 99}))
    (folder / "half.json").write_text((folder / "camera.json").read_text()[:2000])
    (folder / "list.json").write_text("[1, 2]")
    (folder / "number.yaml").write_text("%YAML:1.0\n---\ncamera_matrix: 5\n")
    (folder / "other.yaml").write_text("%YAML:1.0\n---\nhello: 5\n")
    for name in ("noise.json", "noise.yaml", "noise.xml", "noise.csv", "noise.png"):
        (folder / name).write_bytes(bytes([200, 13, 7, 255, 0, 60]) * 40)
    for name in (
        "empty.json",
        "empty.yaml",
        "empty.xml",
        "empty.csv",
        "empty.png",
        "phone.heic",
        "raw.cr2",
        "film.mp4",
    ):
        (folder / name).touch()
    (folder / "short.csv").write_text("a,1\nb,2\n")
    (folder / "twice.csv").write_text("a,1,2\na,3,4\n")
    (folder / "titles.csv").write_text("name,u,v\n")
    (folder / "nan.csv").write_text("a,1,2\nb,nan,2\n")
    (folder / "nul.csv").write_bytes(b"a,1,2\n\0,1,2\n")
    for name in ("nothing", "phones", "broken", "folder.json", "folder.png"):
        (folder / name).mkdir()
    (folder / "phones" / "1.HEIC").touch()
    (folder / "outer" / "inner").mkdir(parents=True)
    (folder / "outer" / "inner" / "1.jpg").touch()
    (folder / "broken" / "1.jpg").touch()
    return folder


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}


CASES: list[tuple[tuple[str, ...], int, str]] = [
    ((), 2, "arguments are required: COMMAND"),
    (("nonsense",), 2, "COMMAND: invalid choice: 'nonsense'"),
    (("help", "nonsense"), 2, "COMMAND: invalid choice: 'nonsense'"),
    (("--nonsense",), 2, "COMMAND"),
    # Photographs.
    (("calibrate", "nowhere.png", *BOARD), 1, "no such file: nowhere.png"),
    (("calibrate", "", *BOARD), 2, "PHOTO: want the name of a file, got ''"),
    (("calibrate", "nothing", *BOARD), 1, r"nothing: want a folder with photographs \(\.bmp, .*\), found none in it"),
    (("calibrate", "outer", *BOARD), 1, "outer: .* found none in it; there are in outer/inner: name that"),
    (("calibrate", "phones", *BOARD), 1, "phones: .* found none in it; it holds 1 HEIC .* convert to JPEG"),
    (("calibrate", "phone.heic", *BOARD), 1, r"phone\.heic: HEIC .* convert to JPEG in full size"),
    (("calibrate", "phone*", *BOARD), 1, r"phone\.heic: HEIC .* convert to JPEG in full size|phones"),
    (("calibrate", "raw.cr2", *BOARD), 1, r"raw\.cr2: raw photograph, .* convert to TIFF"),
    (("calibrate", "broken", *BOARD), 1, "broken: .* its 1 image file cannot be read"),
    (("calibrate", "noise.png", *BOARD), 1, r"noise\.png: want an image"),
    (("calibrate", "empty.png", *BOARD), 1, r"empty\.png: want an image"),
    (("calibrate", "nothing/*.jpg", *BOARD), 1, r"want at least one, got none in 'nothing/\*\.jpg'"),
    (("calibrate", "grey.png", *BOARD), 1, r"want a board with 8 x 5 inner corners, found none in grey\.png\. Check"),
    (("calibrate", "photo.png", "small.png", *BOARD), 1, r"want one size, got .*photo\.png and .*small\.png"),
    (("calibrate", "photo.png", *BOARD), 1, "add views (with the board )?tilted by 20 to 50 degrees about both axes$"),
    # The board.
    (("calibrate", "photo.png", "--board", "9", "--square", "25"), 2, "--board: want inner corners as COLUMNSxROWS"),
    (("calibrate", "photo.png", "--board", "9x2", "--square", "25"), 2, "--board: want at least 3x3"),
    (("calibrate", "photo.png", "--board", "9x99999", "--square", "25"), 2, "--board: want at most 1000"),
    (("calibrate", "photo.png", "--board", f"9x{'9' * 5000}", "--square", "25"), 2, "--board: want inner corners"),
    (("calibrate", "photo.png", "--board", "8x5", "--square", "0mm"), 2, "--square: want the side .* such as 25mm"),
    (("calibrate", "photo.png", "--board", "8x5", "--square", "25px"), 2, "--square: want one of the units um, .*, ft"),
    (("calibrate", "photo.png", "--board", "8x5", "--square", "1e-300"), 2, "--square: want the side of a square"),
    (("calibrate", "photo.png", "--board", "8x5", "--square", "1e300m"), 2, "--square: want the side of a square"),
    (("calibrate", "photo.png", "--board", "8x5", "--square", "mm"), 2, "--square: want the side of a square"),
    (("calibrate", "photo.png", *BOARD, "--distortion", "brown6"), 2, "--distortion: invalid choice: 'brown6'"),
    # Places to write to.
    (("calibrate", "photo.png", *BOARD, "-o", "camera.txt"), 2, r"--output: want a file ending in \.json"),
    (("calibrate", "photo.png", *BOARD, "--skew", "-o", "a.yaml"), 2, "--output: want a .json with --skew"),
    (("calibrate", "photo.png", *BOARD, "-o", "gone/camera.json"), 1, "--output: no such folder: gone; make it"),
    (("calibrate", "photo.png", *BOARD, "-o", "folder.json"), 1, "--output: want a file, got a folder"),
    (("calibrate", "photo.png", *BOARD, "--draw", "a.gif"), 2, r"--draw: want a file ending in \.png, \.svg, \.pdf"),
    (("calibrate", "photo.png", *BOARD, "--draw", "gone/a.png"), 1, "--draw: no such folder: gone; make it"),
    (("calibrate", "photo.png", *BOARD, "--draw", "folder.png"), 1, "--draw: want a file, got a folder"),
    (
        ("calibrate", "photo.png", *BOARD, "--draw", "photo.png"),
        1,
        "--draw: want another file than those that are read",
    ),
    ((*PHOTO, "camera.json", "--draw", "./photo.png"), 1, "--draw: want another file than those that are read"),
    ((*VIEW, *POINTS, "--draw", "gone/a.pdf"), 1, "--draw: no such folder: gone; make it"),
    (("experiment", "--output", "list.json"), 1, "--output: want a folder, got the file .*list.json"),
    (("experiment", "--output", "list.json/results"), 1, "--output: want a folder, got the file .*list.json"),
    # Camera files.
    *(
        ((*PHOTO, name), 1, rf"{re.escape(name)}: {message}")
        for name, message in {
            "gone.json": "No such file or directory; check its name",
            "gone.yaml": "No such file or directory; check its name",
            "folder.json": "want a file, got a folder",
            "noise.json": "want a camera file, got a binary one of an unknown kind",
            "noise.yaml": "want a camera file, got a binary one of an unknown kind",
            "noise.xml": "want a camera file, got a binary one of an unknown kind",
            "empty.json": "want a camera file, got an empty one",
            "empty.yaml": "want a camera file, got an empty one",
            "empty.xml": "want a camera file, got an empty one",
            "half.json": "want a camera file, got one that is no format known here",
            "list.json": "want a camera matrix under a known name, such as camera_matrix",
            "newer.json": r"want version \d or earlier, got 99; a newer diffproj reads it",
            "number.yaml": "camera_matrix: want 3 x 3 numbers, got 5",
            "other.yaml": "want a camera matrix under a known name, such as camera_matrix",
            "photo.png": "want a camera file, got a photograph",
            "no_camera.json": "the camera in this file is damaged",
            "no_points.json": "the calibration in this file is damaged",
            "no_used.json": "the calibration in this file is damaged",
            "odd_unit.json": r"the calibration in this file is damaged \(unit: want a text",
        }.items()
    ),
    (("info", "gone.json"), 1, "gone.json: No such file or directory; check its name"),
    (("info", "photo.png"), 1, "photo.png: want a camera file, got a photograph"),
    (("info", ""), 2, "FILE: want the name of a file"),
    (("info",), 2, "the following arguments are required: FILE"),
    (("convert", "gone.json", "new.yaml"), 1, "gone.json: No such file or directory; check its name"),
    (("convert", "empty.json", "new.yaml"), 1, "empty.json: want a camera file, got an empty one"),
    (("convert", "camera.json", "new.doc"), 1, r"new\.doc"),
    (("convert", "camera.json", "gone/new.yaml"), 1, "gone"),
    (("convert", "camera.json", "folder.json"), 1, r"folder\.json"),
    (("convert", "camera.json"), 2, "the following arguments are required: OUT"),
    (("convert", "camera.json", "new.yaml", "--size", "1x"), 2, "--size: want the size of the image as WIDTHxHEIGHT"),
    # Points.
    (VIEW, 2, "one of the arguments --points --points-file --page is required"),
    ((*VIEW, "--points"), 2, "--points: expected at least one argument"),
    ((*VIEW, "--points", "1;2"), 2, "--points: want pixels as u,v without a space"),
    ((*VIEW, "--points", "inf,2"), 2, "--points: want pixels as u,v"),
    ((*VIEW, "--points", "short.csv"), 2, "got 'short.csv'; a file of them goes with --points-file"),
    ((*VIEW, "--points", "1e300,2"), 2, "--points: want pixels as u,v"),
    ((*VIEW, *POINTS, "--points-file", "short.csv"), 2, "--points-file: not allowed with argument --points"),
    *(
        ((*VIEW, "--points-file", name), code, message)
        for name, code, message in (
            ("", 2, "--points-file: want the name of a file"),
            ("gone.csv", 1, "gone.csv: No such file or directory; check its name"),
            ("nothing", 1, "nothing: Is a directory; want a file"),
            ("noise.csv", 1, "--points-file: want a text file in UTF-8, got something else in noise.csv"),
            ("empty.csv", 1, "--points-file: want lines of name,u,v, found none in empty.csv"),
            ("titles.csv", 1, "--points-file: want lines of name,u,v, found none in titles.csv"),
            ("short.csv", 1, "--points-file: want lines of name,u,v, got 'a,1' in line 1 of short.csv"),
            ("nan.csv", 1, "--points-file: want lines of name,u,v, got 'b,nan,2' in line 2 of nan.csv"),
            ("nul.csv", 1, "--points-file: want lines of name,u,v, got .* in line 2 of nul.csv|in nul.csv"),
            ("twice.csv", 1, "--points-file: want each name once, got 'a' again in line 2 of twice.csv"),
        )
    ),
    # What is measured on.
    ((*VIEW, *POINTS, "--plane", "1,2,3"), 2, "--plane: want a plane a x"),
    ((*VIEW, *POINTS, "--plane", "0,0,1e-320,1"), 2, "--plane: want a plane a x"),
    (
        (*VIEW, *POINTS, "--height", "12mm"),
        1,
        "--height: want it in the calibration's unit, got 12 mm; leave its unit out",
    ),
    ((*VIEW, *POINTS, "--height", "12px"), 2, "--height: want one of the units um, "),
    ((*VIEW, *POINTS, "--height", "1,5"), 2, "--height: want a height as a number"),
    ((*VIEW, *POINTS, "--height", "nan"), 2, "--height: want a height"),
    ((*VIEW, *POINTS, "--height", "1", "--plane", "0,0,1,0"), 2, "--plane: not allowed with argument --height"),
    ((*VIEW, *POINTS, "--pixel-sigma", "-1"), 2, "--pixel-sigma: want a positive number of pixels, .* or detector"),
    ((*VIEW, *POINTS, "--pixel-sigma", "auto"), 2, "--pixel-sigma: want a positive number of pixels"),
    ((*VIEW, *POINTS, "--json", "--csv"), 2, "--csv: not allowed with argument --json"),
    (
        ("measure", "nothing", *BOARD, *POINTS, "--camera", "camera.json"),
        1,
        "PHOTO: want one photograph, got the folder",
    ),
    (("measure", "phone.heic", *BOARD, *POINTS, "--camera", "camera.json"), 1, "convert to JPEG in full size"),
    (("measure", "grey.png", *BOARD, *POINTS, "--camera", "camera.json"), 1, r"found none in grey\.png\. Check"),
    # Rectify.
    (("rectify", "--camera", "camera.json", *BOARD), 2, "PHOTO: want the photograph, got none"),
    ((*TOP, "--camera", "gone.json"), 1, "gone.json: No such file or directory; check its name"),
    ((*TOP, "--camera", "empty.json"), 1, "empty.json: want a camera file, got an empty one"),
    (("rectify", "gone.png", "--camera", "camera.json", *BOARD), 1, "no such file: gone.png"),
    (
        ("rectify", "nothing", "--camera", "camera.json", *BOARD),
        1,
        "PHOTO: want one photograph, got the folder nothing",
    ),
    (("rectify", "empty.png", "--camera", "camera.json", *BOARD), 1, r"empty\.png: want an image, got 0 bytes"),
    (("rectify", "noise.png", "--camera", "camera.json", *BOARD), 1, r"noise\.png: want an image"),
    (
        ("rectify", "[pg][hr]*.png", "--camera", "camera.json", *BOARD),
        1,
        r"PHOTO: want one photograph, got \d of the form",
    ),
    (("rectify", "film.mp4", "--camera", "camera.json", *BOARD), 1, "want a photograph, got the video film.mp4; save"),
    (("rectify", "grey.png", "--camera", "camera.json", *BOARD), 1, r"found none in grey\.png\. Check"),
    ((*TOP, "--camera", "camera.json", "--resolution", "nan"), 2, "--resolution: want a positive number"),
    ((*TOP, "--camera", "camera.json", "--resolution", "-1"), 2, "--resolution: want a positive number"),
    ((*TOP, "--camera", "camera.json", "--resolution", "1e-12"), 1, "--resolution: want a top view of at most"),
    ((*TOP, "--camera", "camera.json", "--extent", "0,0,0,1"), 2, "--extent: want x0,y0,x1,y1 without spaces"),
    ((*TOP, "--camera", "camera.json", "--extent", "nan,0,1,1"), 2, "--extent: want x0,y0,x1,y1 without spaces"),
    ((*TOP, "--camera", "camera.json", "-o", "top.gif"), 2, r"--output: want a file ending in \.png, \.tif, \.tiff"),
    ((*TOP, "--camera", "camera.json", "-o", "folder.png"), 1, "--output: want a file, got a folder"),
    ((*TOP, "--camera", "camera.json", "-o", "photo.png"), 1, "--output: want another file than those that are read"),
    # What is read is not written over, and no number is taken that cannot be.
    (("convert", "camera.json", "./camera.json"), 1, "OUT: want another file than those that are read"),
    (
        ("locate", "--camera", "camera.json", "--landmarks", "short.csv", "-o", "camera.json"),
        1,
        "--output: want another file than those that are read",
    ),
    (("locate", "--camera", "camera.json", "--landmarks", "gone.csv"), 1, "gone.csv: No such file or directory"),
    (("locate", "--camera", "camera.json", "--landmarks", "nothing"), 1, "nothing: Is a directory"),
    (("locate", "--camera", "camera.json", "--landmarks", "empty.csv"), 1, "--landmarks: want lines with columns"),
    (
        ("locate", "film.mp4", "--camera", "camera.json", "--landmarks", "short.csv"),
        1,
        "--landmarks|the video film.mp4",
    ),
    (("calibrate", "film.mp4", *BOARD), 1, "film.mp4: want a video, got a file of which OpenCV reads no frame"),
    (("calibrate", "photo.png", *BOARD, "--folds", "1"), 2, "--folds: want a whole number from 2 to 1000"),
    (("calibrate", "photo.png", *BOARD, "--folds", "-3"), 2, "--folds: want a whole number|expected one argument"),
    (("calibrate", "photo.png", *BOARD, "--folds", "nan"), 2, "--folds: want a whole number from 2 to 1000"),
    (("calibrate", "photo.png", *BOARD, "--folds", "7"), 1, "--folds: want at most the number of views, 1, got 7"),
    (("calibrate", "photo.png", *BOARD, "--frames", "0"), 2, "--frames: want a whole number from 1 to 1000000"),
    (("measure", "film.mp4", *BOARD, *POINTS, "--camera", "camera.json"), 1, "want a photograph, got the video"),
    # The board to print.
    (("board", *BOARD), 2, "the following arguments are required: FILE"),
    (("board", "board.txt", *BOARD), 2, r"FILE: want a file ending in \.pdf, \.svg, \.png"),
    (("board", "gone/board.pdf", *BOARD), 1, "FILE: no such folder: gone; make it first"),
    (("board", "folder.png", *BOARD), 1, "FILE: want a file, got a folder"),
    (("board", "board.pdf", "--board", "8x5", "--square", "-25mm"), 2, "--square: want the side|expected one argument"),
    (("board", "board.pdf", "--board", "8x5", "--square", "nan"), 2, "--square: want the side of a square"),
    (("board", "board.pdf", "--board", "8x5", "--square", "9m"), 1, "--paper|paper"),
    (("board", "board.pdf", *BOARD, "--paper", "A99"), 1, "--paper: want"),
    (("board", "board.pdf", *BOARD, "--paper", "-1,nan"), 1, "--paper: want"),
    (("board", "board.pdf", *BOARD, "--dpi", "nan"), 2, "--dpi: want pixels per inch from 50 to 5000"),
    (("board", "board.pdf", "--charuco", "6x5", "--square", "20"), 2, "--marker: want it along with --charuco"),
    (
        ("board", "a.pdf", "--charuco", "6x5", "--square", "20", "--marker", "15", "--dictionary", "none"),
        1,
        "--dictionary: want",
    ),
    (("board", "board.pdf", "--target", "gone.yaml"), 1, "gone.yaml"),
    (("board", "board.pdf", "--target", "other.yaml"), 1, "other.yaml: want"),
    # Each command knows its options.
    *(
        (
            (command, *more, "--nonsense"),
            2,
            f"{command}: unrecognized arguments: --nonsense; 'diffproj {command}",
        )
        for command, more in {
            "board": ("a.pdf", *BOARD),
            "calibrate": ("photo.png", *BOARD),
            "measure": ("photo.png", *BOARD, *POINTS, "--camera", "camera.json"),
            "rectify": ("photo.png", *BOARD, "--camera", "camera.json"),
            "locate": ("--camera", "camera.json", "--landmarks", "short.csv"),
            "convert": ("camera.json", "new.yaml"),
            "info": ("camera.json",),
            "experiment": (),
        }.items()
    ),
    (("info", "nothing"), 1, "nothing: want a file, got a folder"),
    (("info", "camera.json", "--camera", "7"), 1, "camera.json: --camera: want a number from 0 to 0, got 7"),
    (("info", "camera.json", "--from", "nonsense"), 2, "--from: invalid choice: 'nonsense'"),
    (("convert", "camera.json", "new.yaml", "--camera", "left"), 1, "--camera: want one of"),
    # The experiment.
    (("experiment", "--split", "x"), 1, "--split: want a number such as 8"),
    (("experiment", "--split", "1-99999999999/2"), 1, "--split: want views from 1 to 13, got 14"),
    (("experiment", "--split", "99999999999"), 1, "--split: want views from 1 to 13, got 14"),
    (("experiment", "--split", "12-5/2"), 1, "--split: want at least 2 views to fit"),
    (("experiment", "--board", "8x5"), 1, "--board: want 9x6 for --data"),
    (("experiment", "--images", "nothing"), 1, "nothing: want a folder with photographs"),
    (("experiment", "--images", "phone.heic", "--data", "left"), 1, "phone.heic: HEIC|not allowed with"),
]


@pytest.mark.parametrize(("arguments", "code", "message"), CASES, ids=[" ".join(case[0])[:80] for case in CASES])
def test_bad_input_is_one_line(
    arguments: tuple[str, ...],
    code: int,
    message: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    before = listing(folder)
    try:
        found = cli.main(list(arguments))
    except SystemExit as error:
        found = error.code
    out, err = capsys.readouterr()
    *others, line = err.splitlines()
    assert found == code, err
    assert out == ""
    assert re.match("diffproj( [a-z]+)?: ", line)
    assert re.search(message, line), line
    assert "unexpected" not in line
    if code == 1:
        assert not others
    else:
        assert others[0].startswith("usage: diffproj")
    assert listing(folder) == before


def test_what_nobody_thought_of_is_one_line_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    monkeypatch.chdir(folder)

    def fail(*_: object) -> None:
        raise AssertionError("two\nlines")

    monkeypatch.setattr("diffproj.cli.measuring.scene_of", fail)
    assert cli.main([*VIEW, *POINTS]) == 1
    out, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert out == ""
    assert re.fullmatch(
        r"diffproj: unexpected AssertionError at test_cli_bad_input\.py:\d+: two lines; please report it with the command",
        line,
    )


def test_a_terminal_without_signs_is_no_failure(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="ascii") for _ in range(2))
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    assert cli.main([*VIEW, *POINTS]) == 0
    for stream in (out, err):
        stream.seek(0)
    assert "x ? deviation" in out.read()
    assert err.read() == ""
