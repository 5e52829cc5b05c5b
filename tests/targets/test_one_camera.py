"""Photographs that their files say are not of one camera, one zoom or one turn, or that are mirror images."""

import itertools
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

import diffproj as dp
from diffproj.cli.photographs import one_photograph
from diffproj.targets.exif import Exif
from diffproj.targets.one_camera import doubts

BOARD = dp.Chessboard(5, 4)


def photograph(path: Path, orientation: int = 1, focal: float | None = None, serial: str | None = None) -> None:
    """A board from the front, with what a camera tells of the photograph."""
    squares = np.kron(np.indices((5, 6)).sum(axis=0) % 2, np.ones((30, 30))).astype(np.uint8) * 255
    exif = Image.Exif()
    exif[0x0112] = orientation
    part = exif.get_ifd(0x8769)
    if focal is not None:
        part[0x920A] = IFDRational(round(100 * focal), 100)
    if serial is not None:
        part[0xA431] = serial
    Image.fromarray(cv2.copyMakeBorder(squares, 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255)).save(path, exif=exif)


def warned(folder: Path, orientation: str = "sensor") -> list[str]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        dp.detect(folder, BOARD, orientation=orientation)
    return [str(one.message) for one in told]


def test_another_zoom_is_told(tmp_path: Path) -> None:
    for name, focal in (("a", 24.0), ("b", 24.72), ("c", 24.0), ("d", None)):
        photograph(tmp_path / f"{name}.jpg", focal=focal)
    (told,) = warned(tmp_path)
    assert "one camera with one zoom, got different focal lengths by their EXIF data: 24 mm in" in told
    assert f"24.72 mm in {tmp_path / 'b.jpg'}; calibrate them by themselves" in told
    assert "d.jpg" not in told


def test_another_camera_is_told_before_its_focal_length(tmp_path: Path) -> None:
    photograph(tmp_path / "a.jpg", focal=24.0, serial="12")
    photograph(tmp_path / "b.jpg", focal=28.0, serial="13")
    (told,) = warned(tmp_path)
    assert "got cameras of different serial numbers by their EXIF data: 12 in" in told


def test_one_camera_is_told_nothing_of(tmp_path: Path) -> None:
    for name, orientation, focal in (("a", 1, 24.0), ("b", 3, 24.05), ("c", 3, None)):
        photograph(tmp_path / f"{name}.jpg", orientation, focal)
    assert warned(tmp_path) == []


def test_focal_lengths_are_compared_alike_in_any_order() -> None:
    for focal in itertools.permutations((4.25, 4.27, 4.29)):
        assert doubts(["a", "b", "c"], [Exif(focal=one) for one in focal], upright=False) == []
    far = {4.25: "a", 4.27: "b", 4.29: "c", 4.5: "d", 4.1: "e"}
    for focal in itertools.permutations(far):
        (told,) = doubts([far[one] for one in focal], [Exif(focal=one) for one in focal], upright=False)
        kept = ", ".join(far[one] for one in focal if far[one] in "abc")
        assert f"4.27 mm in {kept} and 4.1 mm in e and 4.5 mm in d; calibrate them by themselves" in told
    zoom = [Exif(zoom=one) for one in (1.0, 2.0, 2.0)]
    (told,) = doubts(["a", "b", "c"], zoom, upright=False)
    assert "got different digital zooms by their EXIF data: 2x in b, c and 1x in a;" in told


@pytest.mark.parametrize("orientation", [2, 4, 5, 7])
def test_one_mirror_image_is_told_as_one(orientation: int) -> None:
    (told,) = doubts(["a.jpg", "b.jpg"], [Exif(orientation), Exif()], upright=False)
    assert told == (
        "a.jpg: this file holds a mirror image, and viewers flip it back, as EXIF data ask; pixels count as recorded, so "
        "lengths are right, but x and y are mirrored; to count pixels as viewers show them, give orientation='upright'"
    )


@pytest.mark.parametrize("orientation", [2, 4, 5, 7])
def test_mirror_images_are_told(tmp_path: Path, orientation: int) -> None:
    photograph(tmp_path / "a.jpg", orientation)
    photograph(tmp_path / "b.png", orientation)
    (told,) = warned(tmp_path)
    assert told.startswith(
        f"{tmp_path / 'a.jpg'}, {tmp_path / 'b.png'}: these files hold mirror images, and viewers flip"
    )
    assert "lengths are right, but x and y are mirrored; to count pixels as viewers show them, give" in told
    assert told.endswith("give orientation='upright'")
    assert warned(tmp_path, "upright") == []


def test_upright_photographs_that_were_turned_apart_are_told(tmp_path: Path) -> None:
    for name, orientation in (("a", 1), ("b", 3), ("c", 1)):
        photograph(tmp_path / f"{name}.jpg", orientation)
    (told,) = warned(tmp_path, "upright")
    assert told.startswith(f"{tmp_path / 'b.jpg'}: EXIF data turn these another way than the others")
    assert warned(tmp_path) == []


def test_a_file_of_several_pictures_is_told() -> None:
    assert doubts(["a.tif"], [Exif(pictures=3)], upright=False) == [
        "a.tif: want one picture a file, got several; the first was taken"
    ]
    assert doubts(["image 1"], [None], upright=True) == []


def test_a_file_is_read_once_for_its_pixels_and_what_it_tells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.png", "b.jpg", "c.tif"):
        photograph(tmp_path / name, 3)
    read, whole = [], Path.read_bytes

    def counted(path: Path) -> bytes:
        read.append(path.name)
        return whole(path)

    monkeypatch.setattr(Path, "read_bytes", counted)
    dp.detect(tmp_path, BOARD)
    assert read == ["a.png", "b.jpg", "c.tif"]
    read.clear()
    one_photograph(tmp_path / "a.png", "sensor")
    assert read == ["a.png"]
