"""`diffproj convert` and `diffproj info`."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import diffproj as dp
from diffproj.cli import main
from tests.files.samples import KALIBR, OPENCV_YAML, ROS, SAMPLES, K, npz


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, data in SAMPLES.items():
        (tmp_path / name).write_bytes(data)
    return tmp_path


def test_a_camera_goes_from_one_program_to_another(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for out, options in {
        "a.json": [],
        "a.yaml": [],
        "a.npz": [],
        "new/images.txt": [],
        "ost2.yaml": ["--to", "ros"],
        "chain.yaml": ["--to", "kalibr"],
        "t.json": ["--to", "nerfstudio"],
    }.items():
        lens = "cameras.txt" if out != "ost2.yaml" else "opencv.yml"
        (folder / "new").mkdir(exist_ok=True)
        one = ["--camera", "1"] if lens == "cameras.txt" else []
        assert main(["convert", str(folder / lens), str(folder / out), *one, *options]) == 0
        found = dp.load_camera(folder / out)
        want = dp.load_camera(folder / lens, camera="1" if one else None)
        assert torch.allclose(found.K, want.K, atol=1e-12, rtol=0)
        assert found.size == want.size
    assert f"{folder}/a.json: one camera of 640 x 480 px, BrownConrady" in capsys.readouterr().out


def test_convert_names_lenses_as_the_other_documents_do(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for source, lens in (("opencv.yml", "brown5"), ("camera.json", "none")):
        if source == "camera.json":
            dp.save_camera(folder / source, dp.Camera(dp.load_camera(folder / "opencv.yml").K, size=(640, 480)))
        told = []
        for command in (["convert", str(folder / source), str(folder / "b.json")], ["info", str(folder / source)]):
            assert main([*command, "--json"]) == 0
            told.append(json.loads(capsys.readouterr().out))
        assert told[0]["lens"] == next(iter(told[1]["cameras"].values()))["lens"] == lens
        assert (told[0]["rig"], told[0]["cameras"]) == (None, None)


def test_what_a_format_has_no_place_for_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = str(folder / "whole.json")
    dp.save_camera(source, dp.calibrate(dp.example_views("left")[:4], dp.Chessboard()))
    for options in (["e.yml"], ["e.txt"], ["e.npz"], ["e.json", "--without-pose"]):
        out, *more = options
        assert main(["convert", source, str(folder / out), *more]) == 0
        assert (
            f"{folder / out} holds the camera alone: error bars, views and unit of {source}" in capsys.readouterr().err
        )
    for inside, out in ((source, "f.json"), (str(folder / "e.yml"), "g.json"), (str(folder / "e.yml"), "g.xml")):
        assert main(["convert", inside, str(folder / out)]) == 0
        assert capsys.readouterr().err == ""


def test_a_camera_is_converted_where_it_stood(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without --view formats that hold a pose get none, and the note says which option takes it along."""
    source = folder / "stood.json"
    calibration = dp.calibrate(dp.example_views("left")[:4], dp.Chessboard())
    dp.save_camera(source, calibration)
    name, point = calibration.views.names[2], torch.tensor([[25.0, 50, 0]], dtype=torch.float64)
    want = calibration.cameras[2].project(point)[0]
    (folder / "stood").mkdir()
    for out, options in {"images.txt": [], "a.json": [], "a.npz": [], "t.json": ["--to", "nerfstudio"]}.items():
        command = ["convert", str(source), str(folder / "stood" / out), *options]
        assert main([*command, "--view", name, "--camera", "0"]) == 0
        told = capsys.readouterr().err
        assert f"{out} holds the camera at {name} alone: error bars, views and unit" in told
        assert (f"{out} calls the image 000000.png: put the name" in told) is (out in ("images.txt", "t.json"))
        found = dp.load_camera(folder / "stood" / out)
        assert torch.allclose(found.project(point)[0], want, atol=1e-6, rtol=0)
    assert main(["convert", str(source), str(folder / "stood" / "images.txt")]) == 0
    assert "--view NAME takes the camera where it stood, into a format that holds a pose" in capsys.readouterr().err
    assert torch.equal(dp.load_camera(folder / "stood" / "images.txt").t, torch.zeros(3, dtype=torch.float64))


@pytest.mark.parametrize(
    ("given", "out", "view", "code", "told"),
    [
        (
            "stood.json",
            "new.npz",
            "right01.jpg",
            1,
            "--view: want a view of .*, got 'right01.jpg'; it has left01.jpg, ",
        ),
        ("opencv.yml", "new.npz", "left01.jpg", 1, "--view: want a .json with a whole calibration of one camera, got"),
        ("stood.json", "new.yaml", "left01.jpg", 1, "OpenCV's formats hold no pose; use .json, or leave out --view"),
    ],
)
def test_a_view_that_cannot_be_converted(
    folder: Path, capsys: pytest.CaptureFixture[str], given: str, out: str, view: str, code: int, told: str
) -> None:
    dp.save_camera(folder / "stood.json", dp.calibrate(dp.example_views("left")[:4], dp.Chessboard()))
    assert main(["convert", str(folder / given), str(folder / out), "--view", view]) == code
    assert re.search(told, capsys.readouterr().err)
    assert not (folder / out).exists()


