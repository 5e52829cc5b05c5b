"""What files tell beside their pixels, against Pillow that writes it and OpenCV that follows it."""

import io
import struct
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from diffproj.targets.exif import Exif, exif_of
from diffproj.targets.images import NotAnImageError, decoded

PICTURE = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
EXIF_PART = 0x8769


def written(kind: str, orientation: int = 1, focal: float = 24.0) -> bytes:
    """A file as a camera writes it, with the parts that this package reads."""
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x0110] = orientation, "Nikon", "Nikon D7"
    part = exif.get_ifd(EXIF_PART)
    part[0x920A], part[0xA404] = IFDRational(round(100 * focal), 100), IFDRational(3, 2)
    part[0xA405], part[0xA431], part[0xA434] = 36, "0042", "18-55mm"
    part[0xA002], part[0xA003] = 6400, 4800
    file = io.BytesIO()
    Image.fromarray(PICTURE).save(file, kind, exif=exif)
    return file.getvalue()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
def test_what_files_tell(kind: str) -> None:
    found = exif_of(written(kind, 6))
    expected = (
        Exif(6, "Nikon D7")
        if kind == "TIFF"
        else Exif(6, "Nikon D7", "0042", "18-55mm", 24.0, 1.5, 36, size=(6400, 4800))
    )
    assert found._replace(turned_at=None) == expected  # into a TIFF Pillow writes no more
    assert (found.turned_at is None) == (kind != "TIFF")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
def test_files_without_it_and_damaged_ones_tell_nothing_wrong(kind: str) -> None:
    plain = io.BytesIO()
    Image.fromarray(PICTURE).save(plain, kind)
    assert exif_of(plain.getvalue()) == Exif()
    whole = written(kind)
    for end in range(0, len(whole), 7):
        found = exif_of(whole[:end])
        assert found.focal in (None, 24.0)
        assert found.orientation in (None, 1)
    for seed in range(300):
        draw = np.random.default_rng(seed)
        damaged = bytearray(whole)
        for place in draw.integers(2, min(len(whole), 400), 8):
            damaged[place] = draw.integers(256)
        assert exif_of(bytes(damaged)).orientation in (None, *range(1, 9))
    assert exif_of(b"") == exif_of(b"GIF89a") == exif_of(b"II*\0") == Exif()


def tiff(order: Literal["<", ">"], picture: np.ndarray, orientation: int) -> bytes:
    """A grey picture in a file of that order of bytes, with its orientation: little more than its ten entries."""
    height, width = picture.shape
    bits = 8 * picture.itemsize
    pixels = picture.astype(picture.dtype.newbyteorder(order)).tobytes()
    tags = {256: width, 257: height, 258: bits, 259: 1, 262: 1, 273: 200, 274: orientation, 277: 1, 278: height}
    head = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, len(tags) + 1)
    for tag, value in tags.items():
        head += struct.pack(f"{order}HHIHH", tag, 3, 1, value, 0)
    head += struct.pack(f"{order}HHII", 279, 4, 1, len(pixels)) + bytes(4)
    return head.ljust(200, b"\0") + pixels


def big_tiff(order: Literal["<", ">"], picture: np.ndarray, orientation: int) -> bytes:
    """The same with places of 64 bits, and with a focal length, which stands in its entry."""
    height, width = picture.shape
    bits = 8 * picture.itemsize
    pixels = picture.astype(picture.dtype.newbyteorder(order)).tobytes()
    tags = {256: width, 257: height, 258: bits, 259: 1, 262: 1, 273: 400, 274: orientation, 277: 1, 278: height}
    head = struct.pack(f"{order}2sHHHQQ", b"II" if order == "<" else b"MM", 43, 8, 0, 16, len(tags) + 2)
    for tag, value in tags.items():
        head += struct.pack(f"{order}HHQHHI", tag, 3, 1, value, 0, 0)
    head += struct.pack(f"{order}HHQQ", 279, 16, 1, len(pixels))
    head += struct.pack(f"{order}HHQII", 0x920A, 5, 1, 2400, 100) + bytes(8)
    return head.ljust(400, b"\0") + pixels


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_tiffs_are_read_as_recorded(tmp_path: Path, dtype: type, order: Literal["<", ">"], orientation: int) -> None:
    """OpenCV turns them even where it is told not to."""
    picture = PICTURE.astype(dtype)
    path = tmp_path / "turned.tif"
    path.write_bytes(tiff(order, picture, orientation))
    assert exif_of(path.read_bytes()).orientation == orientation
    np.testing.assert_array_equal(decoded(path, "sensor"), picture)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    turned = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    np.testing.assert_array_equal(decoded(path, "upright"), turned)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_tiffs_of_64_bits_are_read_as_recorded(
    tmp_path: Path, dtype: type, order: Literal["<", ">"], orientation: int
) -> None:
    """OpenCV turns them, too."""
    picture = PICTURE.astype(dtype)
    path = tmp_path / "turned.tif"
    path.write_bytes(big_tiff(order, picture, orientation))
    np.testing.assert_array_equal(decoded(path, "sensor"), picture)
    found = exif_of(path.read_bytes())
    assert (found.orientation, found.focal, found.pictures) == (orientation, 24.0, 1)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("place", [9, 2**31, 2**32 - 1])
