"""What all commands have in common: documents, how much is said, output that nobody takes, completion, inputs read once."""

import argparse
import errno
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import diffproj as dp
from diffproj import __main__, cli, synthetic
from diffproj.cli.calibrate_document import document
from diffproj.cli.terminal import RESULTS
from diffproj.files.document import Document
from tests.cli.commands import runner

run = runner()
pytestmark = pytest.mark.usefixtures("there")

BOARD = ("--board", "8x5", "--square", "25mm")
PHOTO = ("photo.png", "--camera", "camera.json", *BOARD)
POINTS = ("--points", "210,133", "402,140")

COMMANDS = {
    "board": ("board", "page.svg", *BOARD),
    "calibrate": ("calibrate", "photos", *BOARD, "--distortion", "none", "-o", "new.json"),
    "measure": ("measure", *PHOTO, *POINTS),
    "rectify": ("rectify", *PHOTO, "--resolution", "2", "-o", "top.png"),
    "locate": ("locate", "--camera", "camera.json", "--landmarks", "gcp.csv", "-o", "located.json"),
    "convert": ("convert", "camera.json", "new.yaml"),
    "info": ("info", "camera.json"),
    "experiment": ("experiment", "--output", "results"),
}
"""Each command with work that takes little."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs, one of them by itself, a video, a camera file and landmarks."""
    folder = tmp_path_factory.mktemp("voice")
    setup, upright = dp.paper_setup(), dp.Chessboard(8, 5, 25.0, axes="paper")
    (folder / "photos").mkdir()
    images = [synthetic.photograph(setup.fit[i], upright).numpy() for i in (1, 2, 3, 4, 6)]
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / "photos" / f"{number}.png"), image)
    (folder / "photos" / "notes.txt").write_text("not a photograph")
    film = cv2.VideoWriter(str(folder / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (640, 480))
    for image in images:
        film.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    film.release()
    cv2.imwrite(str(folder / "photo.png"), synthetic.photograph(setup.test[3], upright).numpy())
    seen = synthetic.corner_views(setup.fit, upright)
    views = dp.Views(seen.pixels, seen.visible, [f"{i}.png" for i in range(1, 11)], seen.size)
    calibration = dp.calibrate(views, dp.Chessboard(8, 5, 25.0), "none")
    dp.save_camera(folder / "camera.json", calibration)
    points, pixels = calibration.points[::7], seen.pixels[3, ::7]
    rows = (",".join(map(str, [*pixel, *point])) for pixel, point in zip(pixels.tolist(), points.tolist(), strict=True))
    (folder / "gcp.csv").write_text("u,v,x,y,z\n" + "\n".join(rows))
    return folder


class Full(io.StringIO):
    """A file on a full disk."""

    def flush(self) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_no_command_is_forgotten() -> None:
    assert set(COMMANDS) == set(cli.COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_examples_and_exit_codes(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, command, "--help")
    assert code == 0
    assert "\nexamples:\n  diffproj " + command in out
    assert "\nexit codes: 0 done; 1 it failed" in out
    assert all(option in out for option in ("--json", "--quiet", "--verbose"))
    assert all(len(line) <= 80 for line in out.splitlines())


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_prints_one_document(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, *COMMANDS[command], "--json", "--quiet")
    assert (code, err) == (0, "")

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    assert json.loads(out, parse_constant=refuse)["warnings"] == []


def test_the_document_of_a_calibration(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, *COMMANDS["calibrate"], "--folds", "5", "--json")
    assert code == 0
    found, whole = json.loads(out), dp.load_calibration("new.json")
    assert err == "diffproj: photos: skipped 1 file that is no photograph\n"
    f_x = found["parameters"]["f_x"]
    assert f_x["value"] == float(whole.camera.K[0, 0])
    assert f_x["deviation"] == float(whole.covariance.deviations["f_x"])
    assert [view["name"] for view in found["views"]] == [f"{i}.png" for i in range(5)]
    assert (found["views"][0]["corners"], found["views"][0]["used"]) == (40, 40)
    assert (found["status"], found["lens"], found["size"], found["unit"]) == ("CONVERGED", "none", [640, 480], "mm")
    folds = dp.cross_validate(whole.views, dp.Chessboard(8, 5, 25.0), "none", 5)
    assert found["folds"]["held_out_px"] == pytest.approx(folds.held_out_px.tolist(), rel=1e-6)


def test_documents_speak_of_options_and_units() -> None:
    """And not of Python's arguments, as what is printed for people."""
    found = dp.calibrate(dp.example_views("left"), dp.Chessboard(9, 6, 25.0))
    assert "take shape='free'" in found.message
    asked = argparse.Namespace(output="a.json", draw=None, report=None, warned=[])
    told = document(asked, replace(found, unit="mm"), None)
    assert "whose corners lie 0.069 mm (RMS) off the target's: take --shape free, which" in told["message"]
    assert not re.search(r"\w=|world units", told["message"] + told["verdict"])


def test_folds_are_printed_and_few_views_refused(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, *COMMANDS["calibrate"], "--folds", "2")
    assert code == 0
    assert "Errors on views left out; world: mm on the board\nfold   fitted px   held out px" in out
    code, out, err = run(capsys, *COMMANDS["calibrate"], "--folds", "6")
    assert (code, out) == (1, "")
    assert err.splitlines()[-1] == "diffproj: --folds: want at most the number of views, 5, got 6"


def test_a_video_is_photographs(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("calibrate", "film.avi", *BOARD, "--distortion", "none", "-o", "film.json", "--json")
    code, out, err = run(capsys, *options)
    assert (code, err) == (0, "")
    assert [view["name"] for view in json.loads(out)["views"]] == [f"film.avi frame {i}" for i in range(5)]
    assert dp.load_calibration("film.json").camera.K[0, 0] == pytest.approx(700, abs=20)
    code, out, _ = run(capsys, *options, "--frames", "2")
    assert [view["name"] for view in json.loads(out)["views"]] == [f"film.avi frame {i}" for i in (0, 2, 4)]


def test_quiet_and_verbose(capsys: pytest.CaptureFixture[str]) -> None:
    _, usual, notes = run(capsys, *COMMANDS["calibrate"])
    code, out, err = run(capsys, *COMMANDS["calibrate"], "-q")
    assert (code, out, err) == (0, usual, "")
    code, out, err = run(capsys, *COMMANDS["calibrate"], "-v")
    assert (code, out) == (0, usual)
    first, *steps = err.splitlines()
    assert first == notes.strip()
    assert re.fullmatch(r"diffproj: [\d.]+ s: Finding corners: 5 views of 5 photographs", steps[0])
    code, out, err = run(capsys, "info", "gone.json", "--verbose")
    assert (code, out) == (1, "")
    assert err.startswith("Traceback")
    assert err.splitlines()[-1] == "diffproj: gone.json: No such file or directory; check its name and its folder"
    code, _, err = run(capsys, "info", "camera.json", "-q", "-v")
    assert (code, "not allowed with argument" in err) == (2, True)


@pytest.mark.parametrize("command", COMMANDS)
def test_output_that_no_room_is_for_is_a_failure(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for file in ("new.json", "new.yaml", "top.png", "page.svg", "located.json"):
        Path(file).unlink(missing_ok=True)
    monkeypatch.setattr(RESULTS, "_file", Full())
    code, _, err = run(capsys, *COMMANDS[command], "--quiet")
    RESULTS._buffer.clear()  # a command line that failed ends; here others follow
    assert code == 1
    assert err == "diffproj: standard output: No space left on device; send it elsewhere\n"
    for file in Path().glob("*.json"):
        json.loads(file.read_text())  # what was written is whole


@pytest.mark.parametrize("arguments", [["--help"], ["help", "measure"], ["--version"], ["info", "camera.json"]])
def test_output_that_is_not_taken(arguments: list[str]) -> None:
    command = [sys.executable, "-m", "diffproj", *arguments]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    assert done.stderr == "diffproj: standard output: No space left on device; send it elsewhere\n"
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (1, "")


def test_a_misspelt_option_is_told_from_the_right_one(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "measure", *PHOTO, *POINTS, "--hieght", "3")
    assert code == 2
    assert err.endswith("diffproj measure: unrecognized arguments: --hieght 3; did you mean --height?\n")
    code, _, err = run(capsys, "info", "camera.json", "another.json")
    assert err.endswith("unrecognized arguments: another.json; 'diffproj info --help' lists the options\n")
    code, _, err = run(capsys, "measure", *PHOTO, *POINTS, "--csv", "points.csv")
    assert code == 2
    assert err.endswith(
        "diffproj measure: --csv: takes no value, got 'points.csv'; it means: print one table for spreadsheets\n"
    )
    code, _, err = run(capsys, "info", "camera.json", "--json", "--quite")
    assert err.endswith("unrecognized arguments: --quite; did you mean --quiet?\n")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("diffproj re", {"rectify"}),
        ("diffproj measure --hei", {"--height"}),
        ("diffproj calibrate photos --distortion bro", {f"brown{n}" for n in (4, 5, 8, 12, 14)}),
    ],
)
def test_the_shell_completes(line: str, words: set[str], tmp_path: Path) -> None:
    pytest.importorskip("argcomplete")
    answer = tmp_path / "answer"
    shell = {
        "_ARGCOMPLETE": "1",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
    }
    program = "import sys; from diffproj.__main__ import main; main()"
    environment = {**os.environ, **shell, "_ARGCOMPLETE_SUPPRESS_SPACE": "1", "_ARGCOMPLETE_IFS": "\n"}
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", program], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0
    assert {word.strip() for word in answer.read_text().splitlines()} == words
    assert not re.search(r"\| +(torch|rich|matplotlib)$", done.stderr, re.MULTILINE)


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often photographs were decoded, grey and in colour, and each camera file read."""
    counts: Counter[str] = Counter()
    decode, document = cv2.imdecode, Document.read

    def counted_decode(data: np.ndarray, flags: int) -> np.ndarray:
        counts["colour" if flags & cv2.IMREAD_COLOR else "grey"] += 1
        return decode(data, flags)

    def counted_document(path: Path) -> Document:
        counts[str(path)] += 1
        return document(path)

    monkeypatch.setattr(cv2, "imdecode", counted_decode)
    monkeypatch.setattr(Document, "read", counted_document)
    return counts


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (COMMANDS["measure"], {"grey": 1, "camera.json": 1}),
        ((*COMMANDS["measure"], "--draw", "measured.png"), {"grey": 1, "camera.json": 1}),
        ((*COMMANDS["measure"], "--page", "page.html"), {"colour": 1, "camera.json": 1}),
        ((*COMMANDS["measure"], "--draw", "a.png", "--page", "page.html"), {"colour": 1, "camera.json": 1}),
        (COMMANDS["rectify"], {"colour": 1, "camera.json": 1}),
        (COMMANDS["locate"], {"camera.json": 1}),
        (("locate", "photo.png", *COMMANDS["locate"][1:]), {"grey": 1, "camera.json": 1}),
        (("locate", "photo.png", *COMMANDS["locate"][1:], "--draw", "a.png"), {"grey": 1, "camera.json": 1}),
        (COMMANDS["calibrate"], {"grey": 5}),
        ((*COMMANDS["calibrate"], "--folds", "3", "--draw", "a.png"), {"grey": 5}),
        # That in which the report measures is shown in its colours, which the detector never saw.
        ((*COMMANDS["calibrate"], "--draw", "a.png", "--report", "a.html"), {"grey": 5, "colour": 1}),
        (("calibrate", "damaged", *COMMANDS["calibrate"][2:]), {"grey": 6}),
        (("calibrate", "--fleet", "fleet", *BOARD, "--workers", "1", "-o", "fleet.jsonl"), {"grey": 6}),
        (("experiment", "--images", "photos", *BOARD, "--output", "results"), {"grey": 5}),
        (COMMANDS["info"], {"camera.json": 1}),
        (COMMANDS["convert"], {"camera.json": 1}),
    ],
)
def test_files_are_read_once(
    arguments: tuple[str, ...],
    expected: dict[str, int],
    folder: Path,
    read: Counter[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("fleet.jsonl").unlink(missing_ok=True)
    for name in ("damaged", "fleet/one"):
        shutil.copytree("photos", name, dirs_exist_ok=True)
        Path(name, "broken.png").write_bytes(b"something")
    code, _, err = run(capsys, *arguments)
    assert code == 0, err
    assert read == expected


@pytest.mark.parametrize("command", ["measure", "locate"])
def test_a_photograph_s_file_is_read_once(
    command: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether it is shown turned was read off the file anew."""
    read, whole = [], Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path.name) or whole(path))
    given = COMMANDS["measure"] if command == "measure" else ("locate", "photo.png", *COMMANDS["locate"][1:])
    assert run(capsys, *given)[0] == 0
    assert read.count("photo.png") == 1


