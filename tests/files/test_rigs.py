"""Rigs in files: all of it in the own JSON, the cameras at their places in OpenCV's and Kalibr's."""

import json
from pathlib import Path

import cv2
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


def test_what_a_format_cannot_hold_is_refused(rig: dp.RigCalibration, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="format: want 'json' or 'opencv' or 'kalibr' for a rig"):
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
