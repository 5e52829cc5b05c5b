"""Camera files: round trips, OpenCV reading and being read, what is refused, and that nothing is half written."""

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj._core import atomic
from diffproj.files.load import load

D = torch.float64


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(dp.example_views("left"), dp.Chessboard())


def assert_same(found: dp.Camera, want: dp.Camera) -> None:
    for name in ("K", "R", "t"):
        assert torch.equal(getattr(found, name), getattr(want, name))
    assert found.size == want.size
    assert type(found.distortion) is type(want.distortion)
    if want.distortion is not None:
        assert torch.equal(found.distortion.coefficients, want.distortion.coefficients)


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("kind", [None, "BrownConrady", "KannalaBrandt"])
def test_json_holds_any_camera_exactly(tmp_path: Path, camera: dp.Camera, dtype: torch.dtype, kind: str | None) -> None:
    lens = None if kind is None else getattr(dp, kind)(torch.randn(4, dtype=D) * 0.01)
    t = torch.randn(2, 3, 3, dtype=D)
    want = dp.Camera(camera.K, camera.R, t, lens, (640, 480)).to(dtype)
    dp.save_camera(tmp_path / "camera.json", want)
    found = dp.load_camera(tmp_path / "camera.json")
    assert found.dtype == dtype
    assert_same(found, want)


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml"])
@pytest.mark.parametrize("kind", [None, "BrownConrady", "KannalaBrandt"])
def test_opencv_formats_round_trip(tmp_path: Path, camera: dp.Camera, suffix: str, kind: str | None) -> None:
    lens = None if kind is None else getattr(dp, kind)(torch.randn(4, dtype=D) * 0.01)
    want = dp.Camera(camera.K, distortion=lens, size=(640, 480))
    dp.save_camera(tmp_path / f"camera{suffix}", want)
    assert_same(dp.load_camera(tmp_path / f"camera{suffix}"), want)


def test_whole_calibration_comes_back(tmp_path: Path, calibration: dp.Calibration) -> None:
    dp.save_camera(tmp_path / "c.json", calibration)
    found = dp.load_calibration(tmp_path / "c.json")
    assert_same(found.camera, calibration.camera)
    assert_same(found.cameras, calibration.cameras)
    assert torch.equal(found.residuals, calibration.residuals)
    assert found.views.names == calibration.views.names
    assert found.summary() == calibration.summary()
    assert_same(dp.load_camera(tmp_path / "c.json"), calibration.camera)


def test_load_gives_what_the_file_holds(tmp_path: Path, camera: dp.Camera, calibration: dp.Calibration) -> None:
    dp.save_camera(tmp_path / "calibration.JSON", calibration)
    dp.save_camera(tmp_path / "camera.json", camera)
    dp.save_camera(tmp_path / "camera.Yaml", calibration)
    whole = load(tmp_path / "calibration.JSON")
    assert isinstance(whole, dp.Calibration)
    assert whole.summary() == calibration.summary()
    for name, want in (("camera.json", camera), ("camera.Yaml", calibration.camera)):
        found = load(tmp_path / name)
        assert isinstance(found, dp.Camera)
        assert_same(found, want)


def test_covariance_comes_back(calibration: dp.Calibration) -> None:
    unknown = torch.zeros(9, dtype=torch.bool)
    unknown[[2, 8]] = True
    shared = torch.where(unknown | unknown[:, None], 0.0, calibration.covariance.shared)
    shared = shared + torch.diag_embed(torch.where(unknown, torch.inf, 0.0).to(D))
    want = replace(calibration.covariance, shared=shared, undetermined=unknown)
    fields = want.to_fields()
    blocks = ["shared", "follow", "mixed", "alone", "undetermined", "undetermined_views", "middle", "arm"]
    assert list(fields) == ["names", "dispersion", *blocks]
    found = dp.Covariance.from_fields(json.loads(json.dumps(fields, allow_nan=False)))
    assert found.names == want.names
    assert torch.equal(found.undetermined, want.undetermined)
    assert torch.equal(found.full(), want.full())


