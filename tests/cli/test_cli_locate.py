"""`diffproj locate`: figures of public demonstrations, what it prints and writes, and its one-line errors."""

import json
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj import cli, figures
from diffproj.cli.landmarks_file import read_landmarks
from tests.cli.commands import parser, runner
from tests.targets.test_detection import with_orientation

BEACH = """name,u,v,x,y,z
mast,2521.9588508,483.68938913,902062.638,274683.639,7.432
wall,2968.64083887,734.49451693,901957.888,274645.217,7.435
gate,3546.11012936,1064.62991583,901887.879,274619.829,7.423
post,3770.57121219,1802.68876725,901811.634,274643.425,7.156
drain,2707.49279597,2059.49402435,901790.934,274691.320,6.585
"""
"""A drone over a beach (the UAS toolbox of the Coastal Imaging Research Network), State Plane metres."""

RIVER = """x;y;z;u;v
192111,36369;313157,71636;138,92348;1779;774
192102,85935;313152,98001;138,526;436;372
192100,16404;313153,16391;139,68308;385;147
192099,97028;313158,91532;138,45433;922;186
192098,38713;313161,31339;138,51091;1041;139
192106,66182;313165,641;138,5616;1785;337
"""
"""A river (an example of pyorc), its focal length unknown; with decimal commas and without names."""

LANDMARKS = ("--landmarks", "beach.csv")
DRONE = ("--camera", "drone.yaml")

run, parsed = runner("locate"), parser("locate")
pytestmark = pytest.mark.usefixtures("there")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cameras and landmarks of both, and files that are not what they should be."""
    folder = tmp_path_factory.mktemp("locate")
    K = [[2298.59, 0, 1957.13], [0, 2310.87, 1088.21], [0, 0, 1]]
    lens = [-0.14185, 0.11168, 0, 0.002314, 0]
    dp.save_camera(folder / "drone.yaml", dp.Camera.from_opencv(K, lens, size=(3840, 2160)))
    dp.save_camera(folder / "sizeless.json", dp.Camera.from_opencv(K, lens))
    K = [[1400, 0, 959.5], [0, 1400, 539.5], [0, 0, 1]]
    dp.save_camera(folder / "rough.yaml", dp.Camera.from_opencv(K, [0, 0, 0, 0], size=(1920, 1080)))
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
    two = dp.Camera(K.expand(2, 3, 3), size=(640, 480))
    dp.save_camera(folder / "two.json", two)
    cv2.imwrite(str(folder / "beach.jpg"), np.full((2160, 3840), 120, np.uint8))
    cv2.imwrite(str(folder / "small.png"), np.full((216, 384), 120, np.uint8))
    (folder / "beach.csv").write_text(BEACH)
    (folder / "river.csv").write_text(RIVER)
    lines = BEACH.splitlines(keepends=True)
    turned = [",".join(reversed(line.split(","))) for line in BEACH.splitlines()]
    files = {
        "reversed.csv": "\n".join(turned),
        "untitled.csv": "".join(lines[1:]),
        "more.csv": BEACH + "# seen from the pier\n\nhut,,,901800,274800,6.5\n",
        "sigma.csv": "".join(f"{line[:-1]},{tail}\n" for line, tail in zip(lines, ["sigma", *"00000"], strict=True)),
        "rough.csv": "".join(
            f"{line[:-1]},{tail},{note}\n"
            for line, tail, note in zip(
                lines, ["pixel_sigma", "2", "2", "2", "", "2"], ["note", "a", "", "", "b", "c"], strict=True
            )
        ),
        "empty.csv": "",
        "titles.csv": lines[0],
        "word.csv": BEACH.replace("274645.217", "far"),
        "inf.csv": BEACH.replace("274645.217", "inf"),
        "gap.csv": BEACH.replace("274645.217", ""),
        "half.csv": BEACH.replace("2968.64083887", ""),
        "short.csv": BEACH.replace(",7.435", ""),
        "long.csv": BEACH.replace("7.435", "7.435,8"),
        "twice.csv": BEACH.replace("wall", "mast"),
        "no_v.csv": BEACH.replace("u,v,", "u,w,"),
        "two_x.csv": BEACH.replace("x,y,z", "x,x,y"),
        "six.csv": "1,2\n",
        "minus.csv": "".join(
            f"{line[:-1]},{s}\n" for line, s in zip(lines, ["sigma_z", *"1"] + ["-1"] * 4, strict=True)
        ),
        "both.csv": "u,v,x,y,sigma,sigma_x\n1,2,3,4,5,6\n",
        "thousands.csv": RIVER.replace("192111,36369", "192.111"),
        "noted.csv": "# a; note\n" + BEACH.replace("mast", "mast; old"),
        "alike.csv": BEACH + "again" + lines[1][4:],
        "mixed.csv": BEACH.replace("2521.9588508,483.68938913", "@")
        .replace("3770.57121219,1802.68876725", "2521.9588508,483.68938913")
        .replace("@", "3770.57121219,1802.68876725"),
        "exchanged.csv": BEACH.replace("x,y,z", "y,x,z"),
        "few.csv": "".join(lines[:4]),
        "line.csv": "name,u,v,x,y,z\n" + "".join(f"{i},{100 * i},{70 * i + 5},{i},{2 * i},{3 * i}\n" for i in range(6)),
        "outside.csv": BEACH.replace("2707.49279597", "9707"),
        "degrees.csv": "u,v,x,y\n1,2,54.1753,12.0812\n3,4,54.1755,12.0815\n5,9,54.1751,12.0817\n9,9,54.175,12.0811\n",
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    (folder / "noise.csv").write_bytes(bytes([200, 13, 7, 255, 0, 60]) * 40)
    (folder / "folder.json").mkdir()
    return folder


def test_a_photograph_that_programs_show_turned_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Landmarks' pixels are read off in such programs; the pose of pixels of a turned image is one, too."""
    image = np.full((2160, 3840), 120, np.uint8)
    image[:1000, :500] = 20
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    (tmp_path / "beach.jpg").write_bytes(with_orientation(jpeg, 6))
    code, _, err = run(capsys, tmp_path / "beach.jpg", *DRONE, *LANDMARKS)
    said = " ".join(err.split())
    assert code == 0
    assert "the pixels in beach.csv count as the sensor recorded it, 3840 x 2160 px" in said
    assert "one that they show at (x, y) is (y, 2159 - x)" in said