def test_one_of_several_unlike_cameras_is_converted(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = KALIBR.split("cam1:")
    (folder / "unlike.yaml").write_text(one + "cam1:" + other.replace("radtan", "equidistant"))
    lenses = [dp.load_camera(folder / "unlike.yaml", camera=name).distortion for name in ("cam0", "cam1")]
    assert type(lenses[0]) is not type(lenses[1])
    out = str(folder / "out.json")
    assert main(["convert", str(folder / "unlike.yaml"), out, "--camera", "cam0"]) == 0
    assert type(dp.load_camera(out).distortion) is type(lenses[0])
    assert capsys.readouterr().err == ""


def test_a_whole_calibration_stays_whole(folder: Path) -> None:
    calibration = dp.calibrate(dp.example_views("left")[:4], dp.Chessboard())
    dp.save_camera(folder / "c.json", calibration)
    assert main(["convert", str(folder / "c.json"), str(folder / "d.json")]) == 0
    assert dp.load_calibration(folder / "d.json").summary() == calibration.summary()
    assert main(["convert", str(folder / "c.json"), str(folder / "c.yml")]) == 0
    assert "avg_reprojection_error" in (folder / "c.yml").read_text()


def test_what_does_not_fit_is_told_in_options(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chain, out = str(folder / "camchain.yaml"), str(folder / "out.yaml")
    for options, said in (
        ([], "write .json, or choose one by --camera"),
        (["--camera", "cam1"], "or give --without-pose"),
        (["--camera", "cam7"], "--camera: want one of cam0, cam1, got 'cam7'"),
        (["--camera", "1", "--without-pose", "--size", "640x480"], "--size: want 752x480"),
    ):
        assert main(["convert", chain, out, *options]) == 1
        line = capsys.readouterr().err
        assert said in line
        assert line.count("\n") == 1
        assert not Path(out).exists()
    assert main(["convert", chain, out, "--camera", "1", "--without-pose"]) == 0
    assert dp.load_camera(out).size == (752, 480)
    assert main(["convert", str(folder / "calibration.npz"), out, "--to", "ros"]) == 1
    assert "give --size WxH" in capsys.readouterr().err
    assert main(["convert", str(folder / "calibration.npz"), out, "--to", "ros", "--size", "640x480"]) == 0
    with pytest.raises(SystemExit, match="2"):
        main(["convert", chain, out, "--size", "640"])
    assert main(["convert", str(folder / "nowhere.yaml"), out]) == 1
    assert "nowhere.yaml: No such file" in capsys.readouterr().err


def test_info_tells_what_is_in_a_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(folder / "ost.yaml")]) == 0
    out, err = capsys.readouterr()
    for part in ("ost.yaml: ros", "640 x 480 px", "brown5: k1 0.031195", "degrees", "reaches all corners", "rectified"):
        assert part in out
    assert err == ""
    assert main(["info", str(folder / "camchain.yaml"), "--camera", "cam1"]) == 0
    out, _ = capsys.readouterr()
    assert "in the world" in out
    assert "cam0" not in out
    for name in SAMPLES:
        assert main(["info", str(folder / name)]) == 0
        assert name in capsys.readouterr().out


def test_info_doubts_what_looks_wrong(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for text, said in (
        (
            KALIBR.replace("367.215, 248.375", "367.215, 448.375"),
            "the principal point (367.2, 448.4) is far from the middle of 752 x 480 px",
        ),
        (
            OPENCV_YAML.replace("6.8415526980092864e+02, 0., 6.41", "3.8415526980092864e+02, 0., 6.41"),
            "was the image stretched?",
        ),
        (OPENCV_YAML.replace("-3.1574774054416294e-01", "-1.6"), "the lens folds at"),
        (
            ROS.replace("470.198924", "70000.0").replace("475.088069", "70000.0"),
            "field of view of 0.5 degrees is unusual",
        ),
    ):
        (folder / "doubtful.yaml").write_text(text)
        assert main(["info", str(folder / "doubtful.yaml")]) == 0
        assert said in capsys.readouterr().err


def test_info_refuses_height_and_width(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "doubtful.yaml").write_text(KALIBR.replace("[752, 480]", "[480, 752]"))
    assert main(["info", str(folder / "doubtful.yaml")]) == 1
    said = capsys.readouterr().err
    assert "(480, 752), which looks like height and width" in said
    assert "exchange them in the file" in said


def test_info_of_a_calibration_and_of_damage(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = replace(dp.calibrate(dp.example_views("left")[:4], dp.Chessboard()), unit="mm")
    dp.save_camera(folder / "c.json", found)
    assert main(["info", str(folder / "c.json")]) == 0
    out = capsys.readouterr().out
    assert "a calibration of 4 views, RMS" in out
    assert "px; lengths in mm\nWeak: only 4 views differ" in out
    assert main(["info", str(folder / "c.json"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["calibration"]
    assert told["verdict"].startswith("Weak: only 4 views differ")
    assert told["unit"] == "mm"
    both = torch.stack([dp.example_views(side).pixels[:5] for side in ("left", "right")])
    dp.save_camera(folder / "c.json", dp.calibrate(dp.Views(both, size=(640, 480)), dp.Chessboard()))
    assert main(["info", str(folder / "c.json"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["calibration"]["verdict"] is None
    (folder / "d.npz").write_bytes(npz(mtx=K, dist=K))
    assert main(["info", str(folder / "d.npz")]) == 1
    assert "d.npz: dist: want one row or column of coefficients, got 3 x 3" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["convert", "info"])
def test_help_fits_a_terminal(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([command, "--help"])
    assert all(len(line) <= 80 for line in capsys.readouterr().out.splitlines())


def test_info_doubts_frames_of_one_camera_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = [{"file_path": f"{i}.png", "transform_matrix": torch.eye(4).tolist()} for i in range(5)]
    tree = {"fl_x": 500.0, "fl_y": 600.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480, "frames": frames}
    (folder / "frames.json").write_text(json.dumps(tree))
    assert main(["info", str(folder / "frames.json")]) == 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "0.png and 4 more: the focal lengths 500 and 600 px differ" in said
