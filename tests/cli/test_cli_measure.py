"""`diffproj measure` as a stranger meets it: what it prints, its JSON, its exit codes and its one-line errors."""

import csv
import io
import json
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

import diffproj as dp
from diffproj import figures, synthetic
from diffproj.cli import shielded
from diffproj.cli.inputs import HAND
from diffproj.cli.measure_csv import as_csv
from diffproj.cli.measure_document import REASONS, between, listed
from diffproj.cli.measure_plane import equation
from diffproj.cli.measure_tables import coordinate, shown
from diffproj.cli.measuring import length_in_words
from diffproj.cli.photographs import warn_if_shown_turned
from diffproj.cli.units import METRES
from diffproj.measurement.choices import HAND_PX
from diffproj.targets.images import decoded
from tests.cli.commands import parser, runner
from tests.targets.test_detection import with_orientation

D = torch.float64
BOARD = ("--board", "8x5", "--square", "25")
CORNERS = ("210.5,133", "402,140.5", "395,300")
NAMES = [f"{i}.png" for i in range(1, 11)]

run, parsed = runner("measure"), parser("measure")
pytestmark = pytest.mark.usefixtures("there")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tilted photograph of an 8 x 5 board, one without a board, and the camera in each kind of file."""
    folder = tmp_path_factory.mktemp("measure")
    setup, board = dp.paper_setup(), dp.Chessboard(8, 5, 25.0, axes="paper")
    photograph = synthetic.photograph(setup.test[3], board).numpy()
    cv2.imwrite(str(folder / "photo.png"), photograph)
    cv2.imwrite(str(folder / "small.png"), photograph[:, :600])
    cv2.imwrite(str(folder / "empty.png"), np.full((480, 640), 90, np.uint8))
    seen = synthetic.corner_views(setup.fit, board)
    visible = seen.visible.clone()
    visible[9, 3:] = False  # too few for a pose
    views = dp.Views(seen.pixels, visible, NAMES, seen.size)
    calibration = dp.calibrate(views, dp.Chessboard(8, 5, 25.0), "none")
    dp.save_camera(folder / "camera.json", calibration)
    dp.save_camera(folder / "camera.yaml", calibration)
    dp.save_camera(folder / "alone.json", calibration.camera)
    older = json.loads((folder / "camera.json").read_text())
    older["calibration"] |= {"covariance": None, "pixel_sigma": None}
    (folder / "older.json").write_text(json.dumps(older))
    del older["calibration"]["used"]
    (folder / "damaged.json").write_text(json.dumps(older))
    alike = dp.Views(views.pixels, views.visible, ["1.png"] * 10, views.size)
    dp.save_camera(folder / "alike.json", dp.refine(alike, dp.Chessboard(8, 5, 25.0), calibration.camera))
    many = dp.Camera(torch.stack([calibration.camera.K] * 2), size=(640, 480))
    dp.save_camera(folder / "many.json", many)
    return folder


def pixels(*texts: str) -> torch.Tensor:
    return torch.tensor([[float(x) for x in text.split(",")] for text in texts], dtype=D)


def same(document: dict[str, Any], measured: dp.Measurement) -> None:
    close = pytest.approx
    assert [p["world"] for p in document["points"]] == [close(p) for p in measured.points.tolist()]
    assert [p["deviation"] for p in document["points"]] == [close(p) for p in measured.deviations.tolist()]
    assert (document["area"] is None) == (len(measured.points) < 3)
    pairs = [(document["lengths"], measured.lengths())]
    pairs += [([document["area"]], measured.area())] if document["area"] else []
    for rows, found in pairs:
        low, high = found.interval()
        assert [row["value"] for row in rows] == close(found.value.tolist())
        assert [row["deviation"] for row in rows] == close(found.deviation.tolist())
        assert [row["interval_95"] for row in rows] == [
            close(pair) for pair in zip(low.tolist(), high.tolist(), strict=True)
        ]
        assert [row["significant"] for row in rows] == found.significant.tolist()


def test_new_photograph(capsys: pytest.CaptureFixture[str]) -> None:
    document = parsed(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", *CORNERS)
    board = dp.Chessboard(8, 5, 25.0)
    located = dp.locate(dp.detect("photo.png", board), board, dp.load_calibration("camera.json"))
    same(document, dp.measure(pixels(*CORNERS), located, dp.Plane.z(0.0), 0, 0.5))
    assert (document["pixel_sigma"], document["pixel_sigma_from"]) == (0.5, "hand")
    assert document["deviations_include"] == ["pixels", "pose", "camera"]
    assert (document["photograph"], document["view"], document["remarks"]) == ("photo.png", "photo.png", [])


def test_corners_of_the_board_come_out_where_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    corners = dp.detect("photo.png", dp.Chessboard(8, 5, 25.0)).pixels[0, [0, 7, 39, 32]]
    texts = [f"{u},{v}" for u, v in corners.tolist()]
    options = ("--camera", "camera.json", *BOARD, "--points", *texts)
    document = parsed(capsys, "photo.png", *options, "--pixel-sigma", "detector")
    for found, true in zip([*document["lengths"], document["area"]], [175, 100, 175, 175 * 100], strict=True):
        assert abs(found["value"] - true) < 4 * found["deviation"] < 0.01 * true


@pytest.mark.filterwarnings("ignore:measure. pixel")
def test_view_of_the_calibration(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--camera", "camera.json", "--view", "4.png", "--plane", "-0.1,0,1,-12", "--pixel-sigma", "0.7")
    document = parsed(capsys, *options, "--points", "-5,3", "100,120")
    plane = dp.Plane([-0.1, 0.0, 1.0], -12.0)
    calibration = dp.load_calibration("camera.json")
    measured = dp.measure(pixels("-5,3", "100,120"), calibration, plane, "4.png", 0.7)
    same(document, measured)
    assert (document["photograph"], document["pixel_sigma"]) == (None, 0.7)
    assert document["plane"] == [-0.1, 0, 1, -12]
    assert document["remarks"][0] == "Point 1 lies outside the photograph of 640 x 480 px."
    assert document["remarks"][1].startswith(
        "Point 2 lies outside of the region that the calibration's corners covered."
    )
    assert [point["extrapolated"] for point in document["points"]] == [True, True]
    for points in (("--points=-5,3", "--points", "100,120"), ("--points=-5,3", "100,120")):
        code, out, _ = run(capsys, *options, *points)
        assert code == 0
        assert "│ 1, 2 " in out
    assert "camera.json: view 4.png\n" in out
    assert "Points on the plane -0.1 x + z = -12, in the calibration's unit" in out


@pytest.mark.parametrize("file", ["camera.yaml", "alone.json", "older.json"])
def test_camera_without_covariance(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--camera", file, "photo.png", *BOARD, "--points", *CORNERS)
    document = parsed(capsys, *options)
    board = dp.Chessboard(8, 5, 25.0)
    located = dp.locate(dp.detect("photo.png", board), board, dp.load_camera(file))
    same(document, dp.measure(pixels(*CORNERS), located, dp.Plane.z(0.0), 0, 0.5))
    assert document["deviations_include"] == ["pixels", "pose"]
    code, out, _ = run(capsys, *options)
    assert code == 0
    assert "NOT how surely the camera is" in " ".join(out.split())


def test_view_without_covariance(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--camera", "older.json", "--view", "1.png", "--points", *CORNERS)
    code, out, err = run(capsys, *options, "--pixel-sigma", "detector")
    assert (code, out) == (1, "")
    assert "--pixel-sigma: want a number of px, for older.json does not tell the detector's noise" in err
    assert parsed(capsys, *options)["deviations_include"] == ["pixels"]
    _, out, _ = run(capsys, *options, "--pixel-sigma", "0.7")
    assert "hold 0.7 px for each pixel ONLY" in out


def test_a_view_whose_pose_may_be_the_wrong_one_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    board, camera = dp.Chessboard(8, 5, 25.0), dp.load_camera("alone.json")
    tilted = dp.rotation_from_euler(*torch.tensor([0.15, 0.1, 0.3], dtype=D))
    corners, _ = camera.at(tilted, torch.tensor([0.0, 0, 6000], dtype=D)).project(board.points)
    noise = 0.3 * torch.randn(corners.shape, generator=torch.Generator().manual_seed(0), dtype=D)
    with pytest.warns(dp.AmbiguousPoseWarning):
        found = dp.locate(dp.Views((corners + noise)[None], names=["far.png"], size=(640, 480)), board, camera)
    dp.save_camera("far.json", found)
    options = ("--camera", "far.json", "--view", "far.png", "--points", "320,240", "330,250")
    try:
        document = parsed(capsys, *options)
        assert document["remarks"][-1].startswith("The board's corners fit two poses, and the one taken is only ")
        same(document, dp.measure(pixels("320,240", "330,250"), found, dp.Plane.z(0.0), 0, 0.5))
        assert "tells them apart" in " ".join(run(capsys, *options)[1].split())
    finally:
        Path("far.json").unlink()


def test_located_with_a_camera_alone_does_not_know_the_camera(capsys: pytest.CaptureFixture[str]) -> None:
    board = dp.Chessboard(8, 5, 25.0)
    located = dp.locate(dp.detect("photo.png", board), board, dp.load_camera("alone.json"))
    dp.save_camera("located.json", located)
    options = ("--camera", "located.json", "--view", "photo.png", "--points", *CORNERS)
    try:
        assert parsed(capsys, *options)["deviations_include"] == ["pixels", "pose"]
        assert "NOT how surely the camera is" in " ".join(run(capsys, *options)[1].split())
    finally:
        Path("located.json").unlink()


def test_text_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    points = [*CORNERS, "395,300.02", "-2000,-4000.5"]
    code, out, err = run(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", *points)
    assert (code, err) == (0, "")
    assert all(len(line) <= 80 for line in out.splitlines())
    assert re.match(r"photo.png: board found\nRMS 0\.\d+ px over 40 corners \(0\.\d+ px in the calibration\)\n", out)
    assert "Points on the plane z = 0, the board's face, in the unit of --square" in " ".join(out.split())
    assert re.search(r"│ +2 │ 402, 140.5 +│ +[\d.]+ ± [\d.]+ +│ +[\d.]+ ± [\d.]+ +│ 0 +│\n", out)
    assert re.search(r"│ +5 │ -2000, -4000.5 │ none +│ none +│ none +│\n", out)
    assert re.search(r"│ 1, 2 +│ +[\d.]+ +│ +[\d.]+ +│ [\d.]+ to [\d.]+ +│\n", out)
    assert re.search(r"│ 4, 5 +│ none +│ +│ +│\n", out)
    assert "The length 3 to 4 is below three deviations: it cannot be told from 0.\n" in out
    assert "Point 5 is not on the plane: its ray meets the plane only behind the camera" in out
    assert "The deviations hold 0.5 px for each pixel, as for points picked by hand" in " ".join(out.split())
    assert "Area of the outline 1 to 5: not known, for not all points are on the plane\n" in out
    assert "how surely the pose and the camera are known" in " ".join(out.split())


def test_points_without_a_place_are_null(capsys: pytest.CaptureFixture[str]) -> None:
    points = ("-2000,-4000.5", "210,130", "211,130")
    document = parsed(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", *points)
    first = document["points"][0]
    assert (first["valid"], first["reason"], first["world"], first["deviation"]) == (False, "BEHIND", None, None)
    unknown = {"value": None, "deviation": None, "interval_95": None, "significant": None}
    assert document["area"] == {"name": "1 to 3", **unknown}
    assert document["lengths"][0] == {"from": 1, "to": 2, "name": "1, 2", **unknown}
    assert document["lengths"][1]["value"] > 0
    assert set(REASONS) == set(dp.Reason) - {dp.Reason.VALID}


def test_remarks_on_lengths_and_areas(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--camera", "camera.json", "--view", "4.png", "--points")
    code, out, _ = run(capsys, *options, "300,200")
    assert code == 0
    assert "Lengths" not in out
    assert "Area" not in out
    document = parsed(capsys, *options, "300,200", "300,200", "300.1,200")
    assert [row["significant"] for row in (*document["lengths"], document["area"])] == [False, False, False]
    assert len(document["remarks"]) == 3
    document = parsed(capsys, *options, "200,200", "300,300", "300,200", "200,300")
    assert document["remarks"] == [
        "The outline crosses itself, so its area means little: give the points in order around it."
    ]
    _, out, _ = run(capsys, *options, "300,200", "300,200", "--pixel-sigma", "detector")
    assert re.search(r"│ 1, 2 +│ 0\.00+ +│ 0\.\d\d+ +│ 0\.00+ to 0\.\d+ +│\n", out)
    _, out, _ = run(capsys, *options, "100,100", "300,300", "100,300")
    assert re.search(r"\nArea of the outline 1 to 3: [\d.]+ ± [\d.]+, 95 % interval [\d.]+ to [\d.]+\n", out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--view", "40.png"], "--view: want a view of camera.json, got '40.png'; it has 1.png, 2.png"),
        (["--view", "10.png"], "--view: '10.png' was left out of the calibration in camera.json"),
        (["--view", "1.png", "--camera", "camera.yaml"], "--view: want a .json with a whole calibration"),
        (["--view", "1.png", "--camera", "alike.json"], "got '1.png', which 10 views of alike.json have"),
        (["--view", "1.png", "--camera", "many.json"], "--camera: want one camera, got 2 side by side in many.json"),
        (["--view", "1.png", "--camera", "damaged.json"], "damaged.json: the calibration in this file is damaged"),
        (["--view", "1.png", "--camera", "nowhere.json"], "nowhere.json: No such file or directory"),
        (["empty.png", *BOARD], "want a board with 8 x 5 inner corners, found none in empty.png. Check"),
        (["nowhere.png", *BOARD], "no such file: nowhere.png"),
        ([".", *BOARD], "PHOTO: want one photograph, got the folder ."),
        (["small.png", *BOARD], "PHOTO: want 640 x 480 px as in camera.json, got 600 x 480 px in small.png; take"),
    ],
)
def test_failures_are_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    photograph = arguments[:1] if not arguments[0].startswith("-") else []
    rest = arguments[len(photograph) :]
    code, out, err = run(capsys, *photograph, "--camera", "camera.json", *rest, "--points", *CORNERS)
    assert (code, out) == (1, "")
    (line,) = err.strip().splitlines()
    assert message in line


def test_corners_that_no_pose_explains(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise dp.CalibrationError("locate: diverged")

    monkeypatch.setattr("diffproj.cli.scene.locate", fail)
    code, out, err = run(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", *CORNERS)
    assert (code, out) == (1, "")
    assert "photo.png: no pose of the board explains its corners; check --camera and the board's options" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--view", "1.png", "--points", "1;2"], "--points: want pixels as u,v without a space, such as 320.5,240"),
        (["--view", "1.png", "--points", "-1,2,3"], "got '-1,2,3'"),
        (["--view", "1.png", "--points", "1,nan"], "got '1,nan'"),
        (["--view", "1.png", "--points", "1,2", "photo.png"], "got 'photo.png'; the photograph comes first"),
        (["--view", "1.png"], "one of the arguments --points --points-file --page is required"),
        (
            ["--points", "1,2"],
            "one of the arguments --board --charuco --aprilgrid --circles --target --view is required",
        ),
        (["--view", "1.png", *BOARD, "--points", "1,2"], "--board: not allowed with argument --view"),
        (["photo.png", "--view", "1.png", "--points", "1,2"], "PHOTO: not with --view"),
        (["--view", "1.png", "--square", "25", "--points", "1,2"], "--square: goes with --board"),
        ([*BOARD, "--points", "1,2"], "PHOTO: want a photograph that shows the board, got none"),
        (["photo.png", "--board", "8x5", "--points", "1,2"], "--square: want the side of the board's squares"),
        (["--view", "1.png", "--points", "1,2", "--plane", "0,0,0,5"], "a, b and c not all 0"),
        (["--view", "1.png", "--points", "1,2", "--plane", "-1,0,5"], "got '-1,0,5'"),
        (["--view", "1.png", "--points", "1,2", "--pixel-sigma", "0"], "want a positive number of pixels"),
        (["--view", "1.png", "--points", "1,2", "--pixel-sigma", "-1"], "want a positive number of pixels"),
    ],
)
def test_options_are_checked_first(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, "--camera", "nowhere.json", *arguments)
    assert (code, out) == (2, "")
    assert message in err


def test_a_page_to_measure_in(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Of a new photograph, on a box, along with points; and of a view's own photograph alone."""
    new, stored = tmp_path / "new.html", tmp_path / "stored.html"
    box = ("photo.png", "--camera", "camera.json", *BOARD, "--height", "12", "--points", *CORNERS)
    code, out, err = run(capsys, *box, "--page", str(new))
    assert (code, err) == (0, "")
    assert f"Page written to {new}" in " ".join(out.split())
    arguments = ("photo.png", "--camera", "camera.json", "--view", "1.png", "--page", str(stored))
    code, out, err = run(capsys, *arguments)
    assert (code, out, err) == (0, f"Written to {stored}: open it in a browser\n", "")
    code, out, _ = run(capsys, *arguments, "--json")
    assert json.loads(out) == {"page": str(stored), "warnings": []}
    models = []
    for path in (new, stored):
        found = re.search(r'id="measuring-data">(.*?)</script>', path.read_text(encoding="utf-8"))
        assert found
        models.append(json.loads(found[1]))
    assert [plane["offset"] for plane in models[0]["model"]["planes"]] == [-12.0, 0.0]
    assert [plane["offset"] for plane in models[1]["model"]["planes"]] == [0.0]
    assert models[0]["size"] == [640, 480]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("small.png", "--view", "1.png", "--page", "page.html"), 1, "photograph: want 640 x 480 px"),
        (("nowhere.png", "--view", "1.png", "--page", "page.html"), 1, "nowhere.png"),
        (("photo.png", "--view", "1.png", "--page", "page.pdf"), 2, "--page: want a file ending in .html or .htm"),
        (("photo.png", "--view", "1.png", "--page", "nowhere/page.html"), 1, "--page: no such folder: nowhere"),
        (("--view", "1.png", "--page", "page.html"), 2, "PHOTO: want the photograph of --view for --page"),
    ],
)
def test_no_page_without_its_photograph(
    arguments: tuple[str, ...], code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    found, out, err = run(capsys, "--camera", "camera.json", *arguments)
    assert (found, out) == (code, "")
    assert message in err
    assert not Path("page.html").exists()


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "--help")
    assert code == 0
    assert all(len(line) <= 80 for line in out.splitlines())
    assert "The origin is the first inner corner" in out