def test_a_drone_over_a_beach(capsys: pytest.CaptureFixture[str]) -> None:
    found = parsed(capsys, "beach.jpg", *DRONE, *LANDMARKS)
    expected = {"x": (901727.737, 0.1035), "y": (274710.524, 0.1285), "z": (79.083, 0.2015)}
    for axis, (value, deviation) in expected.items():
        assert found["position"][axis]["value"] == pytest.approx(value, abs=0.005)
        assert found["position"][axis]["deviation"] == pytest.approx(deviation, rel=0.005)
    assert found["rms"] == pytest.approx(1.0690, abs=1e-4)
    assert found["degrees_of_freedom"] == 4
    assert found["worst"] == "gate"
    assert found["landmarks"][2]["off"] == pytest.approx(1.665, abs=0.001)
    assert found["landmarks"][2]["residual"] == [pytest.approx(-1.6402, abs=1e-3), pytest.approx(0.2855, abs=1e-3)]
    assert found["view"] == "beach.jpg"


def test_angles_have_the_deviations_of_an_adjustment(capsys: pytest.CaptureFixture[str]) -> None:
    found = parsed(capsys, *DRONE, *LANDMARKS, "--pixel-sigma", "1.5")
    surveyed = read_landmarks(Path("beach.csv"))
    posed = dp.Camera.mounted(70.0, 25.0, heading_deg=80.0, position=[901700.0, 274700.0], focal=1.0, size=(2, 2))
    start = dp.load_camera("drone.yaml").at(posed.R, posed.t)
    adjusted = dp.adjust(start, dp.Seen(surveyed.landmarks, surveyed.pixels, pixel_sigma=1.5))
    for name in ("tilt", "roll", "heading"):
        assert found["mounting"][name]["value"] == pytest.approx(float(getattr(adjusted.mounting, name)), abs=1e-5)
        spread = float(getattr(adjusted.mounting_deviations, name))
        assert found["mounting"][name]["deviation"] == pytest.approx(spread, rel=1e-4)
    assert found["degrees_of_freedom"] is None
    assert found["pixel_sigma"] == 1.5


def test_people_are_told_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, "beach.jpg", *DRONE, "--landmarks", "more.csv", "--unit", "m")
    assert (code, err) == (0, "")
    assert "beach.jpg: 5 landmarks, RMS 1.069 px" in out
    for row in (
        "x, m .* 901727.74 .* 0.10",
        "z, m .* 79.08 .* 0.20",
        "tilt, degrees below the horizon .* 27.34",
        "heading, degrees from y to x .* 80.77",
        r"gate .* 3546.11, 1064.63 .* -1.64, \+0.29 .* 1.66",
        "hut .* not seen",
        "Farthest off: gate, 1.66 px",
        "residuals tell from 4 degrees of freedom only",
    ):
        assert re.search(row, " ".join(out.splitlines()).replace("NOT", "")), row
    assert all(len(line) <= 80 for line in out.splitlines())


