"""Sizes that are (height, width), and those of other images than K is of: refused, or warned of."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.files.image_sizes import exchanged_sides, other_image


def _file(path: Path, size, c=(648.0, 487.0), f=900.0) -> Path:
    K = [[f, 0, c[0]], [0, f, c[1]], [0, 0, 1]]
    path.write_text(json.dumps({"camera_matrix": K, "dist_coeffs": [-0.2, 0.1, 0, 0, 0], "image_size": size}))
    return path


@pytest.mark.parametrize(
    ("size", "c"), [((960, 1280), (648, 487)), ((1080, 1920), (960, 540)), ((480, 640), (326, 174))]
)
def test_height_and_width_are_refused(tmp_path: Path, size, c):
    """The last are the numbers of a public Kalibr file, whose resolution is in the wrong order."""
    with pytest.raises(ValueError, match=r"want width and height, got .*, which looks like height and width"):
        dp.load_camera(_file(tmp_path / "a.json", size, c))
    assert dp.load_camera(_file(tmp_path / "b.json", size[::-1], c)).size == size[::-1]


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_k_of_another_resolution_is_warned_of(tmp_path: Path, factor):
    size = [int(1280 * factor), int(960 * factor)]
    with pytest.warns(UserWarning, match="is K that of photographs of another resolution"):
        assert dp.load_camera(_file(tmp_path / "a.json", size)).size == tuple(size)


def test_right_cameras_are_left_alone():
    """2000 of all shapes, their principal points off by 4 % of a side; and but few of 300 halves of images."""
    generator = np.random.default_rng(4)
    refused = 0
    for i in range(2300):
        w, h = map(int, generator.integers(200, 4000, 2))
        c = np.array([w, h]) * (0.5 + 0.04 * generator.standard_normal(2))
        if i >= 2000:
            w, h, c = (w // 2, h, c - [generator.integers(0, w // 2), 0]) if i % 2 else (w, h // 2, c)
        camera = dp.Camera(torch.tensor([[w, 0, c[0]], [0, w, c[1]], [0, 0, 1]]), size=(w, h))
        assert i >= 2000 or not exchanged_sides(camera)
        assert not other_image(camera)
        refused += bool(exchanged_sides(camera))
    assert refused <= 2


def test_turned_cameras_keep_their_sides(tmp_path: Path):
    """A photograph turned by a right angle, with the K that belongs to it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert dp.load_camera(_file(tmp_path / "a.json", [960, 1280], (472.0, 648.0))).size == (960, 1280)


def test_the_own_file_is_loaded_and_warned_of(tmp_path: Path):
    """It keeps whatever camera there is."""
    K = torch.tensor([[900.0, 0, 648], [0, 900, 487], [0, 0, 1]])
    with pytest.warns(UserWarning, match="looks like height and width"):
        camera = dp.Camera(K, size=(960, 1280))
    dp.save_camera(tmp_path / "a.json", camera)
    with pytest.warns(UserWarning, match="looks like height and width"):
        assert dp.load_camera(tmp_path / "a.json").size == (960, 1280)


def test_a_calibration_of_another_size_than_its_photographs_is_refused(tmp_path: Path):
    dp.save_camera(tmp_path / "a.json", dp.calibrate(dp.example_views("left"), dp.Chessboard()))
    fields = json.loads((tmp_path / "a.json").read_text())
    fields["camera"]["size"] = [480, 640]
    (tmp_path / "a.json").write_text(json.dumps(fields))
    with pytest.raises(ValueError, match=r"size: want that of the camera, \(480, 640\), got \(640, 480\)"):
        dp.load(tmp_path / "a.json")


@pytest.mark.parametrize("size", [None, (640, 480)])
def test_a_k_in_parts_of_the_image_is_refused(tmp_path: Path, size):
    """As some programs write it; and a tiny image's K, whose centre is beyond its first pixel, is not."""
    K = [[1.2, 0, 0.5], [0, 1.6, 0.5], [0, 0, 1]]
    path = tmp_path / "a.json"
    content = {"camera_matrix": K, "dist_coeffs": [-0.3, 0.1, 0, 0, 0]} | ({"image_size": size} if size else {})
    path.write_text(json.dumps(content))
    with pytest.raises(
        ValueError, match=r"K: want pixels, got focal lengths \(1.2, 1.6\).* its first row times the wi"
    ):
        dp.load_camera(path)
    assert dp.load_camera(_file(tmp_path / "b.json", (4, 3), (1.5, 1.0), 4.0)).size == (4, 3)
    own = dp.Camera(torch.tensor(K, dtype=torch.float64), size=(640, 480))
    dp.save_camera(tmp_path / "own.json", own)
    with pytest.warns(UserWarning, match="K: want pixels"):
        assert torch.equal(dp.load_camera(tmp_path / "own.json").K, own.K)


@pytest.mark.parametrize("centre", [(0.0, 0.0), (-0.03, 0.02), (0.0, 0.5)])
@pytest.mark.parametrize("size", [None, (640, 480)])
def test_a_k_in_parts_from_the_middle_is_refused(tmp_path: Path, size, centre):
    """As normalised device coordinates have it, in whatever format; they were read as pixels."""
    K = torch.tensor([[1.2, 0, centre[0]], [0, 1.6, centre[1]], [0, 0, 1]], dtype=torch.float64)
    names = ["a.yaml", "a.npz", *(["cameras.txt", "transforms.json"] if size else [])]
    for name in names:
        dp.save_camera(tmp_path / name, dp.Camera(K, size=size), format={"transforms.json": "nerfstudio"}.get(name))
        with pytest.raises(
            ValueError, match=r"K: want pixels, got focal lengths \(1.2, 1.6\).* from its middle: where"
        ):
            dp.load_camera(tmp_path / name)


def test_where_the_file_counts_from_the_corner_the_first_pixel_s_centre_is_half_a_pixel_off(tmp_path: Path):
    fields = {"fl_x": 1.2, "fl_y": 1.6, "cx": 0.5, "cy": 0.5, "w": 640, "h": 480}
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    with pytest.raises(ValueError, match="K: want pixels"):
        dp.load_camera(tmp_path / "transforms.json")


def test_pixels_that_are_rays_are_read(tmp_path: Path):
    """The identity, of a file that knows no size: its pixels are the rays themselves."""
    dp.save_camera(tmp_path / "a.npz", dp.Camera(torch.eye(3, dtype=torch.float64)))
    assert torch.equal(dp.load_camera(tmp_path / "a.npz").K, torch.eye(3, dtype=torch.float64))
