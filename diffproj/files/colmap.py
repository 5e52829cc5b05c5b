"""COLMAP: `cameras.txt` and `cameras.bin` for lenses, `images.txt` and `images.bin` for poses with the cameras beside.

The first pixel's centre is at 0.5: `c_here = c_colmap - 0.5`. Poses are world to camera, in OpenCV's axes. Of the
models those that equal OpenCV's are read; THIN_PRISM_FISHEYE is not OpenCV's prism, FOV and others are other lenses.

Of `cameras` the names are the ids, and the cameras have no pose; of `images`, the file names of the images. Saved as
`images.txt`, a camera brings its `cameras.txt` and an empty `points3D.txt` along, which make a model that COLMAP reads.
"""

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from kornia.geometry.conversions import rotation_matrix_to_quaternion

from diffproj.calibration.result import Calibration
from diffproj.files.document import Document
from diffproj.files.found import Found, one_or_more
from diffproj.files.lenses import brown, coefficients, first_brown, fisheye, is_fisheye
from diffproj.files.numbers import camera_of, focal_lengths, from_quaternion, image_size, number
from diffproj.files.writing import cameras_of, has_pose
from diffproj.geometry.camera import Camera

MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
)
"""By their numbers in binary files, with their numbers of parameters."""

OURS = frozenset(name for name, _ in MODELS) - {"FOV", "THIN_PRISM_FISHEYE"}
NOTICE = "# Written by diffproj."
_CAMERA = re.compile(r"\d+\s+[A-Z][A-Z0-9_]+(\s+[-+.\w]+)+\s*")
_IMAGE = re.compile(r"\d+(\s+[-+.\deE]+){7}\s+\d+\s+\S.*")


def recognises(document: Document) -> bool:
    """Whether it is one of the four, by its name where it is binary, by its first line of content otherwise."""
    if document.text is None:
        return document.path.suffix.lower() == ".bin"
    if re.match(r"# (Camera list with one line|Image list with two lines)", document.text):
        return True
    line = next((line for line in document.text.splitlines() if line.strip() and line[0] != "#"), "")
    return bool(_CAMERA.fullmatch(line) or _IMAGE.fullmatch(line))


def read(document: Document) -> Found:
    """The cameras of `cameras`, without pose, or the posed ones of `images`.

    Raises:
        ValueError: a lens that is none of this package's, the file of the cameras is not beside `images`, or damage.
    """
    if not _is_images(document):
        return one_or_more(_cameras(document), "want at least one camera, got none")
    name = f"cameras{document.path.suffix}"
    beside = document.beside(name)
    if beside is None:
        raise ValueError(f"want {name} beside it, which holds K and the lenses, got none")
    cameras, posed = _cameras(beside), {}
    for image, pose, id_ in _images_text(document) if document.text is not None else _images_binary(document.data):
        if id_ not in cameras:
            raise ValueError(f"{image}: want a camera of {name}, got the id {id_}")
        if image in posed:
            raise ValueError(f"{image}: want each image once, got it twice")
        intrinsic = cameras[id_]
        posed[image] = camera_of(intrinsic.K.numpy(), intrinsic.distortion, intrinsic.size, pose)
    return one_or_more(posed, "want at least one image, got none")


