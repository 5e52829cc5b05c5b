"""`diffproj measure` as a stranger meets it: what it prints, its JSON, its exit codes and its one-line errors."""

import json
import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj import cli, synthetic
from diffproj.cli import shielded
from diffproj.cli.measure_document import REASONS, between, crosses, listed
from diffproj.cli.measure_tables import coordinate, equation, shown

D = torch.float64
BOARD = ("--board", "8x5", "--square", "25")
CORNERS = ("210.5,133", "402,140.5", "395,300")
NAMES = [f"{i}.png" for i in range(1, 11)]


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


@pytest.fixture(autouse=True)
def there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    try:
        code = cli.main(["measure", *arguments])
    except SystemExit as error:
        code = int(error.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def parsed(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    code, out, err = run(capsys, *arguments, "--json")
    assert (code, err) == (0, "")

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    return json.loads(out, parse_constant=refuse)


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
    same(document, dp.measure(pixels(*CORNERS), located, dp.Plane.z(0.0), pixel_sigma="detector"))
    assert document["pixel_sigma"] == float(located.pixel_sigma)  # type: ignore[arg-type]
    assert document["deviations_include"] == ["pixels", "pose", "camera"]
    assert (document["photograph"], document["view"], document["remarks"]) == ("photo.png", "photo.png", [])


def test_corners_of_the_board_come_out_where_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    corners = dp.detect("photo.png", dp.Chessboard(8, 5, 25.0)).pixels[0, [0, 7, 39, 32]]
    texts = [f"{u},{v}" for u, v in corners.tolist()]
    document = parsed(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", *texts)
    for found, true in zip([*document["lengths"], document["area"]], [175, 100, 175, 175 * 100], strict=True):
        assert abs(found["value"] - true) < 4 * found["deviation"] < 0.01 * true


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
    code, out, _ = run(capsys, *options, "--points=-5,3", "--points", "100,120")
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
    same(document, dp.measure(pixels(*CORNERS), located, dp.Plane.z(0.0), pixel_sigma="detector"))
    assert document["deviations_include"] == ["pixels", "pose"]
    code, out, _ = run(capsys, *options)
    assert code == 0
    assert "NOT how surely the camera is" in " ".join(out.split())


def test_view_without_covariance(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--camera", "older.json", "--view", "1.png", "--points", *CORNERS)
    code, out, err = run(capsys, *options)
    assert (code, out) == (1, "")
    assert "--pixel-sigma: want the noise of the pixels in px, for older.json does not tell it" in err
    assert parsed(capsys, *options, "--pixel-sigma", "0.5")["deviations_include"] == ["pixels"]
    _, out, _ = run(capsys, *options, "--pixel-sigma", "0.5")
    assert "the pixels' noise of 0.5 px ONLY" in out


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
        same(document, dp.measure(pixels("320,240", "330,250"), found, dp.Plane.z(0.0), pixel_sigma="detector"))
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
    assert "Points on the plane z = 0, in the unit of --square" in out
    assert re.search(r"│ +2 │ 402, 140.5 +│ +[\d.]+ ± [\d.]+ +│ +[\d.]+ ± [\d.]+ +│ 0 +│\n", out)
    assert re.search(r"│ +5 │ -2000, -4000.5 │ none +│ none +│ none +│\n", out)
    assert re.search(r"│ 1, 2 +│ +[\d.]+ +│ +[\d.]+ +│ [\d.]+ to [\d.]+ +│\n", out)
    assert re.search(r"│ 4, 5 +│ none +│ +│ +│\n", out)
    assert "The length 3 to 4 is below three deviations: it cannot be told from 0.\n" in out
    assert "Point 5 is not on the plane: its ray meets the plane only behind the camera" in out
    assert "Area of the outline 1 to 5: not known, for not all points are on the plane\n" in out
    assert "how surely the pose and the camera are known" in " ".join(out.split())


def test_points_without_a_place_are_null(capsys: pytest.CaptureFixture[str]) -> None:
    points = ("-2000,-4000.5", "210,130", "211,130")
    document = parsed(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", *points)
    first = document["points"][0]
    assert (first["valid"], first["reason"], first["world"], first["deviation"]) == (False, "BEHIND", None, None)
    unknown = {"value": None, "deviation": None, "interval_95": None, "significant": None}
    assert document["area"] == unknown
    assert document["lengths"][0] == {"from": 1, "to": 2, **unknown}
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
    _, out, _ = run(capsys, *options, "300,200", "300,200")
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
        ([".", *BOARD], "PHOTO: want one photograph, got 3 in ."),
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

    monkeypatch.setattr("diffproj.cli.scene.located", fail)
    code, out, err = run(capsys, "photo.png", "--camera", "camera.json", *BOARD, "--points", *CORNERS)
    assert (code, out) == (1, "")
    assert "photo.png: no pose of the board explains its corners; check --camera, --board and --square" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--view", "1.png", "--points", "1;2"], "--points: want pixels as u,v without a space, such as 320.5,240"),
        (["--view", "1.png", "--points", "-1,2,3"], "got '-1,2,3'"),
        (["--view", "1.png", "--points", "1,nan"], "got '1,nan'"),
        (["--view", "1.png", "--points", "1,2", "photo.png"], "got 'photo.png'; the photograph comes first"),
        (["--view", "1.png"], "the following arguments are required: --points"),
        (["--points", "1,2"], "one of the arguments --board --view is required"),
        (["--view", "1.png", *BOARD, "--points", "1,2"], "argument --board: not allowed with argument --view"),
        (["photo.png", "--view", "1.png", "--points", "1,2"], "PHOTO: not with --view"),
        (["--view", "1.png", "--square", "25", "--points", "1,2"], "--square: goes with --board"),
        ([*BOARD, "--points", "1,2"], "PHOTO: want a photograph that shows the board, got none"),
        (["photo.png", "--board", "8x5", "--points", "1,2"], "--square: want the side of the board's squares"),
        (["--view", "1.png", "--points", "1,2", "--plane", "0,0,0,5"], "a, b and c not all 0"),
        (["--view", "1.png", "--points", "1,2", "--plane", "-1,0,5"], "got '-1,0,5'"),
        (["--view", "1.png", "--points", "1,2", "--pixel-sigma", "0"], "want a positive number of pixels"),
        (["--view", "1.png", "--points", "1,2", "--pixel-sigma", "-1"], "want a positive number of pixels"),
        (["--view", "1.png", "--points", "1,2", "--camera", "camera.txt"], "want a file ending in .json"),
    ],
)
def test_options_are_checked_first(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, "--camera", "nowhere.json", *arguments)
    assert (code, out) == (2, "")
    assert message in err


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "--help")
    assert code == 0
    assert all(len(line) <= 80 for line in out.splitlines())
    assert "The origin is the first inner corner" in out


def test_lists_of_numbers_are_no_options() -> None:
    assert shielded(["-o", "--x=-5,3", "-5,3", "-.5,3", "-1", "5,-3"]) == [
        "-o",
        "--x=-5,3",
        " -5,3",
        " -.5,3",
        "-1",
        "5,-3",
    ]


def test_outlines_that_cross() -> None:
    square = [[0.0, 0, 1], [1, 0, 1], [1, 0, 2], [0, 0, 2]]
    assert not crosses(square, (0.0, -1.0, 0.0, 0.0))
    assert crosses([square[i] for i in (0, 2, 1, 3)], (0.0, -1.0, 0.0, 0.0))


def test_equations_and_quantities_for_people() -> None:
    assert equation([0, 0, 1, 0]) == "z = 0"
    assert equation([0, -1, 0.5, -3]) == "-y + 0.5 z = -3"
    assert equation([2, -3, 0, 1]) == "2 x - 3 y = 1"
    assert coordinate([2.5, 0.0, 1e-12], [None, 0.2, 1e-17], 0) == ("2.5", " ± unknown")
    assert coordinate([2.5, 0.0, 1e-12], [None, 0.2, 1e-17], 1) == ("0.00", " ± 0.20")
    assert coordinate([2.5, 0.0, 1e-12], [None, 0.2, 1e-17], 2) == ("0", "")
    assert shown({"value": 2.5, "deviation": None, "interval_95": None}) == ("2.5", "unknown", "unknown")
    assert shown({"value": 900.0, "deviation": 300.0, "interval_95": [500.0, None]}) == ("900", "300", "from 500")


def test_intervals_and_lists_for_people() -> None:
    assert between(1.234, 2.345, 0.25) == "1.23 to 2.35"
    assert between(1.234, math.inf, 0.25) == "from 1.23"
    assert between(-math.inf, 12.6, 3.0) == "up to 12.6"
    assert between(-math.inf, math.inf, math.inf) == "unknown"
    assert between(5.0, 5.0, 0.0) == "5.000 to 5.000"
    assert listed("Point", [2]) == "Point 2 lies"
    assert listed("Point", [2, 3, 5]) == "Points 2, 3 and 5 lie"
