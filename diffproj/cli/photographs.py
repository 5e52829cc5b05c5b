"""Which files are photographs: broken and hidden ones in folders are left out, copies count once, and all is told."""

import hashlib
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.progress import Progress

from diffproj.cli.terminal import counted, note
from diffproj.targets.boards import Board
from diffproj.targets.detection import detect
from diffproj.targets.images import SUFFIXES, Source, listed
from diffproj.targets.views import Views

HEIC = frozenset({".heic", ".heif", ".hif"})
RAW = frozenset({".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".raf", ".rw2"})
REMEDIES = {
    HEIC: "HEIC photograph{}, which OpenCV does not read: convert to JPEG in full size, and let an iPhone take JPEG by "
    "Settings, Camera, Formats, Most Compatible",
    RAW: "raw photograph{}, which OpenCV does not read: convert to TIFF or PNG in full size, without lens correction",
}
"""Photographs that have to be converted: by their suffixes, what they are and what to do."""


def photographs(paths: Iterable[Path]) -> list[Source]:
    """Files as they are, and the photographs in folders, in natural order; each once, however often it is there.

    What is left out of a folder is told on standard error: broken files and copies by name, others by their number.

    Raises:
        ValueError: a folder holds no photograph, or a file is of a kind that has to be converted.
        FileNotFoundError: there is no such file.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        for photograph in _in_folder(path) if path.is_dir() else _named(path):
            found.setdefault(photograph.resolve(), photograph)  # a file that is named twice needs no word
    return list(_without_copies(list(found.values())))


def find_corners(
    sources: list[Any], board: Board, bars: Progress, title: str = "Finding corners", orientation: str = "sensor"
) -> Views:
    """The board's corners in photographs, on all cores, under a progress bar."""
    task = bars.add_task(title, total=None)
    with ThreadPoolExecutor(max(1, min(len(sources), os.cpu_count() or 1))) as cores:
        return detect(
            sources,
            board,
            lambda done, total: bars.update(task, completed=done, total=total),
            orientation=orientation,
            executor=cores,
        )


def _named(path: Path) -> list[Path]:
    """A file, or those of a pattern; what is named is not left out."""
    files = [Path(str(photograph.source)) for photograph in listed(str(path))]
    for file in files:
        for suffixes, remedy in REMEDIES.items():
            if file.suffix.lower() in suffixes:
                raise ValueError(f"{file}: {remedy.format('')}")
    return files


def _in_folder(folder: Path) -> list[Path]:
    """The photographs in a folder that can be read."""
    files = [file for file in folder.iterdir() if not file.is_dir()]
    hidden = [file for file in files if file.name.startswith(".")]
    seen = [file for file in files if file not in hidden]
    convertible = {
        remedy: [file for file in seen if file.suffix.lower() in suffixes] for suffixes, remedy in REMEDIES.items()
    }
    others = len(seen) - sum(map(len, convertible.values())) - sum(file.suffix.lower() in SUFFIXES for file in seen)
    told = [f"{len(found)} {remedy.format('s' * (len(found) > 1))}" for remedy, found in convertible.items() if found]
    readable, broken = [], []
    if any(file.suffix.lower() in SUFFIXES for file in seen):
        for photograph in listed(str(folder)):
            path = Path(str(photograph.source))
            (readable if _is_image(path) else broken).append(path)
    if not readable:
        why = f"its {counted(len(broken), 'image file')} cannot be read" if broken else "found none in it"
        rest = "".join(f"; it holds {text}" for text in told)
        raise ValueError(f"{folder}: want a folder with photographs ({', '.join(sorted(SUFFIXES))}), {why}{rest}")
    for path in broken:
        note(f"{path}: cannot be read as an image; skipped")
    for text in told:
        note(f"{folder}: skipped {text}")
    left = []
    if hidden:
        left.append(counted(len(hidden), "hidden file"))
    if others:
        left.append(counted(others, "file") + (" that is no photograph" if others == 1 else " that are no photographs"))
    if left:
        note(f"{folder}: skipped {' and '.join(left)}")
    return readable


def _is_image(path: Path) -> bool:
    """Whether OpenCV reads it; at an eighth of its size, which for JPEG takes a fraction of the time."""
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    # What is wrong with a broken file is nothing for the terminal. OpenCV 4 and 5 have this in different places.
    set_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    before = set_level(0)
    try:
        return bool(data.size) and cv2.imdecode(data, cv2.IMREAD_REDUCED_GRAYSCALE_8) is not None
    finally:
        set_level(before)


def _without_copies(paths: list[Path]) -> list[Path]:
    """Each content once: the same corners twice would make the standard deviations look smaller than they are."""
    sizes = [path.stat().st_size for path in paths]
    first: dict[tuple[int, bytes], Path] = {}
    for path, size in zip(paths, sizes, strict=True):
        same_size = sizes.count(size) > 1
        content = hashlib.blake2b(path.read_bytes()).digest() if same_size else str(path).encode()
        original = first.setdefault((size, content), path)
        if original is not path:
            note(f"{path}: the same photograph as {original}; counted once")
    return list(first.values())