def test_opencv_reads_a_calibration(tmp_path: Path, calibration: dp.Calibration) -> None:
    dp.save_camera(tmp_path / "c.yaml", calibration)
    storage = cv2.FileStorage(str(tmp_path / "c.yaml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), calibration.camera.K.numpy())
    assert storage.getNode("image_width").real() == 640
    assert storage.getNode("avg_reprojection_error").real() == pytest.approx(calibration.rms)
    poses = storage.getNode("extrinsic_parameters").mat()
    np.testing.assert_allclose(poses[:, 3:], calibration.cameras.t.numpy())
    np.testing.assert_allclose(cv2.Rodrigues(poses[4, :3])[0], calibration.cameras.R[4].numpy(), atol=1e-12)
    assert_same(dp.load_camera(tmp_path / "c.yaml"), calibration.camera)


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_the_unit_of_the_poses_is_written(tmp_path: Path, calibration: dp.Calibration, suffix: str) -> None:
    file = tmp_path / f"c{suffix}"
    for unit in ("mm", None):
        dp.save_camera(file, replace(calibration, unit=unit), "opencv")
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        assert storage.getNode("world_unit").empty() == (unit is None)
        assert storage.getNode("world_unit").string() == (unit or "")
        assert_same(dp.load_camera(file), calibration.camera)


def test_files_of_opencvs_calibration_program_are_read(tmp_path: Path) -> None:
    text = """%YAML:1.0
---
nframes: 13
image_width: 640
image_height: 480
square_size: 2.5e-02
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 535.5, 0., 342.25, 0., 535.5, 235.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.25, -0.04, 0.002, -0.0003, 0.24 ]
"""
    (tmp_path / "left.yml").write_text(text)
    camera = dp.load_camera(tmp_path / "left.yml")
    assert camera.K[0].tolist() == [535.5, 0, 342.25]
    assert camera.distortion.coefficients.tolist() == [-0.25, -0.04, 0.002, -0.0003, 0.24]
    assert camera.size == (640, 480)


def test_format_overrides_the_suffix(tmp_path: Path, camera: dp.Camera) -> None:
    dp.save_camera(tmp_path / "camera.txt", camera, format="json")
    assert_same(dp.load_camera(tmp_path / "camera.txt", format="json"), camera)
    dp.save_camera(tmp_path / "camera.calib", camera.without_pose(), format="opencv")
    assert_same(dp.load_camera(tmp_path / "camera.calib", format="opencv"), camera.without_pose())


def test_what_opencv_cannot_hold_is_refused(tmp_path: Path, camera: dp.Camera) -> None:
    batch = camera.without_pose().at(camera.R.expand(2, 3, 3), camera.t)
    skew = dp.Camera(camera.K + torch.tensor([[0, 1.0, 0], [0, 0, 0], [0, 0, 0]], dtype=D))
    for bad, message in ((camera, "hold no pose"), (batch, "hold one camera"), (skew, "want no skew")):
        with pytest.raises(ValueError, match=message):
            dp.save_camera(tmp_path / "camera.yaml", bad)
    assert list(tmp_path.iterdir()) == []


def test_a_lens_of_another_kind_is_refused(tmp_path: Path, camera: dp.Camera) -> None:
    class Other(dp.BrownConrady):
        pass

    other = dp.Camera(camera.K, distortion=Other(torch.zeros(5, dtype=D)))
    with pytest.raises(ValueError, match="distortion: want one of BrownConrady, KannalaBrandt, got Other"):
        dp.save_camera(tmp_path / "camera.json", other)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "want JSON, got something else"),
        ("a.json", "[1]", "want a camera matrix under a known name, such as camera_matrix, got a list"),
        ("a.json", '{"format": "diffproj camera", "version": 99, "camera": {}}', "want version 2 or earlier, got 99"),
        ("a.json", '{"format": "diffproj camera", "version": 1, "camera": {"dtype": "float64"}}', "is damaged"),
        ("a.yaml", "%YAML:1.0\n---\nnothing: 1\n", "such as camera_matrix, got the keys nothing"),
        ("a.yaml", "no camera at all", "such as camera_matrix, got a text"),
        ("a.yaml", "a: b: c", "want YAML, got something else .*in line 1"),
        ("a.png", "", "want a camera file, got an empty one"),
    ],
)
def test_files_that_are_something_else_are_named(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=f"{name}.*{message}"):
        dp.load_camera(tmp_path / name)


