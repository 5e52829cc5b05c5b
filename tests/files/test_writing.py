"""What is written comes back with the same projection, and reads the same in OpenCV, PyYAML and COLMAP."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

import diffproj as dp
from diffproj._core import atomic

D = torch.float64
LENSES = {
    "none": None,
    "brown4": dp.BrownConrady(torch.tensor([-0.28, 0.07, 1.3e-3, 1e-5], dtype=D)),
    "brown5": dp.BrownConrady(torch.tensor([-0.28, 0.07, 1.3e-3, 1e-5, 0.002], dtype=D)),
    "brown8": dp.BrownConrady(torch.tensor([0.1, 0.07, 1.3e-3, 1e-5, 0.002, 0.3, 0.05, 0.01], dtype=D)),
    "brown12": dp.BrownConrady(
        torch.tensor([0.1, 0.07, 1e-3, 1e-5, 0.002, 0.3, 0.05, 0.01, 1e-3, 2e-3, -1e-3, 1e-4], dtype=D)
    ),
    "brown14": dp.BrownConrady(
        torch.tensor([0.1, 0.07, 1e-3, 1e-5, 0.002, 0.3, 0.05, 0.01, 1e-3, 2e-3, -1e-3, 1e-4, 0.01, -0.02], dtype=D)
    ),
    "fisheye": dp.KannalaBrandt(torch.tensor([0.05, -0.01, 0.002, -1e-4], dtype=D)),
}
HELD = {
    "json": tuple(LENSES),
    "opencv": tuple(LENSES),
    "ros": ("none", "brown4", "brown5", "brown8", "fisheye"),
    "colmap": ("none", "brown4", "brown5", "brown8", "fisheye"),
    "nerfstudio": ("none", "brown4", "brown5", "fisheye"),
    "kalibr": ("none", "brown4", "fisheye"),
    "numpy": tuple(LENSES),
}
"""Which lenses each format holds."""

POSED = {"json": "a.json", "colmap": "images.txt", "nerfstudio": "transforms.json", "kalibr": "camchain.yaml"}
FLAT = {"opencv": "a.yaml", "ros": "ost.yaml", "numpy": "a.npz"}
HOLDS = [(name, lens) for name, lenses in HELD.items() for lens in lenses]


def cameras(lens: str, count: int = 3, seed: int = 0) -> dp.Camera:
    """Random cameras of one lens and size, each with K and pose of its own."""
    g = torch.Generator().manual_seed(seed)
    K = torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], dtype=D).repeat(count, 1, 1)
    K[:, :2] += torch.rand(count, 2, 3, dtype=D, generator=g) * torch.tensor([[37.0, 0, 9], [0, 37, 9]], dtype=D)
    angles = torch.rand(3, count, dtype=D, generator=g) * 2 - 1
    t = torch.rand(count, 3, dtype=D, generator=g) * torch.tensor([1.0, 1, 5], dtype=D)
    return dp.Camera(K, dp.rotation_from_euler(*angles), t, LENSES[lens] and LENSES[lens].expand(count), (640, 480))


def points(camera: dp.Camera, seed: int = 1) -> torch.Tensor:
    """World points in front of each camera."""
    g = torch.Generator().manual_seed(seed)
    xyz = torch.cat(
        [torch.rand(40, 2, dtype=D, generator=g) - 0.5, torch.rand(40, 1, dtype=D, generator=g) + 1], dim=-1
    )
    return (xyz - camera.t.unsqueeze(-2)) @ camera.R


def assert_same_pixels(found: dp.Camera, want: dp.Camera) -> None:
    X = points(want)
    (pixels, valid), (expected, expected_valid) = found.project(X), want.project(X)
    assert torch.equal(valid, expected_valid)
    assert bool(valid.all())
    assert float((pixels - expected).abs().max()) < 1e-9
    assert found.size == want.size


@pytest.mark.parametrize(("name", "lens"), HOLDS)
def test_round_trips(tmp_path: Path, name: str, lens: str) -> None:
    want = cameras(lens)
    if name in POSED:
        dp.save_camera(tmp_path / POSED[name], want, format=name)
        found = dp.load_camera(tmp_path / POSED[name])
        assert found.batch_shape == (3,)
        assert_same_pixels(found, want)
        return
    for one in want.without_pose():
        dp.save_camera(tmp_path / FLAT[name], one, format=name)
        assert_same_pixels(dp.load_camera(tmp_path / FLAT[name]), one)


@pytest.mark.parametrize(("name", "lens"), [(n, x) for n, held in HELD.items() for x in LENSES if x not in held])
def test_a_lens_that_a_format_does_not_hold_is_refused(tmp_path: Path, name: str, lens: str) -> None:
    file = tmp_path / (POSED | FLAT)[name]
    with pytest.raises(ValueError, match=r"distortion: want"):
        dp.save_camera(file, cameras(lens)[0].without_pose(), format=name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["opencv", "ros", "colmap", "nerfstudio", "kalibr", "numpy"])
def test_skew_is_refused_and_a_turned_image_is_turned_back(tmp_path: Path, name: str) -> None:
    file = tmp_path / (POSED | FLAT)[name]
    straight = cameras("brown5" if name != "kalibr" else "brown4")[0].without_pose()
    skewed = dp.Camera(straight.K + torch.tensor([[0, 1.0, 0], [0, 0, 0], [0, 0, 0]], dtype=D), size=(640, 480))
    with pytest.raises(ValueError, match="want no skew"):
        dp.save_camera(file, skewed, format=name)
    quarter = torch.tensor([[0.0, -1, 479], [1, 0, 0], [0, 0, 1]], dtype=D)
    turned = straight.warped(quarter, size=(480, 640))
    if name in POSED or name == "numpy":
        dp.save_camera(file, turned, format=name)
        assert_same_pixels(dp.load_camera(file), turned)
    else:
        with pytest.raises(ValueError, match="hold no pose"):
            dp.save_camera(file, turned, format=name)


@pytest.mark.parametrize("name", ["ros", "colmap", "nerfstudio", "kalibr"])
def test_formats_that_need_a_size_say_so(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="size: want the size of the image"):
        dp.save_camera(tmp_path / (POSED | FLAT)[name], dp.Camera(cameras("none").K[0]), format=name)


@pytest.mark.parametrize("lens", HELD["opencv"])
@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_opencv_reads_what_is_written(tmp_path: Path, lens: str, suffix: str) -> None:
    want = cameras(lens)[0].without_pose()
    dp.save_camera(tmp_path / f"a{suffix}", want, format="opencv")
    storage = cv2.FileStorage(str(tmp_path / f"a{suffix}"), cv2.FILE_STORAGE_READ)
    K, dist = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
    X = points(want).numpy()[:, None]
    project = cv2.fisheye.projectPoints if lens == "fisheye" else cv2.projectPoints
    pixels, _ = project(X, np.zeros(3), np.zeros(3), K, dist if dist is not None else np.zeros(5))
    np.testing.assert_allclose(pixels[:, 0], want.project(points(want))[0].numpy(), atol=1e-9)


@pytest.mark.parametrize("lens", HELD["ros"])
def test_pyyaml_reads_the_numbers_of_ros_and_kalibr(tmp_path: Path, lens: str) -> None:
    want = cameras(lens)[0]
    dp.save_camera(tmp_path / "ost.yaml", want.without_pose(), format="ros")
    tree = yaml.safe_load((tmp_path / "ost.yaml").read_text())
    assert tree["camera_matrix"]["data"] == want.K.flatten().tolist()
    assert (tree["image_width"], tree["image_height"]) == (640, 480)
    data = tree["distortion_coefficients"]["data"]
    coefficients = [] if want.distortion is None else want.distortion.coefficients.tolist()
    assert data[: len(coefficients)] == coefficients
    assert not any(data[len(coefficients) :])
    assert all(isinstance(number, float) for number in data)
    if lens in HELD["kalibr"]:
        dp.save_camera(tmp_path / "camchain.yaml", want, format="kalibr")
        camera = yaml.safe_load((tmp_path / "camchain.yaml").read_text())["cam0"]
        assert camera["distortion_coeffs"] == coefficients
        np.testing.assert_array_equal(np.array(camera["T_cam_imu"])[:3, :3], want.R.numpy())


PYCOLMAP = """
import sys, numpy as np, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
X = np.load(sys.argv[1] + "/points.npy")
pixels = []
for i in sorted(model.images):
    image = model.images[i]
    pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
    camera = model.cameras[image.camera_id]
    pixels.append([camera.img_from_cam(pose * x) for x in X[i - 1]])
