"""Rigs in files: all of it in the own JSON, the cameras at their places in OpenCV's, Kalibr's and COLMAP's."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import kornia
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.cli import main

BOARD = dp.Chessboard()


@pytest.fixture(scope="module")
def rig() -> dp.RigCalibration:
    pair = {"left": dp.example_views("left")[:7], "right": dp.example_views("right")[2:9]}
    return dp.calibrate_rig(pair, BOARD, "brown4")


def test_the_own_json_holds_all(rig: dp.RigCalibration, tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    dp.save_camera(path, rig)
    again = dp.load(path)
    assert isinstance(again, dp.RigCalibration)
    assert again.summary() == rig.summary()
    assert again.to_dict() == rig.to_dict()
    assert torch.equal(again.covariance.full(), rig.covariance.full())
    for name in rig.names:
        assert torch.equal(again[name].covariance.full(), rig[name].covariance.full())
        assert torch.equal(again.where[name], rig.where[name])
        assert dp.load_camera(path, camera=name).K.equal(rig.cameras[name].K)
    pixels = {name: one.views.pixels[2 if name == "left" else 0] for name, one in rig.calibrations.items()}
    assert torch.equal(again.triangulate(pixels).covariance, rig.triangulate(pixels).covariance)
    with pytest.raises(ValueError, match="a rig; load reads it"):
        dp.load_calibration(path)


def _without_a_view(covariance: dict) -> dict:
    """What a covariance says of all views but the last."""
    return {name: covariance[name][:-1] for name in ("follow", "mixed", "alone", "arm", "undetermined_views")}


def test_a_rig_may_come_without_a_covariance(rig: dp.RigCalibration) -> None:
    again = dp.RigCalibration.from_fields(rig.to_fields() | {"covariance": None}, rig.cameras)
    assert not again.has_covariance
    assert torch.equal(again.t_target, rig.t_target)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rig: rig.pop("moments"), "moments"),
        (lambda rig: rig["moments"].pop(), "where|moments|left|right|target"),
        (lambda rig: rig.update(status=17), "status"),
        (lambda rig: rig["where"].pop("left"), "calibrations"),
        (lambda rig: rig["calibrations"]["left"].update(rms=3.0), "rms"),
        (lambda rig: rig.update(remarks=[3]), "remarks"),
        (lambda rig: rig["R_target"].pop(), "R_target"),
        (lambda rig: rig["covariance"].update(_without_a_view(rig["covariance"])), "covariance: want 9 moments"),
    ],
)
def test_damage_is_named(rig: dp.RigCalibration, tmp_path: Path, spoil, message: str) -> None:  # type: ignore
    path = tmp_path / "rig.json"
    dp.save_camera(path, rig)
    document = json.loads(path.read_text())
    spoil(document["rig"])
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match=message):
        dp.load(path)


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".yml"])
def test_opencv_reads_a_pair(rig: dp.RigCalibration, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"stereo{suffix}"
    dp.save_camera(path, rig)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    right = rig.cameras["right"]
    assert np.array_equal(storage.getNode("M1").mat(), rig.cameras["left"].K.numpy())
    assert np.array_equal(storage.getNode("R").mat(), right.R.numpy())
    assert np.array_equal(storage.getNode("T").mat().ravel(), right.t.numpy())
    storage.release()
    again = dp.load_camera(path)
    for i, camera in enumerate(rig.cameras.values()):
        assert torch.allclose(again.R[i], camera.R, atol=1e-12)
        assert torch.allclose(again.t[i], camera.t, atol=1e-12)
        assert torch.equal(again.distortion.coefficients[i, :4], camera.distortion.coefficients)  # type: ignore[union-attr]


def test_kalibr_reads_a_chain(rig: dp.RigCalibration, tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    dp.save_camera(path, rig, format="kalibr")
    assert "T_cn_cnm1" in path.read_text()
    for i, camera in enumerate(rig.cameras.values()):
        again = dp.load_camera(path, camera=f"cam{i}")
        assert torch.allclose(again.R, camera.R, atol=1e-12)
        assert torch.allclose(again.t, camera.t, atol=1e-9)
        assert again.K.equal(camera.K)


PYCOLMAP = """
import json, sys, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
(rig,) = model.rigs.values()
def numbers(pose):
    x, y, z, w = pose.rotation.quat.tolist()
    return [w, x, y, z, *pose.translation.tolist()]