def test_calibrations_that_are_not_there_are_named(
    tmp_path: Path, camera: dp.Camera, calibration: dp.Calibration
) -> None:
    dp.save_camera(tmp_path / "camera.json", camera)
    with pytest.raises(ValueError, match=r"want a calibration as .* got a file with cameras alone"):
        dp.load_calibration(tmp_path / "camera.json")
    dp.save_camera(tmp_path / "camera.yaml", camera.without_pose())
    with pytest.raises(ValueError, match="want a calibration as save_camera writes it to .json"):
        dp.load_calibration(tmp_path / "camera.yaml")
    with pytest.raises(
        ValueError, match=r"want a suffix of .json, .yaml, .yml, .xml, .npz, .txt, .bin, or format='json' or"
    ):
        dp.save_camera(tmp_path / "camera.png", camera)
    dp.save_camera(tmp_path / "c.json", calibration)
    document = json.loads((tmp_path / "c.json").read_text())
    del document["calibration"]["pixels"]
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"c.json: the calibration in this file is damaged \(want the key pixels"):
        dp.load_calibration(tmp_path / "c.json")
    with pytest.raises(FileNotFoundError, match="nowhere.json"):
        dp.load_camera(tmp_path / "nowhere.json")
    with pytest.raises(FileNotFoundError):
        dp.save_camera(tmp_path / "no folder" / "camera.json", camera)


@pytest.mark.plain
def test_wrong_arguments_are_named(tmp_path: Path, camera: dp.Camera) -> None:
    with pytest.raises(TypeError, match="camera: want dp.Camera, dp.Calibration or a rig, got Tensor"):
        dp.save_camera(tmp_path / "camera.json", camera.K)
    with pytest.raises(ValueError, match="format: want 'json' or 'numpy' or .* got 'yaml'"):
        dp.save_camera(tmp_path / "camera.json", camera, format="yaml")


def test_a_crash_leaves_the_old_file(tmp_path: Path, camera: dp.Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "camera.json"
    path.write_text("old")
    path.chmod(0o640)

    def crash(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(atomic.Path, "replace", crash)
    with pytest.raises(OSError, match="disk full"):
        dp.save_camera(path, camera)
    assert [p.name for p in tmp_path.iterdir()] == ["camera.json"]
    assert path.read_text() == "old"
    monkeypatch.undo()
    dp.save_camera(path, camera)
    assert path.stat().st_mode & 0o777 == 0o640


def test_the_process_mask_is_left_alone(tmp_path: Path, camera: dp.Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    before = os.umask(0o027)
    try:
        monkeypatch.setattr(os, "umask", lambda _: pytest.fail("the mask belongs to the whole process"))
        dp.save_camera(tmp_path / "camera.json", camera)
    finally:
        monkeypatch.undo()
        os.umask(before)
    assert (tmp_path / "camera.json").stat().st_mode & 0o777 == 0o640


def test_the_content_is_on_the_disk_before_the_rename(
    tmp_path: Path, camera: dp.Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    order = []
    fsync, replace = os.fsync, atomic.Path.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (order.append("fsync"), fsync(handle))[1])
    monkeypatch.setattr(atomic.Path, "replace", lambda *paths: (order.append("rename"), replace(*paths))[1])
    dp.save_camera(tmp_path / "camera.json", camera)
    assert order == ["fsync", "rename"]


def test_a_link_stays_a_link(tmp_path: Path, camera: dp.Camera) -> None:
    (tmp_path / "link.json").symlink_to(tmp_path / "camera.json")
    dp.save_camera(tmp_path / "link.json", camera)
    assert (tmp_path / "link.json").is_symlink()
    assert_same(dp.load_camera(tmp_path / "camera.json"), camera)