@pytest.mark.parametrize("what", ["EXIF part", "next picture", "focal length", "maker", "no end"])
def test_a_tiff_with_damage_elsewhere_is_read_as_recorded(
    tmp_path: Path, order: Literal["<", ">"], place: int, what: str
) -> None:
    """What asks OpenCV to turn it is read nevertheless."""
    whole = bytearray(tiff(order, PICTURE, 6))
    end = 10 + 12 * 10
    entry = {"EXIF part": (EXIF_PART, 4, 1), "focal length": (0x920A, 5, 1), "maker": (0x010F, 2, 99)}.get(what)
    if entry is not None:
        struct.pack_into(f"{order}H", whole, 8, 11)
        struct.pack_into(f"{order}HHIII", whole, end, *entry, place, 0)
    elif what == "next picture":
        struct.pack_into(f"{order}I", whole, end, place)
    else:  # the directory is the last of the file, without a word of the next
        whole = whole[:4] + struct.pack(f"{order}I", len(whole)) + whole[8:] + whole[8:end]
    path = tmp_path / "turned.tif"
    path.write_bytes(whole)
    found = exif_of(bytes(whole))
    assert found.orientation == 6
    assert found.pictures == 1 or place == 9  # where numbers can be read that may be those of a picture
    np.testing.assert_array_equal(decoded(path, "sensor"), PICTURE)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", [1, 3, 4])
def test_an_orientation_of_any_type_that_opencv_follows_is_read(
    tmp_path: Path, order: Literal["<", ">"], kind: int
) -> None:
    whole = bytearray(tiff(order, PICTURE, 6))
    entry = 10 + 12 * 6
    form = {1: "BBH", 3: "HH", 4: "I"}[kind]
    struct.pack_into(f"{order}HHI{form}", whole, entry, 274, kind, 1, *(6, 0, 0)[: len(form)])
    path = tmp_path / "turned.tif"
    path.write_bytes(whole)
    shown = cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert shown is not None
    assert shown.shape == PICTURE.shape[::-1]
    assert exif_of(bytes(whole)).orientation == 6
    np.testing.assert_array_equal(decoded(path, "sensor"), PICTURE)


def test_of_two_orientations_the_first_counts(tmp_path: Path) -> None:
    """So OpenCV takes them."""
    whole = bytearray(tiff("<", PICTURE, 6))
    struct.pack_into("<HHIHH", whole, 10 + 12 * 7, 274, 3, 1, 1, 0)  # in place of the samples of a pixel, which are one
    path = tmp_path / "turned.tif"
    path.write_bytes(whole)
    shown = cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert shown is not None
    assert shown.shape == PICTURE.shape[::-1]
    np.testing.assert_array_equal(decoded(path, "sensor"), PICTURE)


def test_only_the_first_picture_of_a_tiff_counts_and_copies_of_it_do_not(tmp_path: Path) -> None:
    pictures = [Image.fromarray(np.roll(PICTURE, n)) for n in range(3)]
    file = io.BytesIO()
    pictures[0].save(file, "TIFF", save_all=True, append_images=pictures[1:])
    assert exif_of(file.getvalue()).pictures == 3
    (tmp_path / "three.tif").write_bytes(file.getvalue())
    np.testing.assert_array_equal(decoded(tmp_path / "three.tif", "sensor"), PICTURE)
    for kind in ("GIF", "PNG", "WEBP"):
        file = io.BytesIO()
        pictures[0].save(file, kind, save_all=True, append_images=pictures[1:])
        whole = file.getvalue()
        assert exif_of(whole).pictures == 3
        for end in range(0, len(whole), 7):
            assert 1 <= exif_of(whole[:end]).pictures <= 3
        file = io.BytesIO()
        pictures[0].save(file, kind)
        assert exif_of(file.getvalue()).pictures == 1
    small = pictures[1].resize((16, 12))
    small.encoderinfo = {"tiffinfo": {0x00FE: 1}}
    file = io.BytesIO()
    pictures[0].save(file, "TIFF", save_all=True, append_images=[small])
    assert exif_of(file.getvalue()).pictures == 1


def test_an_image_of_absurd_size_is_refused_and_not_a_mistake_of_ours(tmp_path: Path) -> None:
    """OpenCV raises an error of its own, which a folder of good photographs failed by."""
    whole = bytearray(cv2.imencode(".bmp", PICTURE)[1].tobytes())
    struct.pack_into("<i", whole, 18, 2**30)
    path = tmp_path / "large.bmp"
    path.write_bytes(whole)
    with pytest.raises(NotAnImageError, match=r"large\.bmp: want an image, got one that OpenCV refuses \(") as refused:
        decoded(path, "sensor")
    assert refused.value.readable
