"""Input photographs: files, folders, arrays or tensors, converted to grey images for corner detection."""

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8
from torch import Tensor

from diffproj._core.arguments import listing
from diffproj._core.dense import dense
from diffproj.targets import videos
from diffproj.targets.exif import Exif, as_recorded
from diffproj.targets.videos import Frame

SUFFIXES = frozenset({".bmp", ".jfif", ".jpeg", ".jpg", ".jp2", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"})
"""Suffixes of the files in a folder that count as photographs."""

Orientation = Literal["sensor", "upright"]
"""How a photograph's pixels are counted: as the sensor recorded them, or turned as its EXIF data ask."""

LAYOUTS = "an array (H, W), (H, W, 1), (H, W, 3) BGR or (H, W, 4) BGRA, or a tensor (1 | 3 | 4, H, W) RGB"


class Photograph(NamedTuple):
    """One input photograph.

    Attributes:
        name: the name of its view: the file's name, or `image 3` for the third of several arrays.
        label: its name in messages: the file with its folder, or the same as `name`.
        source: the file, the pixels, or a frame of a video.
        exif: what the file tells beside the pixels, where these were read already.
    """

    name: str
    label: str
    source: Path | np.ndarray | Tensor | Frame
    exif: Exif | None = None


Source = str | os.PathLike[str] | np.ndarray | Tensor | Photograph
"""A photograph, or several: a file, folder or pattern; an array or tensor; one that was listed before."""


def listed(photographs: Source | Iterable[Source], frames: int | None = None) -> list[Photograph]:
    """List the input photographs one by one.

    Args:
        photographs: a file, a folder (its photographs in natural order: `view2` before `view10`; hidden files are
            none), a pattern such as `photos/left*.jpg`, an array, a tensor, or a list of files, arrays and tensors.
        frames: of a video, every n-th frame; by default sharp ones from all its parts.

    Raises:
        TypeError: an entry is none of these.
        ValueError: the list, the folder or the pattern holds no photograph.
        FileNotFoundError: a file does not exist.
    """
    entries = _entries(photographs)
    if not entries:
        raise ValueError(f"photographs: want at least one, got none in {photographs!r}")
    return [photograph for n, entry in enumerate(entries, start=1) for photograph in _named(n, entry, frames)]


def _named(number: int, entry: Any, frames: int | None) -> list[Photograph]:
    if isinstance(entry, Photograph):
        return [entry]
    if isinstance(entry, np.ndarray | Tensor):
        return [Photograph(f"image {number}", f"image {number}", entry)]
    if isinstance(entry, str | os.PathLike):
        path = Path(entry)
        if not path.is_file():
            raise FileNotFoundError(f"photographs: no such file: {path}")
        if path.suffix.lower() in videos.SUFFIXES:
            taken = videos.frames_of(path, frames)
            return [Photograph(f"{path.name} frame {f.number}", f"{path} frame {f.number}", f) for f in taken]
        return [Photograph(path.name, str(path), path)]
    raise TypeError(f"photographs: want file names, arrays or tensors, got {type(entry).__name__}")


def _entries(photographs: Any) -> list[Any]:
    if isinstance(photographs, np.ndarray):
        return [photographs]
    if isinstance(photographs, Tensor):
        return list(photographs) if photographs.ndim == 4 else [photographs]
    if isinstance(photographs, str | os.PathLike):
        path = Path(photographs)
        if path.is_dir():
            return sorted((file for file in path.iterdir() if _is_photograph(file)), key=_natural)
        if not path.exists() and re.search(r"[*?\[]", path.name):
            hidden = path.name.startswith(".")
            return sorted((file for file in path.parent.glob(path.name) if hidden or not _hidden(file)), key=_natural)
        return [path]
    return listing("photographs", photographs, "file names, arrays or tensors")


def _is_photograph(file: Path) -> bool:
    """Whether a file in a folder counts as a photograph."""
    return file.suffix.lower() in SUFFIXES and not _hidden(file) and file.is_file()


def _hidden(file: Path) -> bool:
    """Hidden files beside photographs are none: macOS keeps what it knows of `left1.jpg` in `._left1.jpg`."""
    return file.name.startswith(".")


def _natural(path: Path) -> list[Any]:
    """Key for natural order: numbers in a name are compared as numbers."""
    parts = re.split(r"([0-9]+)", path.name.lower())  # text at even places, numbers at odd ones
    return [int(part) if place % 2 else part for place, part in enumerate(parts)]


def grey(
    photograph: Photograph, orientation: Orientation = "sensor", content: bytes | None = None
) -> Shaped[np.ndarray, "h w"]:
    """Convert a photograph to grey, `(H, W)`, from 0 to 255: uint8 for 8-bit input, float32 otherwise.

    Files are read as the sensor recorded them, or upright. The contrast of 16-bit images is stretched from their 0.1st
    to their 99.9th percentile, since cameras of 10, 12 or 14 bits use a part of the range.

    Args:
        photograph: the photograph.
        orientation: of a file or a frame, how its pixels are counted.
        content: of a file that was read already.

    Raises:
        ValueError: the file is no image, the shape is none of the layouts, or floats are not in 0..1.
        TypeError: the values are neither uint8, nor integers of 16 bits, nor floats.
        OSError: the file cannot be read.
    """
    label, source = photograph.label, photograph.source
    if isinstance(source, Path):
        return _scaled(label, decoded(source, orientation, content=content))
    if isinstance(source, Frame):
        return source.upright if orientation == "upright" else source.image
    image = _channels_last(label, source) if isinstance(source, Tensor) else source
    if image.size == 0 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (1,), (3,), (4,)):
        raise ValueError(f"{label}: want {LAYOUTS}, got shape {tuple(source.shape)}")
    if image.shape[2:] == (4,):
        image = image[..., :3]  # without alpha
    scaled = np.ascontiguousarray(_scaled(label, image))
    return cv2.cvtColor(scaled, cv2.COLOR_BGR2GRAY) if scaled.shape[2:] == (3,) else scaled.reshape(scaled.shape[:2])


def as_8_bit(image: Shaped[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """A grey image from 0 to 255, rounded to uint8."""
    return image if image.dtype == np.uint8 else np.rint(image).astype(np.uint8)


UNREADABLE = "OpenCV cannot read as one"
"""What is said of the bytes of a file that is no image, or a damaged one."""

HEIC = (
    "HEIC photograph{}, which OpenCV does not read: convert to JPEG in full size, and let an iPhone take JPEG by "
    "Settings, Camera, Formats, Most Compatible"
)
HEIC_BRANDS = frozenset({b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"})
"""What stands behind `ftyp` at the start of such files, whatever these are called."""


class NotAnImageError(ValueError):
    """A file that is no image, or a damaged one, or one whose values are no grey levels.

    Attributes:
        path: the file.
        readable: whether it is an image, of a kind that is of no use here.
    """

    def __init__(self, path: Path, found: str) -> None:
        super().__init__(path, found)  # so that it can travel from process to process
        self.path, self.readable = path, UNREADABLE not in found

    def __str__(self) -> str:
        return f"{self.path}: want an image, got {self.args[1]}"


def decoded(path: Path, orientation: Orientation, colour: bool = False, content: bytes | None = None) -> np.ndarray:
    """The pixels of a file, of 8 or 16 bits: grey `(H, W)`, or in colour `(H, W, 3)` BGR.

    Args:
        path: the file.
        orientation: how its pixels are counted.
        colour: whether in colour.
        content: of the file, where it was read already.

    Raises:
        NotAnImageError: the file is no image.
        OSError: it cannot be read.
    """
    # cv2.imread does not distinguish a missing file from a broken one, and fails on some file names.
    content = path.read_bytes() if content is None else content
    data = np.frombuffer(as_recorded(content) if orientation == "sensor" else content, dtype=np.uint8)
    flags = (cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE) | cv2.IMREAD_ANYDEPTH
    if orientation == "sensor":
        flags |= cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(data, flags) if data.size else None
    except cv2.error as error:  # as of a header that tells of a gigapixel and more
        raise NotAnImageError(path, f"one that OpenCV refuses ({error.err})") from None
    if image is None and content[4:8] == b"ftyp" and content[8:12] in HEIC_BRANDS:
        raise NotAnImageError(path, "a " + HEIC.format(""))
    if image is None:
        raise NotAnImageError(path, f"{data.size} bytes that {UNREADABLE}")
    if image.dtype not in (np.uint8, np.uint16, np.int16) and not np.issubdtype(image.dtype, np.floating):
        raise NotAnImageError(path, f"one of {image.dtype}; save it with 8 or 16 bits")
    if np.issubdtype(image.dtype, np.floating) and not (image.min() >= 0 and image.max() <= 1):  # NaN neither
        raise NotAnImageError(path, "one of floats that are not all from 0 to 1; save it with 8 or 16 bits")
    return image


def _channels_last(label: str, image: Tensor) -> np.ndarray:
    """An RGB tensor in OpenCV's layout: `(H, W)` or `(H, W, C)` in BGR."""
    image = dense(label, image)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[0] not in (1, 3, 4)):
        raise ValueError(f"{label}: want {LAYOUTS}, got a tensor of shape {tuple(image.shape)}")
    if image.is_meta:
        raise ValueError(f"{label}: want values, got a tensor on the device meta")
    image = image.detach().cpu()
    array = (image.float() if image.is_floating_point() else image).numpy()
    if array.ndim == 2:
        return array
    return np.moveaxis(array[:3][::-1], 0, -1)


def _scaled(label: str, image: np.ndarray) -> np.ndarray:
    """Any supported dtype, scaled to 0..255."""
    if image.dtype == np.uint8:
        return image
    if image.dtype in (np.uint16, np.int16):
        # Percentiles instead of extremes: a single hot pixel would turn all others black.
        low, high = np.percentile(image, (0.1, 99.9))
        return np.clip((image.astype(np.float32) - low) * (255 / max(high - low, 1)), 0, 255).astype(np.float32)
    if np.issubdtype(image.dtype, np.floating):
        if not (np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1):
            raise ValueError(f"{label}: want floats from 0 to 1, got {image.min():g} to {image.max():g}")
        return image.astype(np.float32) * np.float32(255)
    raise TypeError(f"{label}: want uint8, integers of 16 bits, or floats, got {image.dtype}")