def write(path: Path, item: Camera | Calibration) -> dict[Path, str]:
    """Cameras as `cameras.txt`, or with their poses as `images.txt`.

    Raises:
        ValueError: a pose to `cameras.txt`, a lens that COLMAP does not have, no size, or files of another model that
            would be lost.
    """
    if path.suffix.lower() != ".txt":
        raise ValueError("want cameras.txt or images.txt to write; COLMAP's model_converter makes .bin of them")
    cameras, posed = cameras_of(item, "COLMAP"), "images" in path.stem
    if not posed and any(map(has_pose, cameras)):
        raise ValueError(
            "want cameras without a pose, which cameras.txt does not hold; save images.txt, or without_pose()"
        )
    lines = [_line(camera) for camera in cameras]
    known = list(dict.fromkeys(lines)) if posed else lines
    numbered = [f"{i} {line}" for i, line in enumerate(known, 1)]
    listed = [
        "# Camera list with one line of data per camera:",
        NOTICE,
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
    ]
    text = "\n".join([*listed, *numbered]) + "\n"
    if not posed:
        return {path: text}
    files = {path.with_name("cameras.txt"): text, path.with_name("points3D.txt"): f"# 3D point list\n{NOTICE}\n"}
    for file in files:
        if file.exists() and NOTICE not in file.read_text(encoding="utf-8", errors="replace")[:200]:
            raise ValueError(f"want a folder without the {file.name} of another model, got one; choose another folder")
    images = ["# Image list with two lines of data per image:", NOTICE]
    for i, (camera, line) in enumerate(zip(cameras, lines, strict=True)):
        q = rotation_matrix_to_quaternion(camera.R)
        parts = [*(q / q.norm()).tolist(), *camera.t.tolist()]
        images += [f"{i + 1} {' '.join(map(repr, parts))} {known.index(line) + 1} {i:06d}.png", ""]
    return {**files, path: "\n".join(images) + "\n"}


def camera_from(model: str, width: Any, height: Any, parameters: list[float]) -> Camera:
    """A camera of COLMAP's model, without pose.

    Raises:
        ValueError: a model that is none of this package's, or another number of parameters.
    """
    if model not in OURS:
        raise ValueError(
            f"{model}: want one of COLMAP's models that equal OpenCV's, got another; undistort with colmap "
            "image_undistorter, or estimate again with --ImageReader.camera_model OPENCV"
        )
    count = dict(MODELS)[model]
    if len(parameters) != count:
        raise ValueError(f"{model}: want {count} parameters, got {len(parameters)}")
    one_focal = model.startswith(("SIMPLE", "RADIAL"))
    f_x, f_y, c_x, c_y, *rest = [parameters[0], *parameters] if one_focal else parameters
    K = focal_lengths(f_x, f_y, number("c_x", c_x) - 0.5, number("c_y", c_y) - 0.5)
    k = [number(f"{model}, parameter", part) for part in rest]
    if model == "OPENCV_FISHEYE":
        lens = fisheye(k)
    elif model.endswith("RADIAL_FISHEYE"):
        lens = fisheye([*k, 0, 0, 0][:4])
    elif model.endswith("PINHOLE"):
        lens = None
    else:
        lens = brown([*k, 0, 0, 0][:4] if model.endswith("RADIAL") else k)
    size = image_size(width, height)
    if size is None:
        raise ValueError("size: want the size of the image, got 0 x 0")
    return camera_of(K, lens, size)


def _line(camera: Camera) -> str:
    """Model, size and parameters."""
    if camera.size is None:
        raise ValueError("size: want the size of the image, which COLMAP needs; Camera(..., size=(width, height))")
    (f_x, _, c_x), (_, f_y, c_y), _ = camera.K.tolist()
    parameters = [f_x, f_y, c_x + 0.5, c_y + 0.5]
    if f_x <= 0 or f_y <= 0:
        raise ValueError("K: want positive focal lengths, which COLMAP needs, got a mirrored image")
    if camera.distortion is None:
        model = "PINHOLE"
    elif is_fisheye(camera):
        model, parameters = "OPENCV_FISHEYE", [*parameters, *coefficients(camera)]
    elif any(coefficients(camera)[4:]):
        model, parameters = "FULL_OPENCV", [*parameters, *first_brown(camera, 8, "COLMAP")]
    else:
        model, parameters = "OPENCV", [*parameters, *first_brown(camera, 4, "COLMAP")]
    return f"{model} {camera.size[0]} {camera.size[1]} {' '.join(map(repr, parameters))}"