np.save(sys.argv[1] + "/pixels.npy", np.array(pixels))
"""


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
@pytest.mark.parametrize("lens", HELD["colmap"])
def test_colmap_projects_the_same_half_a_pixel_on(tmp_path: Path, lens: str, suffix: str) -> None:
    pytest.importorskip("pycolmap")
    want = cameras(lens)
    dp.save_camera(tmp_path / f"images{suffix}", want)
    X = points(want)
    np.save(tmp_path / "points.npy", X.numpy())
    subprocess.run([sys.executable, "-c", PYCOLMAP, str(tmp_path)], check=True, capture_output=True)
    pixels = np.load(tmp_path / "pixels.npy")
    np.testing.assert_allclose(pixels.reshape(3, -1, 2) - 0.5, want.project(X)[0].numpy(), atol=1e-9)
    assert_same_pixels(dp.load_camera(tmp_path / f"images{suffix}"), want)
    dp.save_camera(tmp_path / f"alone{suffix}", want.without_pose(), format="colmap")
    (tmp_path / f"alone{suffix}").rename(tmp_path / f"cameras{suffix}")
    assert_same_pixels(dp.load_camera(tmp_path / f"cameras{suffix}"), want.without_pose())


def test_a_model_of_colmap_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "points3D.txt").write_text("1 0 0 1 255 255 255 0.1 1 0\n")
    with pytest.raises(ValueError, match=r"want a folder without the points3D.txt of another model"):
        dp.save_camera(tmp_path / "images.txt", cameras("none"))
    (tmp_path / "points3D.txt").unlink()
    dp.save_camera(tmp_path / "images.txt", cameras("none"))
    dp.save_camera(tmp_path / "images.txt", cameras("brown4"))  # its own it does
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cameras.txt", "images.txt", "points3D.txt"]
    dp.save_camera(tmp_path / "images.bin", cameras("none"))
    dp.save_camera(tmp_path / "images.bin", cameras("none"))
    before = (tmp_path / "images.bin").read_bytes()
    with pytest.raises(ValueError, match=r"want a folder without the cameras.bin of another model"):
        dp.save_camera(tmp_path / "images.bin", cameras("brown4"))
    assert (tmp_path / "images.bin").read_bytes() == before
    with pytest.raises(ValueError, match=r"want the suffix .txt or .bin of COLMAP's files, got .dat"):
        dp.save_camera(tmp_path / "images.dat", cameras("none"), format="colmap")


@pytest.mark.parametrize("name", ["opencv", "ros", "numpy"])
def test_one_camera_where_a_format_holds_one(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"hold one camera, got batch shape \(3,\)"):
        dp.save_camera(tmp_path / FLAT[name], cameras("none").without_pose(), format=name)


@pytest.mark.parametrize("name", ["kitti", "nuscenes", "open3d", "settings", "mrcal", "matlab", "metashape"])
def test_formats_that_are_only_read(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=f"to write, got '{name}', which is only read"):
        dp.save_camera(tmp_path / "a", cameras("none")[0], format=name)


def test_a_full_disk_leaves_the_old_file_behind_a_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "a.json", tmp_path / "a.json"
    target.write_text("old")
    link.symlink_to(target)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(atomic.os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device.*a\.json"):
        dp.save_camera(link, cameras("none"))
    assert target.read_text() == "old"
    assert [p.name for p in (tmp_path / "there").iterdir()] == ["a.json"]
    monkeypatch.undo()
    dp.save_camera(link, cameras("none"))
    assert link.is_symlink()
    assert dp.load_camera(link).batch_shape == (3,)


def test_places_that_are_no_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "loop.json").symlink_to(tmp_path / "loop.json")
    (tmp_path / "folder.json").mkdir()
    os.mkfifo(tmp_path / "pipe.json")
    for name in ("loop.json", "folder.json", "pipe.json"):
        with pytest.raises(OSError, match=name):
            dp.save_camera(tmp_path / name, cameras("none"))
        with pytest.raises((OSError, ValueError), match=name):
            dp.load_camera(tmp_path / name)
    with pytest.raises(ValueError, match="NUL"):
        dp.save_camera(f"{tmp_path}/a\0b.json", cameras("none"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder.json", "loop.json", "pipe.json"]


@pytest.mark.parametrize("stuck", ["cameras.txt", "images.txt", "points3D.txt"])
def test_files_that_belong_together_are_all_written_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stuck: str
) -> None:
    dp.save_camera(tmp_path / "images.txt", cameras("none"))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    opened = os.open

    def full(path: str, *rest: int) -> int:
        if stuck in os.fspath(path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)
        return opened(path, *rest)

    monkeypatch.setattr(atomic.os, "open", full)
    with pytest.raises(OSError, match=f"No space left on device.*{stuck}"):
        dp.save_camera(tmp_path / "images.txt", cameras("brown4"))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