def test_interrupted_while_it_loads(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("diffproj.__main__.run", interrupted)
    assert __main__.main() == 130
    assert capsys.readouterr() == ("", "diffproj: interrupted\n")


def test_of_a_damaged_video_one_line_tells(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"something")
    command = [sys.executable, "-m", "diffproj", "calibrate", str(tmp_path / "film.mp4"), *BOARD]
    done = subprocess.run(command, capture_output=True, text=True)
    told = f"diffproj: {tmp_path / 'film.mp4'}: want a video, got a file of which OpenCV reads no frame\n"
    assert (done.returncode, done.stdout, done.stderr) == (1, "", told)


def test_frames_of_videos_are_decoded_once(read: Counter[str], capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("film.avi", *BOARD, "--frames", "1", "--distortion", "none", "-o", "new.json")
    assert run(capsys, "calibrate", *arguments)[0] == 0
    assert read == {"grey": 5}
    assert run(capsys, "calibrate", *arguments, "--report", "a.html")[0] == 0
    assert read == {"grey": 5 + 5 + 1}  # grey as they are kept, that to measure in, too


@pytest.mark.parametrize("columns", [20, 40, 80])
def test_numbers_in_tables_stay_whole_in_any_terminal(
    folder: Path, columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _, told, _ = run(capsys, *COMMANDS["measure"], "--json")
    point = json.loads(told)["points"][0]
    monkeypatch.setenv("COLUMNS", str(columns))
    _, out, _ = run(capsys, *COMMANDS["measure"])
    x = re.search(r"210, 133\s*│\s*(-?[\d.]+) ± [\d.]+ │\s*(-?[\d.]+) ± [\d.]+ │", out)
    assert x is not None
    assert [float(one) for one in x.groups()] == pytest.approx(point["world"][:2], abs=0.06)
    assert re.search(r"│ 1, 2 +│ [\d.]+ │ [\d.]+ +│ [\d.]+ to [\d.]+ │", out)
    _, out, _ = run(capsys, *COMMANDS["calibrate"])
    assert re.search(r"│\s+\d+\.\d+ │ \d+\.\d+ +│", out)