@pytest.mark.parametrize(
    ("name", "arguments"),
    [("reversed.csv", ()), ("untitled.csv", ()), ("more.csv", ()), ("sigma.csv", ()), ("beach.csv", ("--free", "f_x"))],
)
def test_files_and_orders_do_not_matter(
    name: str, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """Columns in any order, no titles, landmarks without pixels, comments, and sigma 0; little changes f_x."""
    found = parsed(capsys, *DRONE, "--landmarks", name, *arguments)
    limit = 1e-6 if not arguments else 5.0
    assert found["position"]["x"]["value"] == pytest.approx(901727.7367, abs=1e-4 + limit)
    names = ["mast", "wall", "gate", "post", "drain"]
    assert [row["name"] for row in found["landmarks"]][:5] == names
    assert list(found["intrinsics"]) == (["f_x"] if arguments else [])


def test_a_river_of_unknown_focal_length(capsys: pytest.CaptureFixture[str]) -> None:
    """1556.5 +- 46.7 px, k1 -.335, RMS 4.196 px; decimal commas, no names, titles in another order."""
    found = parsed(capsys, "--camera", "rough.yaml", "--landmarks", "river.csv", "--free", "focal,k1")
    assert list(found["intrinsics"]) == ["f_x", "f_y", "k1"]
    assert found["intrinsics"]["f_x"]["value"] == pytest.approx(1556.5, abs=0.2)
    assert found["intrinsics"]["f_x"]["deviation"] == pytest.approx(46.7, abs=0.3)
    assert found["intrinsics"]["k1"]["value"] == pytest.approx(-0.335, abs=0.001)
    assert found["rms"] == pytest.approx(4.196, abs=0.001)
    assert [row["name"] for row in found["landmarks"]] == list("123456")
    code, out, _ = run(capsys, "--camera", "rough.yaml", "--landmarks", "river.csv", "--free", "focal,k1")
    assert code == 0
    assert re.search(r"focal length f_x, px +│ +155[67]", out)


def test_deviations_of_pixels_and_landmarks_are_carried(capsys: pytest.CaptureFixture[str]) -> None:
    usual = parsed(capsys, *DRONE, *LANDMARKS, "--pixel-sigma", "2")
    mixed = parsed(capsys, *DRONE, "--landmarks", "rough.csv", "--pixel-sigma", "2")
    assert mixed["position"] == usual["position"]
    Path("loose.csv").write_text(
        "".join(f"{line},{s}\n" for line, s in zip(BEACH.splitlines(), ["sigma", *["0.5"] * 5], strict=True))
    )
    loose = parsed(capsys, *DRONE, "--landmarks", "loose.csv", "--pixel-sigma", "2")
    assert loose["position"]["x"]["deviation"] > 1.3 * usual["position"]["x"]["deviation"]
    assert loose["deviations_include"] == ["pixels", "landmarks"]


def test_the_file_is_measured_with(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """With its covariance: pixel (2000, 1000) on z = 0 is (901894.543, 274734.140) +- (.391, .161) at 1.195 px."""
    out = str(tmp_path / "located.json")
    code, text, err = run(capsys, "beach.jpg", *DRONE, *LANDMARKS, "-o", out, "--unit", "m")
    assert (code, err) == (0, "")
    assert text.endswith(f"Written to {out}\n")
    located = dp.load_calibration(out)
    assert located.unit == "m"
    assert located.landmarks == ("mast", "wall", "gate", "post", "drain")
    measure = ["measure", "--camera", out, "--view", "beach.jpg", "--points", "2000,1000", "2600,900"]
    assert cli.main([*measure, "--pixel-sigma", "detector", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["points"][0]["world"] == [
        pytest.approx(901894.543, abs=0.002),
        pytest.approx(274734.140, abs=0.002),
        pytest.approx(0, abs=1e-9),
    ]
    assert found["points"][0]["deviation"][:2] == [pytest.approx(0.391, rel=0.005), pytest.approx(0.161, rel=0.005)]
    assert (found["unit"], found["square"], found["plane"]) == ("m", None, [0, 0, 1, 0])
    assert cli.main([*measure, "--height", "7.4m"]) == 0
    assert "Points on the plane z = 7.4, in m" in capsys.readouterr().out


def test_what_the_camera_leaves_open_is_carried(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A calibration in the place of a camera brings its covariance along."""
    views, board = dp.example_views("left"), dp.Chessboard()
    calibration = dp.calibrate(views[1:], board)
    dp.save_camera(tmp_path / "camera.json", calibration)
    dp.save_camera(tmp_path / "camera.yaml", calibration)
    rows = zip(views.pixels[0].tolist(), board.points.tolist(), strict=True)
    lines = [",".join(map(str, (*pixel, x, -y, -z))) for pixel, (x, y, z) in rows]  # a board's z leads away from it
    (tmp_path / "corners.csv").write_text("\n".join(["u,v,x,y,z", *lines]))
    options = ["--landmarks", str(tmp_path / "corners.csv"), "--pixel-sigma", "0.2"]
    known, exact = (parsed(capsys, "--camera", str(tmp_path / f"camera.{end}"), *options) for end in ("json", "yaml"))
    assert known["deviations_include"] == ["pixels", "camera"]
    assert exact["deviations_include"] == ["pixels"]
    assert known["position"]["z"]["deviation"] > 1.5 * exact["position"]["z"]["deviation"]


def test_a_wrong_landmark_is_rejected(capsys: pytest.CaptureFixture[str]) -> None:
    camera = dp.Camera.mounted(8.0, 20.0, focal=1000.0, size=(1280, 960))
    points = [[x, y, (x * y) % 3] for x in (-6.0, -2, 2, 6) for y in (14.0, 18, 25)]
    pixels, _ = camera.project(torch.tensor(points, dtype=torch.float64))
    pixels = pixels + 0.3 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pixels[4] += 25
    dp.save_camera("mast.yaml", camera.without_pose())
    rows = [",".join(map(str, (*pixel, *point))) for pixel, point in zip(pixels.tolist(), points, strict=True)]
    Path("mast.csv").write_text("\n".join(["u,v,x,y,z", *rows]))
    found = parsed(capsys, "--camera", "mast.yaml", "--landmarks", "mast.csv", "--reject-outliers")
    assert [row["name"] for row in found["landmarks"] if row["rejected"]] == ["5"]
    assert found["position"]["z"]["value"] == pytest.approx(8.0, abs=0.1)
    assert found["mounting"]["tilt"]["value"] == pytest.approx(20.0, abs=0.2)
    _, out, _ = run(capsys, "--camera", "mast.yaml", "--landmarks", "mast.csv", "--reject-outliers")
    assert "rejected" in out


def test_exchanged_axes_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    """Of nearly level ground the mirror image fits too, from below."""
    assert parsed(capsys, *DRONE, *LANDMARKS)["remarks"] == []
    (remark,) = parsed(capsys, *DRONE, "--landmarks", "exchanged.csv")["remarks"]
    assert "If z points up, x and y are exchanged" in remark
    _, out, _ = run(capsys, *DRONE, "--landmarks", "exchanged.csv")
    assert "The camera is on the side of the landmarks to which z decreases." in out


def test_the_picture(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """It shows landmarks by name, those too that were not said to be seen."""
    out = tmp_path / "located.json"
    picture = tmp_path / "located.png"
    arguments = (*DRONE, "--landmarks", "more.csv", "-o", str(out), "--draw", str(picture))
    code, text, err = run(capsys, *arguments)
    assert (code, err) == (0, "")
    assert f"Drawn to {picture}" in text
    assert cv2.imread(str(picture)).shape[1] == 1200
    located = dp.load_calibration(out)
    (axes,) = figures.landmarks(located, 0, np.full((2160, 3840), 90, np.uint8), "a $ sign").axes
    assert len(axes.images) == 1
    assert [text.get_text() for text in axes.texts] == ["mast", "wall", "gate", "post", "drain", "hut"]
    bare = dp.locate(
        dp.Views(located.views.pixels[:, :5]), dp.Landmarks(located.points[:5]), dp.load_camera("sizeless.json")
    )
    with pytest.raises(ValueError, match="want one camera, whose size or photograph is known"):
        figures.landmarks(bare)


MAST = """name,u,v,x,y
m0,522.262,757.193,109.9413,224.2934
m1,1283.634,467.345,136.5859,228.0441
m2,587.407,368.361,127.0766,255.6045
m3,1240.050,653.880,123.8799,219.1246
m4,1336.106,294.309,166.7439,248.4278
"""
"""Marks on the ground around a mast 12.3 high at (100, 200), seen by a camera of f = 1510 with a noise of 1 px."""


@pytest.fixture
def mast(tmp_path: Path) -> tuple[str, ...]:
    """The options for it; the camera's file has f = 1560."""
    camera = dp.Camera.from_opencv([[1560, 0, 959.5], [0, 1560, 539.5], [0, 0, 1]], [0, 0, 0, 0], size=(1920, 1080))
    dp.save_camera(tmp_path / "mast.yaml", camera)
    (tmp_path / "marks.csv").write_text(MAST)
    (tmp_path / "two.csv").write_text("".join(MAST.splitlines(keepends=True)[:3]))
    return "--camera", str(tmp_path / "mast.yaml"), "--landmarks", str(tmp_path / "marks.csv"), "--pixel-sigma", "1"


def test_what_is_known_beforehand_is_what_the_library_makes_of_it(
    mast: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Of the place alone, of the focal length alone, and of both; the file holds it, and measures with it."""
    surveyed, camera = read_landmarks(Path(mast[3])), dp.load_camera(mast[1])
    views = dp.Views(surveyed.pixels.unsqueeze(0), size=(1920, 1080))
    both = ("--prior", "height=12.30±0.02", "--fixed", "roll=0", "--prior", "focal=1550 +- 50")
    found = parsed(capsys, *mast, *both, "-o", str(tmp_path / "out.json"))
    start = dp.Camera.mounted(12.3, 18.0, 0.0, 40.0, focal=1560.0, size=(1920, 1080), position=[100.0, 200.0])
    seen = dp.Seen(surveyed.landmarks, surveyed.pixels, pixel_sigma=1.0)
    priors = {"height": (12.3, 0.02), "focal": (1550.0, 50.0)}
    expected = dp.adjust(start, seen, priors=priors, fixed=("roll",))
    assert found["position"]["x"]["value"] == pytest.approx(float(expected.mounting.position[0]), abs=1e-4)
    assert found["position"]["z"]["deviation"] == pytest.approx(float(expected.mounting_deviations.height), rel=1e-3)
    deviation = float(expected.covariance.deviations["f_x"])
    assert found["intrinsics"]["f_x"] == {
        "value": pytest.approx(float(expected.camera.K[0, 0]), abs=1e-2),
        "deviation": pytest.approx(deviation, rel=1e-3),
    }
    assert abs(found["intrinsics"]["f_x"]["value"] - 1510) < 3 * deviation
    assert found["mounting"]["roll"] == {"value": pytest.approx(0, abs=1e-9), "deviation": 0.0}
    assert found["fixed"] == {"roll": 0.0}
    assert found["priors"]["height"] == {"value": 12.3, "deviation": 0.02}
    assert found["deviations_include"] == ["pixels", "priors"]
    again = dp.load_calibration(tmp_path / "out.json")
    ground = dp.measure([[800.0, 600.0]], again, dp.Plane.z(0.0), view=0, pixel_sigma=1.0)
    wanted = dp.measure([[800.0, 600.0]], expected, dp.Plane.z(0.0), pixel_sigma=1.0)
    torch.testing.assert_close(ground.points, wanted.points, rtol=0, atol=1e-3)
    torch.testing.assert_close(ground.deviations, wanted.deviations, rtol=1e-3, atol=1e-9)

    one = parsed(capsys, *mast, "--prior", "f_x=1550+-50")["intrinsics"]
    held = ("principal_point", "distortion")
    known = {"priors": {"f_x": (1550.0, 50.0)}, "fixed": held, "tied_focal": True, "pixel_sigma": 1.0}
    refined = dp.refine(views, surveyed.landmarks, camera, **known).to_dict()
    assert one["f_x"]["value"] == one["f_y"]["value"] == pytest.approx(refined["f_x"], abs=1e-6)
    assert one["f_x"]["deviation"] == pytest.approx(refined["f_x_deviation"], rel=1e-6)

    place = parsed(capsys, *mast, "--prior", "z=12,3+/-0.02")["position"]["z"]
    located = dp.locate(views, surveyed.landmarks, camera, pixel_sigma=1.0, priors={"height": (12.3, 0.02)})
    assert place["value"] == pytest.approx(float(located.cameras.center[0, 2]), abs=1e-6)


def test_a_roll_is_held_and_weighs_where_the_camera_file_has_no_pose(
    mast: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where nothing is said of the tilt: a camera without a pose looks straight up, where a roll is a heading."""
    for more, held in (((), 3.0), (("--fixed", "heading=39"), 3.0), (("--fixed", "height=12.3"), -2.0)):
        found = parsed(capsys, *mast, "--fixed", f"roll={held}", *more)
        assert found["mounting"]["roll"] == {"value": pytest.approx(held, abs=1e-9), "deviation": 0.0}
        assert found["rms"] > 10  # the truth is 0
    found = parsed(capsys, *mast, "--prior", "roll=3+-0.001")["mounting"]["roll"]
    assert found["value"] == pytest.approx(3.0, abs=0.02)


def test_two_landmarks_and_what_is_known(mast: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    two = (*mast[:3], mast[3].replace("marks.csv", "two.csv"), *mast[4:])
    known = ("height=12.3+-0.02", "tilt=18+-0.5", "x=100+-0.5", "y=200+-0.5", "focal=1510+-5")
    options = [part for one in known for part in ("--prior", one)]
    found = parsed(capsys, *two, *options, "--fixed", "roll=0")
    for axis, value in (("x", 100.0), ("y", 200.0), ("z", 12.3)):
        assert abs(found["position"][axis]["value"] - value) < 4 * found["position"][axis]["deviation"]
    code, _, err = run(capsys, *two, "--prior", "height=12.3+-0.02")
    assert code == 1
    assert re.search(r"two\.csv: roll, heading and position: .*; tell some of them by --fixed or --prior$", err.strip())
    wide = ("--prior", "x=100+-1e7", "--prior", "height=12.3+-0.02")
    code, _, err = run(capsys, *two, *wide)
    assert code == 1
    assert re.search("the prior on position is too wide; tell .* by --fixed or a narrower --prior$", err.strip()), err


def test_priors_that_contradict_the_landmarks_are_told(
    mast: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    for more in ((), ("--prior", "focal=1510+-1")):
        found = parsed(capsys, *mast, "--prior", "height=15+-0.01", *more)
        assert "times what" in found["verdict"]
        assert not found["verdict"].startswith("Good")


CASES: list[tuple[tuple[str, ...], int, str]] = [
    ((*DRONE, *LANDMARKS, "--prior", "tilt=12"), 2, r"--prior: want a standard deviation .*; --fixed tilt=12 holds it"),
    ((*DRONE, *LANDMARKS, "--prior", "tilt=12+-0"), 2, "--prior: want a standard deviation above 0, got 'tilt=12"),
    (
        (*DRONE, *LANDMARKS, "--prior", "12+-1"),
        2,
        r"--prior: want NAME=VALUE\+-DEVIATION, such as height=12\+-0.02, got",
    ),
    ((*DRONE, *LANDMARKS, "--prior", "height=-1+-1"), 2, "--prior: want a height above z = 0, more than 0, got"),
    ((*DRONE, *LANDMARKS, "--prior", "tilt=100+-1"), 2, "--prior: want degrees below the horizon, from -90 to 90, got"),
    ((*DRONE, *LANDMARKS, "--fixed", "k1=0"), 2, "--fixed: want a name from tilt, .*, got 'k1'; of the camera"),
    ((*DRONE, *LANDMARKS, "--fixed", "roll"), 2, "--fixed: want NAME=VALUE, such as roll=0, got 'roll'"),
    ((*DRONE, *LANDMARKS, "--prior", "hight=1+-1"), 1, "--prior: want a name from tilt, roll, .*, got 'hight'"),
    ((*DRONE, *LANDMARKS, "--prior", "height=80+-1"), 1, "--prior: want --pixel-sigma beside it"),
    (
        (*DRONE, *LANDMARKS, "--prior", "z=80+-1", "--fixed", "height=80"),
        1,
        "--fixed: want each name once, got 'height'",
    ),
    (
        (*DRONE, *LANDMARKS, "--prior", "focal=2300+-9", "--prior", "f_x=2300+-9"),
        1,
        "--prior: want either 'focal' or 'f_x' and 'f_y', got both",
    ),
    ((*DRONE,), 2, "the following arguments are required: --landmarks"),
    ((*LANDMARKS,), 2, "the following arguments are required: --camera"),
    ((*DRONE, *LANDMARKS, "--free", "focal;k1"), 2, "--free: want names with commas between, such as focal"),
    ((*DRONE, *LANDMARKS, "--free", "k7"), 1, "^diffproj: --free: want names from focal, .*, got 'k7'"),
    (
        (*DRONE, *LANDMARKS, "--free", "focal,principal_point,distortion"),
        1,
        "beach.csv: the views do not determine f_x, .*: more landmarks, near and far; or less in --free$",
    ),
    ((*DRONE, *LANDMARKS, "--pixel-sigma", "0"), 2, "--pixel-sigma: want a positive number of pixels"),
    ((*DRONE, *LANDMARKS, "--unit", "px"), 2, "--unit: invalid choice: 'px'"),
    ((*DRONE, *LANDMARKS, "-o", "camera.yaml"), 2, "--output: want a file ending in .json, which holds the pose too"),
    ((*DRONE, *LANDMARKS, "-o", "gone/camera.json"), 1, "--output: no such folder: gone; make it"),
    ((*DRONE, *LANDMARKS, "-o", "folder.json"), 1, "--output: want a file, got a folder"),
    ((*DRONE, *LANDMARKS, "--draw", "a.gif"), 2, r"--draw: want a file ending in \.png"),
    (("beach.jpg", *DRONE, *LANDMARKS, "--draw", "beach.jpg"), 2, r"--draw: want a file ending in \.png"),
    (("small.png", *DRONE, *LANDMARKS, "--draw", "small.png"), 1, "--draw: want another file than those that are read"),
    (
        ("small.png", *DRONE, *LANDMARKS),
        1,
        "PHOTO: want 3840 x 2160 px as in drone.yaml, got 384 x 216 px in small.png",
    ),
    (("gone.png", *DRONE, *LANDMARKS), 1, "no such file: gone.png"),
    (("folder.json", *DRONE, *LANDMARKS), 1, "PHOTO: want one photograph, got the folder"),
    (("--camera", "gone.yaml", *LANDMARKS), 1, "gone.yaml: No such file or directory; check its name"),
    (("--camera", "two.json", *LANDMARKS), 1, "--camera: want one camera, got 2 side by side in two.json"),
    (("--camera", "sizeless.json", *LANDMARKS, "--draw", "a.png"), 1, "--draw: want PHOTO, or the image's size in"),
    *(
        ((*DRONE, "--landmarks", name), 1, f"^diffproj: {message}")
        for name, message in (
            ("gone.csv", "gone.csv: No such file or directory; check its name"),
            ("folder.json", "folder.json: Is a directory; want a file"),
            ("noise.csv", "--landmarks: want a text file in UTF-8, got something else in noise.csv"),
            ("empty.csv", "--landmarks: want lines with columns name, u, v, x, y, z, found none in empty.csv"),
            ("titles.csv", "--landmarks: want lines with columns name, u, v, x, y, z, found none in titles.csv"),
            ("word.csv", "--landmarks: want a number in column 'y', got 'far' in line 3 of word.csv"),
            ("inf.csv", "--landmarks: want a number in column 'y', got 'inf' in line 3 of inf.csv"),
            ("gap.csv", "--landmarks: want a number in column 'y', got nothing in line 3 of gap.csv"),
            ("half.csv", "--landmarks: want u and v, or neither .* nothing in column 'u' in line 3 of half.csv"),
            ("short.csv", "--landmarks: want a number in column 'z', got nothing in line 3 of short.csv"),
            ("long.csv", "--landmarks: want 6 cells, got 7 in line 3 of long.csv"),
            ("twice.csv", "--landmarks: want each name once, got 'mast' again in line 3 of twice.csv"),
            ("no_v.csv", "--landmarks: want columns .* got no 'v' in no_v.csv: it has 'name', 'u', 'w', 'x', 'y', 'z'"),
            ("two_x.csv", "--landmarks: want one column 'x', got 2 in two_x.csv"),
            ("six.csv", "--landmarks: want columns .* got 2 columns without titles in six.csv"),
            (
                "minus.csv",
                "--landmarks: want a standard deviation in column 'sigma_z', got '-1' in line 3 of minus.csv",
            ),
            ("both.csv", "--landmarks: want either a column 'sigma' or sigma_x, .*, got both in both.csv"),
            ("rough.csv", "--landmarks: want a standard deviation in column 'pixel_sigma' .* none for 'post'"),
            ("thousands.csv", "--landmarks: want decimal commas in all numbers and no mark .*, got '192.111' beside"),
            ("few.csv", "--landmarks: want at least 4 with a pixel, got 3 in few.csv"),
            ("line.csv", "line.csv: want points that do not lie on one line"),
            ("alike.csv", "alike.csv: want points that are all distinct, got 6 with 'mast' and 'again' alike"),
            (
                "mixed.csv",
                "mixed.csv: the corners of mixed do not match the landmarks: .* --reject-outliers with --pixel-sigma finds few",
            ),
            ("outside.csv", r"outside.csv: want corners inside the photographs of 3840 x 2160 px, got \(9707"),
            ("degrees.csv", "--landmarks: degrees.csv: points: .* latitude and longitude"),
        )
    ),
]


@pytest.mark.parametrize(("arguments", "code", "message"), CASES, ids=[" ".join(case[0])[:80] for case in CASES])
def test_bad_input_is_one_line(
    arguments: tuple[str, ...], code: int, message: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.rglob("*"))
    found, out, err = run(capsys, *arguments)
    *others, line = err.splitlines()
    assert found == code, err
    assert out == ""
    assert re.search(message, line), line
    assert "unexpected" not in line
    assert others[0].startswith("usage: diffproj locate [PHOTO]") if code == 2 else not others
    assert sorted(folder.rglob("*")) == before


def test_help_fits_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "--help")
    assert code == 0
    assert "--landmarks" in out
    assert all(len(line) <= 80 for line in out.splitlines())


THREE = [[624.0, 554.0], [770.0, 847.0], [508.0, 440.0]]


@pytest.mark.parametrize("free", [(), ("--prior", "focal=1200+-2")])
def test_another_pose_of_three_landmarks_is_told(
    free: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What `adjust` doubts, the verdict, the warnings, the file and what is measured with it do too."""
    camera = dp.Camera.mounted(6.0, 20.0, 2.0, 30.0, focal=1200.0, size=(1280, 960))
    seen = torch.tensor(THREE, dtype=torch.float64)
    points, _ = dp.back_project(seen, camera, dp.Plane.z(0.0))
    seen = seen + torch.randn(seen.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rows = [",".join(map(str, (*p, *x))) for p, x in zip(seen.tolist(), points.tolist(), strict=True)]
    (tmp_path / "three.csv").write_text("\n".join(["u,v,x,y,z", *rows]))
    dp.save_camera(tmp_path / "mast.json", camera.without_pose())
    files = ("--camera", str(tmp_path / "mast.json"), "--landmarks", str(tmp_path / "three.csv"), "--pixel-sigma", "1")
    known = ("--prior", "height=6+-20", *free)
    code, out, err = run(capsys, *files, *known, "-o", tmp_path / "out.json", "--json")
    found = json.loads(out)
    assert code == 0
    said = "another pose explains the evidence nearly as well"
    assert said in found["verdict"]
    assert said in err
    assert any(said in text for text in found["warnings"])
    again = dp.load_calibration(tmp_path / "out.json")
    assert said in again.verdict
    if not free:
        assert bool(again.ambiguous)
        assert said in dp.measure([[600.0, 600.0]], again, dp.Plane.z(0.0), 0, 1.0).doubts
        adjusted = dp.adjust(camera, dp.Seen(points, seen), priors={"height": (6.0, 20.0)})
        spread = adjusted.mounting_deviations
        told = [found["position"][axis]["deviation"] for axis in "xyz"]
        assert told == pytest.approx([*spread.position.tolist(), float(spread.height)], rel=1e-3)


def in_degrees() -> str:
    """The beach's landmarks by latitude and longitude, as a GPS has them; their map is that of North Carolina."""
    rows = [line.split(",") for line in BEACH.splitlines()[1:]]
    places = dp.degrees_from_metres([[float(row[3]), float(row[4])] for row in rows], "EPSG:32119").tolist()
    lines = [f"{n},{u},{v},{lat!r},{lon!r},{z}" for (n, u, v, _, _, z), (lat, lon) in zip(rows, places, strict=True)]
    return "\n".join(["name,u,v,Latitude,lon,z", *lines]) + "\n"


def test_landmarks_in_degrees(capsys: pytest.CaptureFixture[str]) -> None:
    Path("degrees.csv").write_text(in_degrees())
    wanted = parsed(capsys, *DRONE, *LANDMARKS, "--json")
    found = parsed(capsys, *DRONE, "--landmarks", "degrees.csv", "--crs", "EPSG:32119", "--json")
    assert (wanted["crs"], found["crs"], found["unit"]) == (None, "EPSG:32119", "m")
    for axis in "xyz":
        assert found["position"][axis]["value"] == pytest.approx(wanted["position"][axis]["value"], abs=1e-5)
        assert found["position"][axis]["deviation"] == pytest.approx(wanted["position"][axis]["deviation"], rel=1e-5)
    of_zone = parsed(capsys, *DRONE, "--landmarks", "degrees.csv", "--json")
    assert of_zone["crs"] == "EPSG:32618"
    place = [of_zone["position"][axis]["value"] for axis in "xy"]
    there, here = (
        dp.degrees_from_metres([[one["position"][axis]["value"] for axis in "xy"]], one["crs"])
        for one in (of_zone, found)
    )
    assert 1e5 < place[0] < 9e5
    torch.testing.assert_close(there, here, rtol=0, atol=1e-6)  # a tenth of a metre: the two maps' scales differ
    code, out, _ = run(capsys, *DRONE, "--landmarks", "degrees.csv")
    assert code == 0
    assert "x and y are metres east and north on the map EPSG:32618" in " ".join(out.split())


@pytest.mark.parametrize(
    ("text", "more", "message"),
    [
        (BEACH, ("--crs", "EPSG:32618"), "--crs: want columns lat and lon, which it makes metres of, got x and y in"),
        ("n", ("--crs", "EPSG:4326"), "--crs: .*want a map in metres"),
        ("n", ("--unit", "ft"), "--unit: want m where landmarks have latitudes and longitudes, got ft"),
        ("name,u,v,lat,z\na,1,2,3,4\n", (), "in place of x and y, got no 'longitude'"),
        ("name,u,v,lat,lon,z\na,1,2,95,4,1\nb,1,2,95,4,1\n", (), "--landmarks: .*want latitudes from -90 to 90"),
        ("name,u,v,lat,lon,z\na,1,2,45,,1\n", (), "want a number in column 'longitude', got nothing in line 2"),
    ],
)
def test_degrees_that_are_none(
    capsys: pytest.CaptureFixture[str], text: str, more: tuple[str, ...], message: str
) -> None:
    Path("degrees.csv").write_text(in_degrees() if text == "n" else text)
    code, _, err = run(capsys, *DRONE, "--landmarks", "degrees.csv", *more)
    assert code == 1
    assert re.search(message, " ".join(err.split())), err


def test_metres_come_before_degrees(tmp_path: Path) -> None:
    path = tmp_path / "both.csv"
    path.write_text("name,u,v,x,y,lat,lon\na,1,2,3,4,45.1,7.1\nb,3,4,5,6,45.2,7.2\n")
    found = read_landmarks(path)
    assert found.crs is None
    assert found.landmarks.points.tolist() == [[3, 4, 0], [5, 6, 0]]


def test_degrees_need_pyproj(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    Path("degrees.csv").write_text(in_degrees())
    monkeypatch.setitem(sys.modules, "pyproj", None)
    code, _, err = run(capsys, *DRONE, "--landmarks", "degrees.csv")
    assert code == 1
    assert "pyproj: want it installed, to turn degrees into metres; pip install pyproj" in " ".join(err.split())
