"""Photographs from videos: sharp frames, and of those in which a board hardly moved only one."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from diffproj._core.warn import warn_caller

SUFFIXES = frozenset(
    {".3gp", ".avi", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".webm", ".wmv"}
)
"""Suffixes of files that count as videos."""

MOST = 60
"""Frames that are taken of a video by themselves."""

MOVED = 0.02
"""Mean motion of the corners, relative to the frame's diagonal, from which two frames count as two views."""

WHOLE = 0.9
"""Part of the frames that a video tells of below which it is not whole: from its rate and length they are estimated."""

QUARTERS = frozenset({90, 180, 270})
"""Turns that a video may ask for; what reads other videos than FFmpeg's answers with -1 where it knows none."""


class Frame(NamedTuple):
    """One frame of a video, compressed without loss: many frames fit into memory, and travel to other machines.

    Attributes:
        video: the file.
        number: of the frame, from 0.
        png: the grey image.
        turn: by how many degrees clockwise the video asks to be turned when it is shown.
        sharpness: for which it was chosen, so that others may show the board at the same place; None where every
            n-th frame was asked for.
    """

    video: Path
    number: int
    png: bytes
    turn: int
    sharpness: float | None

    @property
    def image(self) -> UInt8[np.ndarray, "h w"]:
        """The grey image `(H, W)`."""
        return np.asarray(cv2.imdecode(np.frombuffer(self.png, dtype=np.uint8), cv2.IMREAD_GRAYSCALE))

    @property
    def upright(self) -> UInt8[np.ndarray, "_h _w"]:
        """The grey image turned as the video asks, as players show it."""
        return np.ascontiguousarray(np.rot90(self.image, -(self.turn // 90)))


def frames_of(video: Path, every: int | None) -> list[Frame]:
    """Frames of a video: every n-th, or the sharpest of each of at most 60 equal parts.

    Raises:
        ValueError: OpenCV reads no frame of it.
    """
    frames = _sharpest(video) if every is None else _each(video, every)
    if not frames:
        raise ValueError(f"{video}: want a video, got a file of which OpenCV reads no frame")
    return frames


def _each(video: Path, every: int) -> list[Frame]:
    frames, count = [], 0
    for number, one in enumerate(_decoded(video)):
        count = number + 1
        if number % every == 0:
            frames.append(_kept(video, number, *one, None))
    _warn_if_short(video, count)
    return frames


def _sharpest(video: Path) -> list[Frame]:
    """Of each of at most 60 equal parts."""
    count = sum(1 for _ in _decoded(video))
    _warn_if_short(video, count)
    length = -(-count // MOST)
    frames: list[Frame] = []
    best = -1.0
    for number, (image, turn) in enumerate(_decoded(video)):
        if number % length == 0:
            best = -1.0
        sharpness = _sharpness(image)
        if sharpness > best:
            if best >= 0:
                frames.pop()
            best = sharpness
            frames.append(_kept(video, number, image, turn, sharpness))
    return frames


def _warn_if_short(video: Path, count: int) -> None:
    """Warn where much fewer frames could be read than the file tells of."""
    capture = cv2.VideoCapture(str(video))
    told = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))  # negative, or a rough number, where the file does not tell
    capture.release()
    if 0 < count < WHOLE * told:
        warn_caller(
            f"{video}: OpenCV reads {count} of the {told} frames that the file tells of; it may be cut short or "
            "damaged: copy it once more, or go on with these"
        )


def distinct(
    grids: list[Float[np.ndarray, "rows columns 2"]], sharpness: list[float], size: tuple[int, int]
) -> list[bool]:
    """Which views of a board to keep so that all differ: the sharpest of each place."""
    least = MOVED * float(np.hypot(*size))
    kept: list[int] = []
    for k in sorted(range(len(grids)), key=lambda k: -sharpness[k]):
        if all(_moved(grids[k], grids[other]) >= least for other in kept):
            kept.append(k)
    return [k in kept for k in range(len(grids))]


def _moved(one: Float[np.ndarray, "rows columns 2"], other: Float[np.ndarray, "rows columns 2"]) -> float:
    """Mean motion in px of the corners that both views show; infinite where they share none."""
    motion = np.linalg.norm(one - other, axis=-1)
    return float(np.nanmean(motion)) if np.isfinite(motion).any() else np.inf


def _decoded(video: Path) -> Iterator[tuple[UInt8[np.ndarray, "_h _w"], int]]:
    """All frames, grey, as they lie in the file, and by how many degrees clockwise it asks to turn them."""
    capture = cv2.VideoCapture(str(video))
    try:
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        asked = int(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        turn = asked if asked in QUARTERS else 0
        while True:
            there, image = capture.read()
            if not there:
                return
            yield image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), turn
    finally:
        capture.release()


def _sharpness(image: UInt8[np.ndarray, "h w"]) -> float:
    """The variance of the second derivatives, at half the size, where the noise of the sensor counts less."""
    small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())


def _kept(video: Path, number: int, image: UInt8[np.ndarray, "h w"], turn: int, sharpness: float | None) -> Frame:
    png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    return Frame(video, number, png, turn, sharpness)
