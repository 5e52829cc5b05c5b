"""`diffproj calibrate` as a stranger meets it: what it prints and writes, its exit codes and its one-line errors."""

import os
import re
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.calibration.results.remark import Remark
from diffproj.cli import calibrating
from diffproj.targets.detection import Searched
from tests.cli.commands import runner

PHOTOGRAPHS = Path(os.environ.get("DIFFPROJ_PHOTOS", "/usr/share/doc/opencv-doc/examples/data"))
needs_photographs = pytest.mark.skipif(
    not (PHOTOGRAPHS / "left01.jpg").exists(), reason="no photographs here; the README's last section brings them"
)


run = runner("calibrate")


def calibrate(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    return run(capsys, *map(str, arguments), "--board", "8x5", "--square", "25")


def one_line(err: str) -> str:
    (line,) = err.strip().splitlines()
    assert line.startswith("diffproj: ")
    return line


def test_calibrate_writes_the_whole_calibration(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "camera.json"
    code, out, err = calibrate(capsys, photographs, "--distortion", "none", "-o", file)
    assert code == 0
    left_out, missed = err.splitlines()
    assert left_out == f"diffproj: {photographs}: skipped 1 file that is no photograph"
    assert "5.png: found no board with 8 x 5 inner corners; photograph skipped" in missed
    calibration = dp.load_calibration(file)
    assert calibration.views.names == ("1.png", "2.png", "3.png", "4.png", "6.png")
    f_x = calibration.camera.K[0, 0]
    assert abs(f_x - 700) < 5 * calibration.covariance.deviations["f_x"]
    assert re.search(rf"focal length f_x, px +│ +{f_x:.1f}\d* +│ +[\d.]+ +│", out)
    assert re.search(rf"4.png +│ 40 of 40 +│ +{calibration.view_rms[3]:.4f} │\n", out)
    assert f"RMS reprojection error {calibration.rms:.4f} px over 200 corners in 5 views" in out
    assert f"Solver {calibration.message}" in out
    assert f"Written to {file}\n" in out
    assert " ".join(calibration.verdict.split()) in " ".join(out.split())
    assert "rejected" not in out
    assert all(len(line) <= 80 for line in out.splitlines() if str(file) not in line)


def test_calibrate_writes_what_opencv_reads(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text("an older file")
    code, out, _ = calibrate(capsys, photographs, photographs / "6.png", "--distortion", "brown4", "--output", file)
    assert code == 0
    assert "the unit, the poses and the error bars are read from a .json file only" in out
    assert "in 5 views" in out  # a photograph that was named twice counts once
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    K, lens = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
    assert storage.getNode("extrinsic_parameters").mat().shape == (5, 6)
    storage.release()
    assert lens.shape == (4, 1)
    camera = dp.load_camera(file)
    assert camera.size == (640, 480)
    assert np.array_equal(camera.K.numpy(), K)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["camera.yaml"]


def test_calibrate_fits_the_bow(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "camera.json"
    code, out, _ = calibrate(capsys, photographs, "--distortion", "none", "--bow", "-o", file)
    assert code == 0
    assert "board's bow along x, unit of --square" in out
    bow = dp.load_calibration(file).bow
    assert bow is not None
    assert bow.abs().max() < 0.5  # millimetres: the rendered board is flat


def test_calibrate_names_rejected_corners(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, file = tmp_path / "photographs", tmp_path / "camera.json"
    shutil.copytree(photographs, folder)
    options = ("--distortion", "none", "--reject-outliers", "-o", file)
    code, out, _ = calibrate(capsys, folder, *options)
    assert code == 0
    assert "No corner rejected as outlier" in out
    corner = 11
    shift = torch.zeros(5, 40, 2, dtype=torch.float64)
    shift[2, corner, 0] = 1.0
    found = calibrating.search

    def spoilt(*arguments: Any, **options: Any) -> Searched:
        searched = found(*arguments, **options)
        views = searched.views
        return replace(searched, views=dp.Views(views.pixels + shift, names=views.names, size=views.size))

    monkeypatch.setattr(calibrating, "search", spoilt)
    code, out, _ = calibrate(capsys, folder, *options)
    assert code == 0
    assert "1 corner rejected as outlier\n" in out
    assert re.search(rf"3.png +│ 39 of 40 │ +[\d.]+ │ {corner} \(\d+, \d+\)", out)
    assert dp.load_calibration(file).rejected.nonzero().tolist() == [[2, corner]]


@needs_photographs
def test_calibrate_on_real_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "camera.yml"
    files = [str(PHOTOGRAPHS / f"left0{i}.jpg") for i in range(1, 9)]
    code, _, err = run(capsys, *files, "--board", "9x6", "--square", "25", "--bow", "-o", str(file))
    assert (code, err) == (0, "")
    assert abs(dp.load_camera(file).K[0, 0] - 533) < 3


def test_calibrate_says_what_the_views_do_not_determine(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = calibrate(capsys, photographs / "1.png", "-o", tmp_path / "camera.json")
    assert (code, out) == (1, "")
    assert "the views do not determine" in one_line(err)
    assert "add views tilted by 20 to 50 degrees" in err
    assert not list(tmp_path.iterdir())


def test_calibrate_refuses_photographs_by_name(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "camera.json"
    small, broken, empty = tmp_path / "small.png", tmp_path / "broken.png", tmp_path / "empty"
    cv2.imwrite(str(small), np.full((240, 320), 90, np.uint8))
    broken.write_text("no image")
    empty.mkdir()
    for photograph, message in {
        small: r"want one size, got 640 x 480 px in .*1\.png and 320 x 240 px in .*small\.png; one camera",
        broken: r"broken\.png: want an image",
        empty: r"empty: want a folder with photographs \(\.bmp, .*\), found none in it",
        tmp_path / "nowhere.png": r"no such file: .*nowhere\.png",
        tmp_path / "*.jpg": r"want at least one, got none in '.*/\*\.jpg'",
    }.items():
        code, out, err = calibrate(capsys, photographs / "1.png", photograph, "-o", file)
        assert (code, out) == (1, "")
        assert re.search(message, one_line(err))
    code, _, err = calibrate(capsys, photographs / "5.png", "-o", file)
    assert code == 1
    assert re.search(r"want a board with 8 x 5 inner corners, found none in .*5\.png\. Check", one_line(err))
    assert not file.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--square", "25"], "one of the arguments --board --charuco --aprilgrid --circles --target is required"),
        (["--board", "9x6"], "--square: want the side of the board's squares along with --board"),
        (["--board", "9", "--square", "25"], "--board: want inner corners as COLUMNSxROWS, such as 9x6, got '9'"),
        (["--board", "9x2", "--square", "25"], "--board: want at least 3x3 inner corners"),
        (
            ["--board", "9x6", "--square", "25px"],
            "--square: want one of the units um, µm, mm, cm, m, in, ft, such as 25mm",
        ),
        (["--board", "9x6", "--square", "2,5cm"], "--square: want the side of a square as a positive number"),
        (["--board", "9x6", "--square", "inf"], "--square: want the side of a square as a positive number"),
        (["--board", "9x6", "--square", "25", "--distortion", "brown6"], "invalid choice: 'brown6'"),
        (
            ["--board", "9x6", "--square", "25", "-o", "camera.txt"],
            "want a file ending in .json, .yaml, .yml, .xml, got 'camera.txt'",
        ),
    ],
)
def test_calibrate_checks_options_first(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, "nowhere.png", *arguments)
    assert (code, out) == (2, "")
    assert message in err


def test_calibrate_checks_the_place_of_the_file_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, _, err = calibrate(capsys, "nowhere.png", "-o", tmp_path / "missing" / "camera.json")
    assert code == 1
    assert f"--output: no such folder: {tmp_path / 'missing'}; make it first" in one_line(err)
    (tmp_path / "folder.json").mkdir()
    code, _, err = calibrate(capsys, "nowhere.png", "-o", tmp_path / "folder.json")
    assert code == 1
    assert "--output: want a file, got a folder" in one_line(err)

    def refuse(**_: Any) -> None:
        raise PermissionError(13, "Permission denied", "somewhere")

    # The superuser may write anywhere, so that no folder's mode makes this happen everywhere.
    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    code, _, err = calibrate(capsys, "nowhere.png", "-o", tmp_path / "camera.json")
    assert code == 1
    assert f"--output: cannot write to the folder {tmp_path} (Permission denied); choose another" in one_line(err)


def test_calibrate_keeps_the_older_file_where_writing_fails(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "camera.json"
    file.write_text("an older file")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    code, out, err = calibrate(capsys, photographs, "--distortion", "none", "-o", file)
    assert code == 1
    assert "Solver converged" in out
    assert f"--output: could not write {file} (No space left on device)" in err
    assert file.read_text() == "an older file"
    assert list(tmp_path.iterdir()) == [file]


def test_interrupting_is_no_traceback(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(calibrating, "search", interrupt)
    code, _, err = calibrate(capsys, photographs / "1.png", "-o", tmp_path / "camera.json")
    assert (code, one_line(err)) == (130, "diffproj: interrupted")
    assert not list(tmp_path.iterdir())


def test_what_is_no_photograph_in_a_folder_is_left_out_and_told(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, file = tmp_path / "photographs", tmp_path / "camera.json"
    shutil.copytree(photographs, folder)
    whole = (folder / "1.png").read_bytes()
    shutil.copy(folder / "2.png", folder / "copy of 2.png")
    (folder / "half.png").write_bytes(whole[:100])
    cv2.imwrite(str(folder / "heights.tif"), np.zeros((48, 64), np.int32))
    (folder / "empty.jpg").touch()
    for name in ("._1.png", ".DS_Store", "film.mp4", "a.HEIC", "b.heic", "c.cr2"):
        (folder / name).write_bytes(b"something")
    (folder / "folder.png").mkdir()
    (folder / "lost.png").symlink_to("nowhere.png")
    code, _, err = calibrate(capsys, folder, "--distortion", "none", "-o", file)
    assert code == 0
    assert dp.load_calibration(file).views.names == ("1.png", "2.png", "3.png", "4.png", "6.png")
    told = [
        line.removeprefix("diffproj: ").replace(f"{folder}/", "").replace(str(folder), "folder")
        for line in err.splitlines()
    ]
    assert told.pop(0) == "lost.png: a link to a file that is not there; skipped"
    assert told[0].startswith("folder: skipped 2 HEIC photographs, which OpenCV does not read: convert to JPEG in full")
    assert told[1].startswith("folder: skipped 1 raw photograph, which OpenCV does not read: convert to TIFF or PNG")
    assert told[2] == "folder: skipped 1 video: name a video by itself, for its frames are of another size"
    assert told[3] == "folder: skipped 2 hidden files and 1 file that is no photograph"
    assert told[4] == "copy of 2.png: the same photograph as 2.png; counted once"
    assert "5.png: found no board" in told[5]
    assert told[6:] == [
        "empty.jpg: cannot be read as an image; skipped",
        "half.png: cannot be read as an image; skipped",
        "heights.tif: want an image, got one of int32; save it with 8 or 16 bits; skipped",
    ]


def test_the_unit_is_kept(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "camera.json"
    options = (str(photographs), "--distortion", "none", "--bow", "-o", str(file))
    code, out, _ = run(capsys, *options, "--board", "8x5", "--square", "2.5cm")
    assert code == 0
    assert "board's bow along x, cm" in out
    assert "world units" not in out
    calibration = dp.load_calibration(file)
    assert calibration.unit == "cm"
    assert float(calibration.points[1, 0]) == 2.5


def test_skew_is_fitted(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "camera.json"
    code, out, _ = calibrate(capsys, photographs, "--distortion", "none", "--skew", "-o", file)
    assert code == 0
    assert re.search(r"skew, px +│ +-?[\d.]+ +│ +[\d.]+ +│", out)
    calibration = dp.load_calibration(file)
    skew = calibration.camera.K[0, 1]
    assert 0 < abs(skew) < 5 * calibration.covariance.deviations["skew"]


@pytest.mark.parametrize(("name", "start"), [("a.png", b"\x89PNG"), ("a.svg", b"<?xml"), ("a.pdf", b"%PDF")])
def test_calibrate_draws(
    name: str, start: bytes, photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / name
    code, out, _ = calibrate(
        capsys, photographs, "--distortion", "none", "-o", tmp_path / "camera.json", "--draw", file
    )
    assert code == 0
    assert f"Drawn to {file}\n" in out
    assert file.read_bytes().startswith(start)


def test_calibrate_writes_a_report(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the photographs, that without a board among them, and the camera file's name in the code to copy."""
    file, camera = tmp_path / "report.html", tmp_path / "camera.json"
    code, out, _ = calibrate(capsys, photographs, "--distortion", "none", "-o", camera, "--report", file)
    assert code == 0
    assert f"Report in {file}, for any browser\n" in out
    page = file.read_text(encoding="utf-8")
    assert page.count("data:image/jpeg") == 5 + 1  # and the one to measure in
    assert "No board was found in 5.png." in page
    assert f"dp.load_calibration(&#39;{camera}&#39;)" in page
    found = dp.load_calibration(camera)
    assert f"{float(found.rms):.3g} px" in page
    # What was kept while the board was searched is what the library reads of the same files.
    dp.write_report(tmp_path / "by_library.html", found, photographs, folds=None)
    library = (tmp_path / "by_library.html").read_text(encoding="utf-8")
    assert "No view belongs to 5.png." in library
    shown = re.findall(r"data:image/[^\"]+", page)
    assert len(shown) > 5 + 5 + 1  # the photographs, their corners that fit worst, that to measure in, and accuracy
    assert shown == re.findall(r"data:image/[^\"]+", library)


def test_a_remark_is_one_paragraph(capsys: pytest.CaptureFixture[str]) -> None:
    found = dp.calibrate(dp.example_views("left")[:5], dp.Chessboard(), "none", throw=False)
    remark = Remark("one thing; fix it, or take a simpler lens")
    calibrating._say_how_it_ended(replace(found, _remarks=lambda: ((remark,),)), False)
    assert "\nOne thing; take a simpler lens\n" in capsys.readouterr().out


def test_a_report_that_cannot_be_written_is_told_before_the_work(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = calibrate(
        capsys, photographs, "-o", tmp_path / "camera.json", "--report", tmp_path / "no" / "a.html"
    )
    assert code == 1
    assert err.startswith("diffproj: --report: no such folder: ")
    code, _, err = calibrate(capsys, photographs, "-o", tmp_path / "camera.json", "--report", tmp_path / "report.pdf")
    assert code == 2
    assert "--report: want a file ending in .html, got" in err
    assert list(tmp_path.iterdir()) == []
