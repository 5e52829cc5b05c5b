"""`diffproj rectify`: where its pixels are on the plane, its files, and the map that they are on."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj import synthetic
from tests.cli.commands import parser, runner

run, parsed = runner("rectify"), parser("rectify")
pytestmark = pytest.mark.usefixtures("there")

BOARD = ("--board", "8x5", "--square", "25mm")
GIVEN = ("photo.png", "--camera", "camera.json", *BOARD)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photograph of a board in colour, the camera, and a camera before landmarks on a map with its photograph."""
    folder = tmp_path_factory.mktemp("rectify")
    setup, upright = dp.paper_setup(), dp.Chessboard(8, 5, 25.0, axes="paper")
    grey = synthetic.photograph(setup.test[3], upright).numpy()
    cv2.imwrite(str(folder / "photo.png"), cv2.merge([grey, grey // 2, grey]))
    cv2.imwrite(str(folder / "deep.png"), cv2.merge([grey.astype(np.uint16) * 200] * 3))
    seen = synthetic.corner_views(setup.fit, upright)
    views = dp.Views(seen.pixels, seen.visible, [f"{i}.png" for i in range(1, 11)], seen.size)
    dp.save_camera(folder / "camera.json", dp.calibrate(views, dp.Chessboard(8, 5, 25.0), "none"))
    mast = dp.Camera.mounted(8.0, 35.0, heading_deg=20.0, position=[500.0, 7000.0], fov_deg=60.0, size=(320, 240))
    places = torch.tensor([[502.0, 7008, 0], [505, 7012, 0], [500, 7014, 0], [507, 7009, 1], [503, 7011, 0.5]])
    places = places.to(torch.float64)
    clicked, _ = mast.project(places)
    located = dp.locate(dp.Views([clicked], names=["mast.png"], size=(320, 240)), dp.Landmarks(places), mast)
    dp.save_camera(folder / "located.json", located)
    spot, _ = mast.project(torch.tensor([[504.0, 7011.0, 0.0]], dtype=torch.float64))
    image = np.full((240, 320), 60, np.uint8)
    cv2.circle(image, tuple(round(x * 16) for x in spot[0].tolist()), 24 * 4, 255, -1, shift=4)
    cv2.imwrite(str(folder / "mast.png"), image)
    return folder


def test_the_boards_corners_are_where_the_extent_says(capsys: pytest.CaptureFixture[str]) -> None:
    found = parsed(capsys, *GIVEN, "--extent", "-30,-30,205,130", "--resolution", "0.05cm", "-o", "board.tif")
    assert found["size"] == [470, 320]
    assert found["extent"] == [-30, -30, 205, 130]
    assert (found["resolution"], found["unit"], found["plane"]) == (0.5, "mm", [0, 0, 1, 0])
    assert not found["north_up"]  # the board's z points away from the camera
    top = cv2.imread("board.tif", cv2.IMREAD_UNCHANGED)
    assert top.shape == (320, 470, 4)
    corners = dp.detect(top[..., :3].copy(), dp.Chessboard(8, 5, 25.0)).pixels[0]
    board = dp.Chessboard(8, 5, 25.0).points[:, :2].to(torch.float64)
    assert (corners - ((board + 30) / 0.5 - 0.5)).abs().max() < 0.1
    b, g, r, alpha = (top[..., i].astype(int) for i in range(4))
    assert (abs(b - r).max(), alpha.min() in (0, 255), alpha.max()) == (0, True, 255)
    assert abs(g - b // 2).max() <= 1


def test_sides_grow_to_whole_pixels_and_much_is_made_in_strips(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    options = (*GIVEN, "--extent", "0,0,100.2,61", "--resolution", "0.5")
    found = parsed(capsys, *options)
    assert found["extent"] == [0, 0, 100.5, 61]
    whole = cv2.imread("top.png", cv2.IMREAD_UNCHANGED)
    monkeypatch.setattr("diffproj.cli.rectifying.STRIP", 1500)
    for north_up in (False, True):
        parsed(capsys, *options, *["--north-up"] * north_up)
        part = cv2.imread("top.png", cv2.IMREAD_UNCHANGED)
        assert abs(part.astype(int) - (whole[::-1] if north_up else whole)).max() <= 2


def test_height_and_depth(capsys: pytest.CaptureFixture[str]) -> None:
    found = parsed(capsys, "deep.png", "--camera", "camera.json", *BOARD, "--height", "10", "-o", "deep_top.png")
    assert found["plane"] == [0, 0, 1, -10]
    top = cv2.imread("deep_top.png", cv2.IMREAD_UNCHANGED)
    assert top.dtype == np.uint16
    assert set(np.unique(top[..., 3])) <= {0, 65535}
    assert top[..., 0].max() > 20000


def test_on_a_map(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(
        capsys, "mast.png", "--camera", "located.json", "--view", "mast.png", "--world-file", "-o", "ground.png",
        "--extent", "495,7003,510,7018", "--resolution", "0.05",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert "Written to ground.png and ground.pgw" in out
    numbers = [float(line) for line in Path("ground.pgw").read_text().splitlines()]
    assert numbers == pytest.approx([0.05, 0, 0, -0.05, 495.025, 7017.975], rel=0, abs=1e-9)
    top = cv2.imread("ground.png", cv2.IMREAD_UNCHANGED)[..., 0]
    rows, columns = np.nonzero(top > 160)
    across, _, _, down, x, y = numbers
    assert x + across * columns.mean() == pytest.approx(504.0, abs=0.1)
    assert y + down * rows.mean() == pytest.approx(7011.0, abs=0.1)
    # The same numbers as GDAL takes, which count from the outer corner.
    gdal = dp.geotransform((495, 7003, 510, 7018), 0.05)
    assert (gdal[0] + 0.025, gdal[3] - 0.025) == pytest.approx((x, y), rel=0, abs=1e-9)


def test_what_is_shown_by_itself(capsys: pytest.CaptureFixture[str]) -> None:
    found = parsed(capsys, *GIVEN)
    assert found["extent"] == [-87.5, -87.5, 262.5, 187.5]
    assert found["resolution"] == 1.0
    assert 0.9 < found["shown"] < 1
    code, out, _ = run(capsys, *GIVEN)
    assert code == 0
    assert "x from -87.5 to 262.5 and y from -87.5 to 187.5 mm: 350 x 275 px of 1 mm" in out
    assert "The plane z = 0, the board's face" in out
    assert "The photograph shows 99 % of it; the rest is transparent" in out


@pytest.mark.parametrize("extent", ["-30mm,-3cm,205mm,13cm", "-0.03m,-30,20.5cm,130"])
def test_the_extent_may_have_units(capsys: pytest.CaptureFixture[str], extent: str) -> None:
    found = parsed(capsys, *GIVEN, "--extent", extent, "--resolution", "1")
    assert found["extent"] == pytest.approx([-30, -30, 205, 130])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((*GIVEN, "--extent", "30cm,0,250,100"), "--extent: want x1 above x0 and y1 above y0, got 30cm,0,250,100"),
        ((*GIVEN, "--extent", "9000,9000,9100,9100"), "--extent: want a part of the plane that the photograph shows"),
        (
            (*GIVEN, "--extent", "9000,9000,9100,9100", "--resolution", "1"),
            "--extent: want a part of the plane that the photograph shows",
        ),
        ((*GIVEN, "--resolution", "1um"), "--resolution: want a top view of at most 1e+08 pixels, got 350000 x 275000"),
        ((*GIVEN, "-o", "photo.png"), "--output: want another file than those that are read"),
        ((*GIVEN, "-o", "gone/top.png"), "--output: no such folder: gone"),
        ((*GIVEN, "--plane", "0,1,1,5", "--world-file"), "--world-file: want a plane z = const"),
        (("mast.png", "--camera", "camera.json", "--view", "1.png"), "PHOTO: want 640 x 480 px as in camera.json"),
        (("mast.png", "--camera", "located.json", "--view", "a.png"), "--view: want a view of located.json"),
        (
            ("mast.png", "--camera", "located.json", "--view", "mast.png", "--resolution", "1mm"),
            "--resolution: want it in the calibration's unit, got 1 mm",
        ),
    ],
)
def test_failures_write_nothing(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str], folder: Path
) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    code, out, err = run(capsys, *arguments)
    (line,) = err.splitlines()
    assert (code, out) == (1, "")
    assert message in line
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before


def test_a_plane_of_any_tilt(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, *GIVEN, "--plane", "0,0.1,1,0", "--json")
    assert code == 0
    assert json.loads(out)["north_up"] is False


def test_a_tilted_plane_names_the_axes_that_its_extent_is_along(capsys: pytest.CaptureFixture[str]) -> None:
    """They are none of the world's, and neither words nor numbers may say so."""
    options = (*GIVEN, "--plane", "0,0.6,0.8,60", "--extent", "0,-20,100,40", "--resolution", "1")
    found = parsed(capsys, *options)
    assert found["origin"] == pytest.approx([0, 36, 48])
    assert found["axes"] == [pytest.approx([1, 0, 0]), pytest.approx([0, 0.8, -0.6])]
    code, text, _ = run(capsys, *options)
    assert code == 0
    assert "From (0, 36, 48), 0 to 100 mm along (1, 0, 0) and -20 to 40 mm along (0, 0.8, -0.6): 100 x 60 px" in text
    level = parsed(capsys, *GIVEN, "--extent", "0,0,100,60", "--resolution", "1")
    assert (level["origin"], level["axes"]) == ([0, 0, 0], [[1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("given", "plane", "said"),
    [
        (
            (*GIVEN,),
            ("--height", "100m"),
            "--height: want a plane that the photograph shows, got z = -100000, 100000 mm",
        ),
        (
            ("mast.png", "--camera", "located.json", "--view", "mast.png"),
            ("--height", "9"),
            "shows, got z = 9, which no",
        ),
        ((*GIVEN, "--extent", "0,0,9,9"), ("--plane", "0,0,1,-1e5"), "--plane: want a plane that the photograph shows"),
    ],
)
def test_a_plane_behind_the_camera_is_named_and_not_its_extent(
    given: tuple[str, ...], plane: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = run(capsys, *given, *plane, "-o", "never.png")
    assert code == 1
    assert said in err
    assert not Path("never.png").exists()


def test_a_doubt_is_told_with_the_result(capsys: pytest.CaptureFixture[str]) -> None:
    """It was on standard error alone."""
    photograph = cv2.imread("photo.png")
    assert photograph is not None
    cv2.imwrite("stretched.png", cv2.resize(photograph[:, 40:600], (640, 480), interpolation=cv2.INTER_CUBIC))
    _, out, _ = run(capsys, "stretched.png", *GIVEN[1:], "-o", "top.png")
    assert "DOUBTFUL: the residuals of stretched.png are" in out
    _, out, _ = run(capsys, "stretched.png", *GIVEN[1:], "-o", "top.png", "--json")
    assert json.loads(out)["doubts"].startswith("the residuals of stretched.png are")
    assert parsed(capsys, *GIVEN, "-o", "top.png")["doubts"] is None
