"""What COLMAP's files say, before it means anything: a record for each camera and image, in text and in bytes.

Text has a record a line, images two, the second with the image's points. Binary files are little-endian: a number of
records as `uint64`, then the records one after the other. https://colmap.github.io/format.html
"""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

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
NOTICE = "# Written by diffproj."


class CameraRecord(NamedTuple):
    """A camera: its id, model, size in px, and the model's parameters."""

    id_: str
    model: str
    width: float
    height: float
    parameters: list[float]


class ImageRecord(NamedTuple):
    """An image: its name, qw qx qy qz tx ty tz from world to camera, and its camera's id."""

    name: str
    pose: list[float]
    camera: str


# ------------------------------------------------------------------------------------------------------------- text


def cameras_from_text(text: str) -> list[CameraRecord]:
    """The records of `cameras.txt`.

    Raises:
        ValueError: a line is none of a camera.
    """
    records = []
    for line in text.splitlines():
        words = line.split()
        if not words or words[0][0] == "#":
            continue
        if len(words) < 5 or not words[0].isdecimal():
            raise ValueError(f"want CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], got {line[:80]!r}")
        width, height, *parameters = map(number_of, words[2:])
        records.append(CameraRecord(words[0], words[1], width, height, parameters))
    return records


def images_from_text(text: str) -> list[ImageRecord]:
    """The records of `images.txt`, without their points.

    Raises:
        ValueError: a line is none of an image, or none of points where one is due.
    """
    records, lines = [], iter(text.splitlines())
    for line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0][0] == "#":
            continue
        if len(words) < 10:
            raise ValueError(f"want IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:80]!r}")
        records.append(ImageRecord(words[9], [number_of(word) for word in words[1:8]], words[8]))
        points = next(lines, "").split()
        if len(points) % 3:
            raise ValueError(f"{words[9]}: want the line of its points below the line of its pose, got another")
    return records


def cameras_to_text(records: Sequence[CameraRecord]) -> str:
    """`cameras.txt`."""
    lines = [
        "# Camera list with one line of data per camera:",
        NOTICE,
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
    ]
    for id_, model, width, height, parameters in records:
        lines.append(" ".join([id_, model, str(width), str(height), *map(repr, parameters)]))
    return "\n".join(lines) + "\n"


def images_to_text(records: Sequence[ImageRecord]) -> str:
    """`images.txt`, of images without points."""
    lines = ["# Image list with two lines of data per image:", NOTICE]
    for number, (name, pose, camera) in enumerate(records, 1):
        lines += [" ".join([str(number), *map(repr, pose), camera, name]), ""]
    return "\n".join(lines) + "\n"


def number_of(word: str) -> float:
    """The number that a word of a text says.

    Raises:
        ValueError: it says none.
    """
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"want numbers, got {word[:40]!r}") from None


# ------------------------------------------------------------------------------------------------------------ bytes


def cameras_from_bytes(data: bytes) -> list[CameraRecord]:
    """The records of `cameras.bin`.

    Raises:
        ValueError: a model of no known number, or fewer or more bytes than the records have.
    """
    reader, records = Bytes(data), []
    for _ in range(reader.count(24)):
        id_, model_number, width, height = reader.take("<IiQQ")
        if not 0 <= model_number < len(MODELS):
            raise ValueError(f"camera {id_}: want a model that equals OpenCV's, got the number {model_number}")
        model, count = MODELS[model_number]
        records.append(CameraRecord(str(id_), model, width, height, list(reader.take(f"<{count}d"))))
    reader.check_end()
    return records


def images_from_bytes(data: bytes) -> list[ImageRecord]:
    """The records of `images.bin`, without their points.

    Raises:
        ValueError: fewer or more bytes than the records have.
    """
    reader, records = Bytes(data), []
    for _ in range(reader.count(72)):
        _, *pose, id_ = reader.take("<I7dI")
        records.append(ImageRecord(reader.name(), pose, str(id_)))
        reader.skip(24 * reader.count(24))
    reader.check_end()
    return records


def cameras_to_bytes(records: Sequence[CameraRecord]) -> bytes:
    """`cameras.bin`."""
    numbers = {model: number for number, (model, _) in enumerate(MODELS)}
    parts = [struct.pack("<Q", len(records))]
    for id_, model, width, height, parameters in records:
        size = int(width), int(height)
        parts.append(struct.pack(f"<IiQQ{len(parameters)}d", int(id_), numbers[model], *size, *parameters))
    return b"".join(parts)


def images_to_bytes(records: Sequence[ImageRecord]) -> bytes:
    """`images.bin`, of images without points."""
    parts = [struct.pack("<Q", len(records))]
    for number, (name, pose, camera) in enumerate(records, 1):
        parts += [struct.pack("<I7dI", number, *pose, int(camera)), name.encode(), b"\0", struct.pack("<Q", 0)]
    return b"".join(parts)


class Bytes:
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