def test_lists_of_numbers_are_no_options() -> None:
    assert shielded(["-o", "--x=-5,3", "--x=5,3", "--x=-5", "-5,3", "-.5,3", "-1", "5,-3"]) == [
        "-o",
        *("--x", " -5,3"),
        *("--x", "5,3"),
        "--x=-5",
        " -5,3",
        " -.5,3",
        "-1",
        "5,-3",
    ]
    assert shielded(["--csv=-a,b.csv"]) == ["--csv=-a,b.csv"]
    lengths = ["-3mm", "-.5 cm", "-2.5IN", "-3 µm", "-1e-3", "-1E2m", *(f"-3{unit}" for unit in METRES)]
    lengths += ["-3inch", "-3 feet", "-.5e-2metres", '-3"', "-3'", "-3''"]  # which are no units here, as is told then
    assert shielded(lengths) == [f" {length}" for length in lengths]
    others = ["-3", "-.5", "-1.jpg", "-v", "-mm", "3mm", "-"]
    assert shielded(others) == others


@pytest.mark.parametrize("height", ["-3inch", '-3"', "-3 feet", "-3yd"])
def test_a_negative_height_in_an_unknown_unit_is_told_the_known_ones(
    height: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = run(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", "1,2", "--height", height)
    assert code == 2
    told = f"--height: want one of the units um, µm, mm, cm, m, in, ft, such as 25mm, got {height!r}"
    assert told in " ".join(err.split())


def test_equations_and_quantities_for_people() -> None:
    assert equation([0, 0, 1, 0]) == "z = 0"
    assert equation([0, -1, 0.5, -3]) == "-y + 0.5 z = -3"
    assert equation([2, -3, 0, 1]) == "2 x - 3 y = 1"
    assert equation([0.1, 0.2, 1, 1725135.5]) == "0.1 x + 0.2 y + z = 1725135.5"
    assert coordinate([2.5, 0.0, 1e-12], [None, 0.2, 1e-17], 0) == ("2.5", " ± unknown")
    assert coordinate([2.5, 0.0, 1e-12], [None, 0.2, 1e-17], 1) == ("0.00", " ± 0.20")
    assert coordinate([2.5, 0.0, 1e-12], [None, 0.2, 1e-17], 2) == ("0", "")
    far = [642730.0, 8304290.0, 0.002], [0.004, 0.006, 0.0]  # UTM: millimetres of millions of metres
    assert [coordinate(*far, axis)[1] for axis in range(3)] == [" \u00b1 0.0040", " \u00b1 0.0060", ""]
    assert coordinate(*far, 2)[0] == "0.002"
    assert coordinate([642730.0, 8304290.0, 1e-9], [0.004, 0.006, 1e-18], 2) == ("0", "")
    assert shown({"value": 2.5, "deviation": None, "interval_95": None}) == ("2.5", "unknown", "unknown")
    assert shown({"value": 900.0, "deviation": 300.0, "interval_95": [500.0, None]}) == ("900", "300", "from 500")


def test_intervals_and_lists_for_people() -> None:
    assert between(1.234, 2.345, 0.25) == "1.23 to 2.35"
    assert between(1.234, math.inf, 0.25) == "from 1.23"
    assert between(-math.inf, 12.6, 3.0) == "up to 12.6"
    assert between(-math.inf, math.inf, math.inf) == "unknown"
    assert between(5.0, 5.0, 0.0) == "5.000 to 5.000"
    assert listed("Point", ["2"]) == "Point 2 lies"
    assert listed("Point", ["2", "3", "5"]) == "Points 2, 3 and 5 lie"


@pytest.mark.parametrize(("axes", "towards"), [("opencv", -1), ("paper", 1)])
def test_heights_are_above_the_face_in_every_frame(
    axes: str, towards: int, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Towards the camera, where things look larger: the same pixels lie closer together."""
    seen = synthetic.corner_views(dp.paper_setup().fit, dp.Chessboard(8, 5, 25.0, axes="paper"))
    file = str(tmp_path / "camera.json")
    dp.save_camera(file, dp.calibrate(seen, dp.Chessboard(8, 5, 25.0, axes=axes), "none"))
    options = ("--camera", file, "--view", seen.names[3], "--points", "300,200", "420,300")
    above = parsed(capsys, *options, "--height", "12")
    below = parsed(capsys, *options, "--height", "-3")
    assert parsed(capsys, "--height", "-3e0", *options) == below
    assert (above["plane"], above["height"]) == ([0, 0, 1, 12 * towards], 12)
    assert (below["plane"], below["height"]) == ([0, 0, 1, -3 * towards], -3)
    assert above["lengths"][0]["value"] < below["lengths"][0]["value"]
    _, out, _ = run(capsys, *options, "--plane", "0,0,-2,-24")  # z = 12, whatever the frame
    side = {-1: "below", 1: "above"}[towards]
    assert f"Points on the plane -2 z = -24, 12 {side} the board's face, in" in " ".join(out.split())
    assert parsed(capsys, *options, "--plane", "0.1,0,1,0")["height"] is None


def test_units_stand_in_every_table(capsys: pytest.CaptureFixture[str]) -> None:
    located = ("photo.png", "--camera", "units.json", "--board", "8x5", "--points", *CORNERS)
    calibration = dp.load_calibration("camera.json")
    dp.save_camera("units.json", replace(calibration, unit="mm"))
    try:
        _, out, err = run(capsys, *located, "--square", "25", "--height", "0.2cm")
        text = " ".join(out.split())
        assert err == ""
        assert "Points on the plane z = -2, 2 mm above the board's face, in mm" in text
        assert "Lengths in mm" in text
        assert re.search(r"Area of the outline 1 to 3: \d+ ± \d+ mm², 95 %", text)
        _, out, _ = run(capsys, "--camera", "units.json", "--view", "4.png", "--points", *CORNERS)
        assert "Lengths in mm" in out
        _, out, err = run(capsys, *located, "--square", "1in", "--json")
        warned = "--square: 1 in here, and 25 mm in units.json: right only where it is another board"
        assert err == f"diffproj: {warned}\n"
        document = json.loads(out)
        assert (document["unit"], document["square"], document["warnings"]) == ("in", 1.0, [warned])
    finally:
        Path("units.json").unlink()


def test_named_points_from_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "points.csv"
    file.write_text("name;u;v\nhinge [left];210,5;133\nlatch;402;140,5\nfoot;395;300\n")
    options = ("photo.png", "--camera", "camera.json", *BOARD, "--points-file", str(file))
    document = parsed(capsys, *options)
    plain = parsed(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", *CORNERS)
    assert [point["name"] for point in document["points"]] == ["hinge [left]", "latch", "foot"]
    assert [point["world"] for point in document["points"]] == [point["world"] for point in plain["points"]]
    assert document["lengths"][0]["name"] == "hinge [left], latch"
    _, out, _ = run(capsys, *options)
    assert "│ hinge [left], latch │" in out
    assert "Area of the outline hinge [left] to foot: " in out


def test_tables_for_spreadsheets(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("photo.png", "--camera", "camera.json", "--board", "8x5", "--square", "25mm", "--points", *CORNERS)
    document = parsed(capsys, *options, "-2000,-4000.5")
    code, out, err = run(capsys, *options, "-2000,-4000.5", "--csv")
    assert (code, err) == (0, "")
    rows = list(csv.DictReader(io.StringIO(out)))
    assert [row["what"] for row in rows] == ["point"] * 4 + ["length"] * 3 + ["area"]
    for row, point in zip(rows, document["points"], strict=False):
        cells = [float(row[axis]) for axis in "xyz"] if point["valid"] else None
        assert cells == point["world"]
        assert [float(row["u"]), float(row["v"])] == point["pixel"]
    assert (rows[0]["unit"], rows[3]["remark"], rows[3]["x"]) == ("mm", "BEHIND", "")
    first, length = rows[4], document["lengths"][0]
    assert [float(first[key]) for key in ("value", "deviation", "low_95", "high_95")] == [
        length["value"],
        length["deviation"],
        *length["interval_95"],
    ]
    assert (first["name"], first["unit"], rows[-1]["unit"], rows[-1]["value"]) == ("1, 2", "mm", "mm^2", "")


def test_with_a_table_it_is_told_what_its_deviations_lack(capsys: pytest.CaptureFixture[str]) -> None:
    """A table has no place for it, so that those of a camera without deviations looked like all others."""
    options = ("photo.png", *BOARD, "--points", *CORNERS, "--csv", "--quiet")
    code, out, err = run(capsys, *options, "--camera", "camera.yaml")
    assert code == 0
    assert err.startswith("diffproj: The deviations hold 0.5 px for each pixel, as for points picked by hand")
    assert "but NOT how surely the camera is, for its file does not tell" in err
    assert out.startswith("what,name,u,v")


def test_the_table_says_what_is_doubtful(capsys: pytest.CaptureFixture[str]) -> None:
    """What is measured by another camera stood there like everything else: doubts were on standard error alone."""
    options = ("photo.png", "--camera", "camera.json", *BOARD, "--points", *CORNERS, "-9000,100", "--json")
    document = json.loads(run(capsys, *options)[1])
    for doubts, remark in ((None, ""), ("another camera, zoom or focus?", "DOUBTFUL")):
        rows = list(csv.DictReader(io.StringIO(as_csv(document | {"doubts": doubts}))))
        there = [row for row in rows if row["x"] or row["value"]]
        assert {row["what"] for row in there} == {"point", "length"}
        assert {remark in row["remark"] for row in there} == {True}
        assert all("DOUBTFUL" not in row["remark"] for row in rows if row not in there)
        assert all(row["remark"] in ("", remark) for row in there)


def test_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "measured.png"
    points = ("--points", *CORNERS, "-60,200", "-9000,100", "-2000,-4000.5")
    options = ("photo.png", "--camera", "camera.json", *BOARD, *points)
    code, out, _ = run(capsys, *options, "--draw", str(file))
    assert code == 0
    assert out.endswith(f"\nDrawn to {file}\n")
    image = cv2.imread(str(file))
    assert image is not None
    assert image.shape[1] == 1200
    json.loads(
        run(capsys, "--camera", "camera.json", "--view", "4.png", "--points", *CORNERS, "--draw", str(file), "--json")[
            1
        ]
    )
    blank = cv2.imread(str(file))
    assert blank is not None
    assert blank.mean() > image.mean()  # no photograph is there


def test_lengths_in_a_picture_say_where_they_are_not_known() -> None:
    """In the picture a length without a finite deviation, 702.393 mm, looked surer than all others."""
    told = {"value": 90.23733, "deviation": 0.35345, "interval_95": [89.5, 90.9]}
    assert length_in_words(told, "mm") == "90.24 ± 0.35 mm"
    assert length_in_words({"value": 702.3931, "deviation": None, "interval_95": None}, "mm") == "702.393 ± unknown mm"
    assert length_in_words({"value": None, "deviation": None, "interval_95": None}, "mm") == ""


def test_hand_picked_lengths_are_covered() -> None:
    """300 cameras calibrated from 10 views, and a photograph by each, in which 6 points are picked by hand.

    Measured: 94.5 % of the 1500 intervals hold the truth; with the noise of the detector it was 30 %.
    """
    board, generator = dp.Chessboard(), torch.Generator().manual_seed(0)
    truth = dp.calibrate(dp.example_views("left"), board).cameras
    corners, _ = truth.project(board.points)

    def seen(which: slice) -> dp.Views:
        places = corners[which].expand(300, -1, -1, -1)
        noise = 0.1 * torch.randn(places.shape, generator=generator, dtype=D)
        return dp.Views(places + noise, size=(640, 480))

    located = dp.locate(seen(slice(10, 11)), board, dp.calibrate(seen(slice(10)), board))
    points = torch.tensor([[10.0, 20], [150, 30], [120, 110], [20, 90], [60, -20], [190, 60]], dtype=D)
    points = torch.nn.functional.pad(points, (0, 1))
    lengths = (points[1:] - points[:-1]).norm(dim=-1)
    picked = truth[10].project(points)[0] + 0.5 * torch.randn(300, 6, 2, generator=generator, dtype=D)
    low, high = dp.measure(picked, located, dp.Plane.z(0.0), 0, HAND).lengths().interval()
    assert 0.93 <= float(((low <= lengths) & (lengths <= high)).double().mean()) <= 0.97


def test_warnings_are_in_the_document(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each once, whatever function of the library it came from."""

    def locate(*arguments: Any) -> dp.Calibration:
        for name in ("locate", "measure", "measure"):
            warnings.warn(f"{name}: the photograph is odd: look again", stacklevel=2)
        return dp.locate(*arguments)

    monkeypatch.setattr("diffproj.cli.scene.locate", locate)
    _, out, err = run(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", *CORNERS, "--json")
    assert json.loads(out)["warnings"] == ["the photograph is odd: look again"]
    assert err == "diffproj: the photograph is odd: look again\n"


def test_the_photograph_of_another_camera_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a camera whose focal length is 10 % longer, on the screen and in the document, once."""
    calibration = dp.load_calibration("camera.json")
    K = calibration.camera.K.clone()
    K[:2, :2] *= 1.1
    seen = dp.paper_setup().test[3]
    other = dp.Camera(K, seen.R, seen.t, size=(640, 480))
    image = synthetic.photograph(other, dp.Chessboard(8, 5, 25.0, axes="paper")).numpy()
    cv2.imwrite(str(tmp_path / "other.png"), image)
    options = (str(tmp_path / "other.png"), "--camera", "camera.json", *BOARD, "--points", *CORNERS, "--json")
    _, out, err = run(capsys, *options)
    (warned,) = json.loads(out)["warnings"]
    assert "other.png" in warned
    assert "another camera, zoom or focus" in warned
    assert err == f"diffproj: {warned}\n"


def test_a_hand_picks_as_the_library_says() -> None:
    assert HAND == HAND_PX


@pytest.mark.parametrize(
    ("orientation", "told", "place"),
    [
        (1, "", None),
        (3, "(639 - x, 479 - y)", (602, 378)),
        (6, "(y, 479 - x)", (101, 442)),
        (8, "(639 - y, x)", (538, 37)),
        (2, "(639 - x, y)", (602, 101)),
        (4, "(x, 479 - y)", (37, 378)),
        (5, "(y, x)", (101, 37)),
        (7, "(639 - y, 479 - x)", (538, 442)),
    ],
    ids=["as it is", "upside down", "right", "left", "mirrored", "upside down in water", "about x = y", "about x = -y"],
)
def test_a_photograph_that_programs_show_turned_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], orientation: int, told: str, place: tuple[int, int] | None
) -> None:
    """Points are read off in programs that turn it; what is said of them leads to the pixels that are measured."""
    image = cv2.imread("photo.png", cv2.IMREAD_GRAYSCALE)
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    path = tmp_path / "turned.jpg"
    path.write_bytes(with_orientation(jpeg, orientation))
    code, _, err = run(capsys, path, "--camera", "camera.json", *BOARD, "--points", CORNERS[0])
    assert code == 0
    how = "mirrored" if orientation in (2, 4, 5, 7) else "turned"
    assert (f"ask programs to show it {how}, and --points count as the sensor" in " ".join(err.split())) == (
        orientation != 1
    )
    assert ("x and y are mirrored; to count pixels as viewers show them, give --orientation upright" in err) == (
        how == "mirrored"
    )
    assert ("one that they show at (x, y) is" in " ".join(err.split())) == bool(told)
    assert told in " ".join(err.split())
    if place is not None:  # of (37, 101)
        recorded, shown = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | flag) for flag in (128, 0))
        assert abs(int(recorded[place[::-1]]) - int(shown[101, 37])) <= 1
    code, _, err = run(
        capsys, path, "--camera", "camera.json", *BOARD, "--points", CORNERS[0], "--orientation", "upright"
    )
    assert f"ask programs to show it {how}" not in err
    refused = "leave out --orientation upright, with which EXIF data turn this one" in " ".join(err.split())
    assert refused == (code == 1) == (orientation in (5, 6, 7, 8))  # the camera's photographs are 640 x 480 px


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_what_is_shown_turned_is_told_of_every_format_that_is_turned(tmp_path: Path, suffix: str) -> None:
    """And of a file that a pattern names."""
    exif = Image.Exif()
    exif[0x0112] = 6
    path = tmp_path / f"turned{suffix}"
    Image.fromarray(cv2.imread("photo.png", cv2.IMREAD_GRAYSCALE)).save(path, exif=exif.tobytes())
    turned = decoded(path, "sensor").shape != decoded(path, "upright").shape
    assert turned or suffix == ".webp"  # of which not every OpenCV follows the data
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        warn_if_shown_turned(tmp_path / "turned.*", "sensor", "--points")
    assert [str(one.message).startswith(f"{path}: its EXIF data") for one in told] == [True] * turned


def test_a_photograph_that_is_turned_is_not_called_resized(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "turned.png"), cv2.rotate(cv2.imread("photo.png"), cv2.ROTATE_90_CLOCKWISE))
    code, _, err = run(capsys, tmp_path / "turned.png", "--camera", "camera.json", *BOARD, "--points", CORNERS[0])
    assert code == 1
    assert "it is turned against those that the camera was calibrated on" in " ".join(err.split())


def test_a_doubt_is_told_with_the_numbers_and_in_the_drawing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was on standard error alone, so that a file with the output, and a drawing, looked like any other."""
    photograph = cv2.imread("photo.png", cv2.IMREAD_GRAYSCALE)
    assert photograph is not None
    part = cv2.resize(photograph[:, 40:600], (640, 480), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(tmp_path / "stretched.png"), part)
    drawn = []
    monkeypatch.setattr(figures, "measured", lambda *_, title, **__: drawn.append(title) or Figure())
    options = ("--camera", "camera.json", *BOARD, "--points", *CORNERS, "--draw", str(tmp_path / "a.png"))
    _, out, err = run(capsys, str(tmp_path / "stretched.png"), *options)
    assert "another camera, zoom or focus" in err
    assert "DOUBTFUL: the residuals of stretched.png are" in out
    assert "\nDOUBTFUL: the residuals of stretched.png are" in drawn[0]
    _, out, err = run(capsys, "photo.png", *options)
    assert "DOUBTFUL" not in out + err + drawn[1]
