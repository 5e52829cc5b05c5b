"""The command line as a stranger meets it: what it prints and writes, its exit codes and its one-line errors."""

import os
import re
import runpy
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import diffproj as dp
from diffproj import __main__, cli, synthetic
from diffproj.cli import calibrate as calibrate_command
from diffproj.cli.terminal import failure, rounded

PHOTOGRAPHS = Path(os.environ.get("DIFFPROJ_PHOTOS", "/usr/share/doc/opencv-doc/examples/data"))
needs_photographs = pytest.mark.skipif(
    not (PHOTOGRAPHS / "left01.jpg").exists(), reason="no photographs here; the README's last section brings them"
)


def run(capsys: pytest.CaptureFixture[str], *arguments: str, command: str = "experiment") -> tuple[int, str, str]:
    try:
        code = cli.main([command, *arguments])
    except SystemExit as error:
        code = int(error.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def test_experiment_prints_the_table_and_writes_three_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "new" / "folder"
    code, out, err = run(capsys, "--output", str(folder))
    assert (code, err) == (0, "")
    assert "Table 1" in out
    assert "left14.jpg" in out
    assert sorted(path.name for path in folder.iterdir()) == ["camera.json", "fig7.png", "table1.csv"]
    assert cv2.imread(str(folder / "fig7.png")) is not None
    assert dp.load_calibration(folder / "camera.json").rms < 0.19
    assert (folder / "table1.csv").read_text().startswith("view,corners,mean_E_x")


def test_options_reach_the_experiment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = (
        "--data",
        "right",
        "--distortion",
        "none",
        "--split",
        "1-10/12,13",
        "--strict",
        "--output",
        str(tmp_path),
    )
    code, out, _ = run(capsys, *options)
    assert code == 0
    assert "right14.jpg" in out
    assert "27" in out
    assert "lens" not in out
    rows = (tmp_path / "table1.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == ["right13.jpg", "right14.jpg", "all"]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with five photographs of an 8 x 5 board and one that shows no board."""
    folder = tmp_path_factory.mktemp("photographs")
    setup = dp.paper_setup()
    board = dp.Chessboard(8, 5, 25.0, axes="paper")
    for i in (1, 2, 3, 4, 6):
        cv2.imwrite(str(folder / f"{i}.png"), synthetic.photograph(setup.fit[i], board).numpy())
    empty = synthetic.photograph(setup.fit[0].cropped(0.0, 0.0, 20, 20).cropped(0.0, 0.0, 640, 480), board)
    cv2.imwrite(str(folder / "5.png"), empty.numpy() * 0 + 90)
    (folder / "notes.txt").write_text("not a photograph")
    return folder


def test_own_photographs(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(
        capsys,
        "--images",
        str(photographs),
        "--board",
        "8x5",
        "--split",
        "4",
        "--distortion",
        "none",
        "--output",
        str(tmp_path),
    )
    assert code == 0
    assert "6.png" in out
    assert "5.png" in err
    files = [str(photographs / f"{i}.png") for i in (1, 2, 3, 4, 6)]
    code, again, err = run(
        capsys, "--images", *files, "--board", "8x5", "--split", "4", "--distortion", "none", "--output", str(tmp_path)
    )
    assert (code, again, err.strip()) == (0, out, "")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--data", "middle"], 2, "invalid choice: 'middle'"),
        (["--board", "9by6"], 2, "want inner corners as COLUMNSxROWS, such as 9x6, got '9by6'"),
        (["--board", "8x5"], 1, "--board: want 9x6 for --data, got 8x5"),
        (["--split", "20"], 1, "split: want views from 1 to 13"),
        (["--board", "9x2"], 2, "want at least 3x3 inner corners"),
        (["--square", "-1"], 2, "--square: want the side of a square as a positive number, such as 25, got '-1'"),
        (["--images", "nowhere.jpg"], 1, "nowhere.jpg"),
    ],
)
def test_errors_are_one_line_with_a_remedy(
    arguments: list[str], code: int, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "output"
    found, out, err = run(capsys, *arguments, "--output", str(folder))
    assert found == code
    assert message in err
    assert out == ""
    assert code == 2 or len(err.strip().splitlines()) == 1
    assert not folder.exists()


def test_folders_without_photographs_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "--images", str(tmp_path))
    assert code == 1
    assert str(tmp_path) in err


# --------------------------------------------------------------------------------------------------------- calibrate


def calibrate(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    return run(capsys, *map(str, arguments), "--board", "8x5", "--square", "25", command="calibrate")


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
    assert "5.png: found no board with 8 x 5 inner corners; photograph skipped" in one_line(err)
    calibration = dp.load_calibration(file)
    assert calibration.views.names == ("1.png", "2.png", "3.png", "4.png", "6.png")
    f_x = calibration.camera.K[0, 0]
    assert abs(f_x - 700) < 5 * calibration.covariance.deviations["f_x"]
    assert re.search(rf"focal length f_x, px +│ +{f_x:.1f}\d* +│ +[\d.]+ +│", out)
    assert re.search(rf"4.png +│ 40 of 40 +│ +{calibration.view_rms[3]:.4f} │\n", out)
    assert f"RMS reprojection error {calibration.rms:.4f} px over 200 corners in 5 views" in out
    assert f"Solver {calibration.message}" in out
    assert f"Written to {file}\n" in out
    assert "rejected" not in out
    assert all(len(line) <= 80 for line in out.splitlines() if str(file) not in line)


def test_calibrate_writes_what_opencv_reads(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text("an older file")
    code, out, _ = calibrate(capsys, photographs, photographs / "6.png", "--distortion", "brown4", "--output", file)
    assert code == 0
    assert "a .json file would hold the whole calibration" in out
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
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, file = tmp_path / "photographs", tmp_path / "camera.json"
    shutil.copytree(photographs, folder)
    options = ("--distortion", "none", "--reject-outliers", "-o", file)
    code, out, _ = calibrate(capsys, folder, *options)
    assert code == 0
    assert "No corner rejected as outlier" in out
    corner = 11
    u, v = dp.load_calibration(file).views.pixels[2, corner].round().int().tolist()
    spoilt = cv2.imread(str(folder / "3.png"))
    assert spoilt is not None
    spoilt[v - 3 : v + 4, u + 2 : u + 6] = 20
    cv2.imwrite(str(folder / "3.png"), spoilt)
    code, out, _ = calibrate(capsys, folder, *options)
    assert code == 0
    assert "1 corner rejected as outlier\n" in out
    assert re.search(rf"3.png +│ 39 of 40 │ +[\d.]+ │ {corner} \(\d+, \d+\)", out)
    assert dp.load_calibration(file).rejected.nonzero().tolist() == [[2, corner]]


@needs_photographs
def test_calibrate_on_real_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "camera.yml"
    files = [str(PHOTOGRAPHS / f"left0{i}.jpg") for i in range(1, 9)]
    code, _, err = run(
        capsys, *files, "--board", "9x6", "--square", "25", "--bow", "-o", str(file), command="calibrate"
    )
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
        (["--square", "25"], "the following arguments are required: --board"),
        (["--board", "9x6"], "the following arguments are required: --square"),
        (["--board", "9", "--square", "25"], "--board: want inner corners as COLUMNSxROWS, such as 9x6, got '9'"),
        (["--board", "9x2", "--square", "25"], "--board: want at least 3x3 inner corners"),
        (["--board", "9x6", "--square", "25mm"], "--square: want the side of a square as a positive number"),
        (["--board", "9x6", "--square", "inf"], "--square: want the side of a square as a positive number"),
        (["--board", "9x6", "--square", "25", "--distortion", "brown6"], "invalid choice: 'brown6'"),
        (
            ["--board", "9x6", "--square", "25", "-o", "camera.txt"],
            "want a file ending in .json, .yaml, .yml, .xml, got 'camera.txt'",
        ),
    ],
)
def test_calibrate_checks_options_first(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, "nowhere.png", *arguments, command="calibrate")
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


# --------------------------------------------------------------------------------------------------------- the whole


def test_failures_name_options_of_the_command_line() -> None:
    with pytest.raises(dp.CalibrationError) as caught:
        dp.calibrate(dp.example_views("left"), dp.Chessboard(), max_iterations=1)
    assert failure(caught.value).startswith("--distortion: the error was still falling after 1 steps; choose a lens")
    assert failure(PermissionError(13, "Permission denied", "camera.json")) == "camera.json: Permission denied"


def test_interrupting_is_no_traceback(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(calibrate_command, "find_corners", interrupt)
    code, _, err = calibrate(capsys, photographs, "-o", tmp_path / "camera.json")
    assert (code, one_line(err)) == (130, "diffproj: interrupted")
    assert not list(tmp_path.iterdir())


def test_help_and_module(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["diffproj", "calibrate", "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(__main__.__file__, run_name="__main__")
    out, _ = capsys.readouterr()
    assert "inner corners, columns x rows" in out
    assert all(len(line) <= 80 for line in out.splitlines())
    code, out, _ = run(capsys, "--help")
    assert code == 0
    assert "--strict" in out
    with pytest.raises(SystemExit, match="2"):
        cli.main([])
    assert "COMMAND" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("value", "deviation", "texts"),
    [
        (533.1966, 0.4123, ("533.20", "0.41")),
        (-0.0000743, 0.000121, ("-0.00007", "0.00012")),
        (-16.54, 120.7, ("-17", "121")),
        (320.0, 0.0, ("320", "unknown")),
        (-49457625.0, 5927151112.0, ("-4.95e+07", "5.9e+09")),
    ],
)
def test_values_are_shown_as_far_as_they_are_known(value: float, deviation: float, texts: tuple[str, str]) -> None:
    assert rounded(value, deviation) == texts


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in [name for name in sys.modules if name.startswith("diffproj.cli.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rich.console", None)
    monkeypatch.setattr(sys, "argv", ["diffproj", "calibrate", "photo.png", "--board", "9x6", "--square", "25"])
    assert __main__.main() == 1
    assert "diffproj: the command line needs rich; pip install 'diffproj[cli]'" in capsys.readouterr().err


def test_missing_matplotlib_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delattr(dp, "figures")
    monkeypatch.delitem(sys.modules, "diffproj.figures")
    monkeypatch.setitem(sys.modules, "matplotlib.colors", None)
    monkeypatch.setattr(sys, "argv", ["diffproj", "experiment", "--output", str(tmp_path / "folder")])
    assert __main__.main() == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert "the command line needs matplotlib" in err
    assert not (tmp_path / "folder").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["help"], 0, "find a camera from photographs of a chessboard"),
        (["--help"], 0, "'diffproj help COMMAND' tells more about a command."),
        (["--version"], 0, f"diffproj {dp.__version__}\n"),
        (["calibrat"], 2, "invalid choice: 'calibrat' (choose from"),
        (["help", "nothing"], 2, "invalid choice: 'nothing'"),
        ([], 2, "the following arguments are required: COMMAND"),
    ],
)
def test_help_and_mistakes_load_no_command(arguments: list[str], code: int, text: str) -> None:
    program = (
        "import sys, diffproj; before = set(sys.modules); from diffproj import cli\n"
        f"try: cli.main({arguments})\n"
        "except SystemExit as error: code = error.code\n"
        "loaded = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "print(*(name for name in sys.modules if name.startswith('diffproj.cli.')), loaded & {'rich', 'matplotlib'})\n"
        "sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == code
    assert text in done.stdout + done.stderr
    assert done.stdout.endswith("set()\n")
    assert len(done.stdout.splitlines()[-1].split()) == 1


def test_help_on_a_command_is_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    texts = []
    for arguments in (["help", "measure"], ["measure", "--help"]):
        with pytest.raises(SystemExit, match="0"):
            cli.main(arguments)
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1]
    assert texts[0].startswith("usage: diffproj measure PHOTO --camera FILE")