out = {"reference": rig.ref_sensor_id.id, "places": {s.id: numbers(p) for s, p in rig.non_ref_sensors.items()}}
out["frames"] = {i: numbers(frame.rig_from_world) for i, frame in model.frames.items()}
out["images"] = []
for image in model.images.values():
    pose = image.cam_from_world()
    camera = model.cameras[image.camera_id]
    X = json.load(open(sys.argv[1] + "/points.json"))
    pixels = [camera.img_from_cam(pose * x).tolist() for x in X]
    out["images"].append([image.name, image.camera_id, image.frame_id, numbers(pose), pixels])
json.dump(out, open(sys.argv[1] + "/found.json", "w"))
model.write_text(sys.argv[2])
model.write_binary(sys.argv[2])
"""


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_colmap_reads_a_rig_and_writes_it(rig: dp.RigCalibration, tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("pycolmap")
    model, theirs = tmp_path / "model", tmp_path / "theirs"
    model.mkdir()
    theirs.mkdir()
    dp.save_camera(model / f"rigs{suffix}", rig)
    assert len(list(model.iterdir())) == 5
    (model / "points.json").write_text(json.dumps(rig.points.tolist()))
    subprocess.run([sys.executable, "-c", PYCOLMAP, str(model), str(theirs)], check=True, capture_output=True)
    found = json.loads((model / "found.json").read_text())
    assert found["reference"] == 1
    assert len(found["frames"]) == len(rig.moments) == 9
    right = rig.cameras["right"]
    assert found["places"]["2"][4:] == pytest.approx(right.t.tolist(), abs=1e-12)
    R = kornia.geometry.quaternion_to_rotation_matrix(torch.tensor(found["places"]["2"][:4], dtype=torch.float64))
    assert torch.allclose(R, right.R, atol=1e-12)
    for name, camera_id, frame, pose, pixels in found["images"]:
        camera, _, view = name.partition("/")
        own = rig[camera]
        row = own.views.names.index(view)
        assert camera_id == 1 + rig.names.index(camera)
        assert int(rig.where[camera][row]) == frame - 1
        assert pose[4:] == pytest.approx(own.cameras.t[row].tolist(), abs=1e-9)
        projected = torch.tensor(pixels, dtype=torch.float64) - 0.5
        assert (projected - own.cameras[row].project(own.points)[0]).abs().max() < 1e-8
    # Its places and its poses are those of the target, and come back from what each of the two wrote.
    for folder in (model, theirs):
        for kind in (".txt", ".bin") if folder == theirs else (suffix,):
            for name, camera in rig.cameras.items():
                again = dp.load_camera(folder / f"rigs{kind}", camera=name)
                assert torch.allclose(again.R, camera.R, atol=1e-12)
                assert torch.allclose(again.t, camera.t, atol=1e-9)
                assert torch.allclose(again.K, camera.K, atol=1e-9)
                assert again.size == camera.size
            assert dp.load_camera(folder / f"rigs{kind}").batch_shape == (2,)
            assert dp.load_camera(folder / f"images{kind}", camera="left/left01.jpg").t.equal(
                dp.load_camera(folder / f"images{kind}", camera=0).t
            )


def test_colmap_models_are_not_mixed_up(rig: dp.RigCalibration, tmp_path: Path) -> None:
    dp.save_camera(tmp_path / "rigs.txt", rig)
    dp.save_camera(tmp_path / "rigs.txt", rig)  # its own it writes over
    with pytest.raises(ValueError, match=r"want a folder without the rigs.txt of another model"):
        dp.save_camera(tmp_path / "images.txt", rig["left"].cameras)
    (tmp_path / "frames.txt").write_text("1 1 1 0 0 0 0 0 0 0\n")
    with pytest.raises(ValueError, match=r"want a folder without the frames.txt of another model"):
        dp.save_camera(tmp_path / "rigs.txt", rig)
    with pytest.raises(ValueError, match=r"want rigs.txt or rigs.bin for a rig, as COLMAP calls them, got pair.txt"):
        dp.save_camera(tmp_path / "pair.txt", rig)


CAMERAS = "1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE 640 480 500 500 320 240\n"
PLACE = "1 1 0 0 0 -80 0 0"


@pytest.mark.parametrize(
    ("rigs", "message"),
    [
        (f"1 2 CAMERA 1 CAMERA 2 {PLACE}", ""),
        (f"1 3 IMU 1 CAMERA 1 1 1 0 0 0 0 0 0 CAMERA 2 {PLACE}", ""),
        (f"7 1 CAMERA 3\n1 2 CAMERA 1 CAMERA 2 {PLACE}", ""),
        ("1 2 CAMERA 1 CAMERA 2 0", "rig 1: want the place of camera 2, got none"),
        ("1 1 CAMERA 1\n2 1 CAMERA 2", "want one rig of several cameras, got 0; cameras.txt has them without a pose"),
        (f"1 2 CAMERA 1 CAMERA 2 {PLACE}\n" * 2, "want one rig of several cameras, got 2; keep one of them"),
        (f"1 2 CAMERA 1 CAMERA 9 {PLACE}", "rig 1: want a camera of cameras.txt, got the id 9"),
        (f"1 2 CAMERA 1 CAMERA 1 {PLACE}", "rig 1: want each camera once, got 1 twice"),
        (f"1 3 CAMERA 1 CAMERA 2 {PLACE}", "want RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID SENSORS"),
        ("1 2 CAMERA 1 CAMERA 2 1 1 0 0", "want RIG_ID NUM_SENSORS"),
        ("1 2 CAMERA 1 LIDAR 2 0", "want RIG_ID NUM_SENSORS"),
        ("1 2 CAMERA 1 CAMERA 2 1 1 0 0 0 x 0 0", "want numbers, got 'x'"),
        ("1 2 CAMERA 1 CAMERA 2 1 2 0 0 0 0 0 0", "camera 2: want a quaternion of length 1, got 2"),
    ],
)
def test_rigs_of_colmap_are_read_right_or_refused(tmp_path: Path, rigs: str, message: str) -> None:
    (tmp_path / "cameras.txt").write_text(CAMERAS)
    (tmp_path / "rigs.txt").write_text(f"{rigs}\n")
    if message:
        with pytest.raises(ValueError, match=message):
            dp.load_camera(tmp_path / "rigs.txt")
        return
    found = dp.load_camera(tmp_path / "rigs.txt")
    assert found.t.tolist() == [[0, 0, 0], [-80, 0, 0]]
    assert dp.load_camera(tmp_path / "rigs.txt", camera="2").t.tolist() == [-80, 0, 0]


def test_damaged_rigs_of_colmap_are_refused(rig: dp.RigCalibration, tmp_path: Path) -> None:
    dp.save_camera(tmp_path / "rigs.bin", rig)
    whole = (tmp_path / "rigs.bin").read_bytes()
    for spoilt in (whole[:-1], whole + b"\0", whole[:8], b"\xff" * 40):
        (tmp_path / "rigs.bin").write_bytes(spoilt)
        with pytest.raises(ValueError, match=r"rigs.bin: want"):
            dp.load_camera(tmp_path / "rigs.bin")
    (tmp_path / "rigs.bin").write_bytes(whole)
    (tmp_path / "cameras.bin").unlink()
    with pytest.raises(ValueError, match=r"want cameras.bin beside it"):
        dp.load_camera(tmp_path / "rigs.bin")
    with pytest.raises(
        ValueError, match=r"frames.bin: want cameras, got where a rig stood; images.bin has their poses"
    ):
        dp.load_camera(tmp_path / "frames.bin")


def test_what_a_format_cannot_hold_is_refused(rig: dp.RigCalibration, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="format: want 'json' or 'opencv' or 'kalibr' or 'colmap' for a rig"):
        dp.save_camera(tmp_path / "rig.npz", rig)
    three = {name: dp.example_views("left")[:7] for name in ("a", "b", "c")}
    many = dp.calibrate_rig(three, BOARD, throw=False)
    with pytest.raises(ValueError, match="holds two cameras, got 3"):
        dp.save_camera(tmp_path / "rig.yaml", many)
    with pytest.raises(ValueError, match="radtan"):
        dp.save_camera(tmp_path / "rig.yaml", many, format="kalibr")


def test_the_command_line_converts_rigs(rig: dp.RigCalibration, tmp_path: Path) -> None:
    dp.save_camera(tmp_path / "rig.json", rig)
    assert main(["convert", str(tmp_path / "rig.json"), str(tmp_path / "pair.yaml")]) == 0
    assert dp.load_camera(tmp_path / "pair.yaml", camera=1).t.equal(rig.cameras["right"].t)
    assert main(["convert", str(tmp_path / "rig.json"), str(tmp_path / "one.json"), "--camera", "right"]) == 0
    assert isinstance(dp.load(tmp_path / "one.json"), dp.Camera)