def _is_images(document: Document) -> bool:
    if document.text is None:
        return "images" in document.path.name.lower()
    if document.text.startswith("# Image list"):
        return True
    line = next((line for line in document.text.splitlines() if line.strip() and line[0] != "#"), "")
    return not _CAMERA.fullmatch(line) and (bool(_IMAGE.fullmatch(line)) or "images" in document.path.name.lower())


def _cameras(document: Document) -> dict[str, Camera]:
    rows = _cameras_text(document.text) if document.text is not None else _cameras_binary(document.data)
    cameras: dict[str, Camera] = {}
    for id_, model, width, height, parameters in rows:
        if id_ in cameras:
            raise ValueError(f"camera {id_}: want each id once, got it twice")
        cameras[id_] = camera_from(model, width, height, parameters)
    return cameras


def _cameras_text(text: str) -> list[tuple[str, str, float, float, list[float]]]:
    rows = []
    for line in text.splitlines():
        words = line.split()
        if not words or words[0][0] == "#":
            continue
        if len(words) < 5 or not words[0].isdecimal():
            raise ValueError(f"want CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], got {line[:80]!r}")
        width, height, *parameters = map(_float, words[2:])
        rows.append((words[0], words[1], width, height, parameters))
    return rows


def _cameras_binary(data: bytes) -> list[tuple[str, str, float, float, list[float]]]:
    reader, rows = _Bytes(data), []
    for _ in range(reader.count(24)):
        id_, number_, width, height = reader.take("<IiQQ")
        if not 0 <= number_ < len(MODELS):
            raise ValueError(f"camera {id_}: want a model that equals OpenCV's, got the number {number_}")
        model, count = MODELS[number_]
        rows.append((str(id_), model, width, height, list(reader.take(f"<{count}d"))))
    reader.check_end()
    return rows


Image = tuple[str, tuple[np.ndarray, np.ndarray], str]


def _images_text(document: Document) -> list[Image]:
    images, lines = [], iter((document.text or "").splitlines())
    for line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0][0] == "#":
            continue
        if len(words) < 10:
            raise ValueError(f"want IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:80]!r}")
        images.append(_image(words[9], [_float(word) for word in words[1:8]], words[8]))
        points = next(lines, "").split()
        if len(points) % 3:
            raise ValueError(f"{words[9]}: want the line of its points below the line of its pose, got another")
    return images


def _images_binary(data: bytes) -> list[Image]:
    reader, images = _Bytes(data), []
    for _ in range(reader.count(72)):
        _, *pose, id_ = reader.take("<I7dI")
        name = reader.name()
        images.append(_image(name, pose, str(id_)))
        reader.skip(24 * reader.count(24))
    reader.check_end()
    return images


def _image(name: str, numbers: list[float], id_: str) -> Image:
    R = from_quaternion(name, *numbers[:4])
    return name, (R, np.array([number(name, part) for part in numbers[4:]])), id_


def _float(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"want numbers, got {word[:40]!r}") from None


class _Bytes:
    """Little-endian numbers one after the other."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, form: str) -> tuple[Any, ...]:
        """Numbers of that form; a file that ends before them is refused."""
        try:
            values = struct.unpack_from(form, self._data, self._at)
        except struct.error:
            raise ValueError(f"want a whole file, got one that ends in byte {len(self._data)}") from None
        self._at += struct.calcsize(form)
        return values

    def count(self, least: int) -> int:
        """How many records of at least so many bytes follow."""
        (count,) = self.take("<Q")
        if count * least > len(self._data):
            raise ValueError(f"want as many records as the file has room for, got the number {count}")
        return count

    def name(self) -> str:
        """A text that ends in a NUL."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise ValueError("want a name that ends, got none")
        name, self._at = self._data[self._at : end].decode("utf-8", errors="replace"), end + 1
        return name

    def skip(self, length: int) -> None:
        """Go on behind so many bytes."""
        self._at += length

    def check_end(self) -> None:
        """Refuse a file with more or less in it."""
        if self._at != len(self._data):
            raise ValueError(f"want {self._at} bytes as its records need, got {len(self._data)}")
