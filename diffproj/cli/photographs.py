"""Which files are photographs: broken and hidden ones in folders are left out, copies count once, and all is told."""

import hashlib
import os
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.progress import Progress

from diffproj._core.warn import warn_caller
from diffproj.cli.terminal import counted, detail, note, working
from diffproj.targets import videos
from diffproj.targets.boards import Board
from diffproj.targets.detection import Searched, searched
from diffproj.targets.exif import AS_RECORDED, MIRRORED, Exif, as_recorded, exif_of
from diffproj.targets.images import HEIC, SUFFIXES, NotAnImageError, Orientation, Photograph, decoded, listed
from diffproj.targets.one_camera import doubts

RAW = frozenset({".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".raf", ".rw2"})
REMEDIES = {
    frozenset({".heic", ".heif", ".hif"}): HEIC,
    RAW: "raw photograph{}, which OpenCV does not read: convert to TIFF or PNG in full size, without lens correction",
}
"""Photographs that have to be converted: by their suffixes, what they are and what to do."""

A_VIDEO = "video{}: name a video by itself, for its frames are of another size"


def photographs(paths: Iterable[Path], frames: int | None = None) -> list[Photograph]:
    """Files as they are, the photographs in folders, in natural order, and frames of videos; each once.

    What is left out of a folder is told on standard error: copies by name, others by their number.

    Args:
        paths: files, patterns, folders.
        frames: of a video, every n-th frame; by default sharp ones.

    Raises:
        ValueError: a folder holds no photograph, or a file is of a kind that has to be converted.
        FileNotFoundError: there is no such file.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        for photograph in _in_folder(path) if path.is_dir() else _named(path):
            found.setdefault(photograph.resolve(), photograph)  # a file that is named twice needs no word
    files = _without_copies(list(found.values()))
    if not any(_is_video(file) for file in files):
        return listed(files)
    with working("Reading videos"):
        return listed(files, frames)


def one_photograph(path: Path, orientation: Orientation, colour: bool = False) -> Photograph:
    """A single photograph, read and decoded: whoever needs its pixels finds them in its source.

    Raises:
        ValueError: there are several, or it is of a kind that has to be converted, or no image.
        OSError: it cannot be read.
    """
    if path.is_dir():
        raise ValueError(f"PHOTO: want one photograph, got the folder {path}; name one of its files")
    files = _named(path)
    if len(files) > 1:
        raise ValueError(f"PHOTO: want one photograph, got {len(files)} of the form {path}; name one of them")
    if _is_video(files[0]):
        raise ValueError(f"PHOTO: want a photograph, got the video {path}; save one of its frames as a .png")
    content = files[0].read_bytes()
    with _silent_opencv():
        pixels = decoded(files[0], orientation, colour, content)
    exif = exif_of(content)
    for doubt in doubts([str(files[0])], [exif], orientation == "upright"):
        warn_caller(doubt)
    return Photograph(files[0].name, str(files[0]), pixels, exif)


def warn_if_shown_turned(path: Path, orientation: Orientation, pixels: str, exif: Exif | None = None) -> None:
    """Warn where programs that follow a photograph's EXIF data show its pixels elsewhere than they are counted.

    Args:
        path: the photograph, or a pattern that is its alone.
        orientation: how its pixels are counted.
        pixels: what holds pixels that somebody read off it, for the message.
        exif: what its file tells, where it was read already: one that is not to be turned is not read again.
    """
    if orientation == "upright" or (exif is not None and exif.orientation in AS_RECORDED):
        return
    file = _named(path)[0]
    content = file.read_bytes()
    asked = exif_of(content).orientation
    if asked in AS_RECORDED:
        return
    small = cv2.IMREAD_REDUCED_GRAYSCALE_8  # a copy is enough to see a turn, and decodes fast
    with _silent_opencv():
        recorded = cv2.imdecode(np.frombuffer(as_recorded(content), np.uint8), small | cv2.IMREAD_IGNORE_ORIENTATION)
        shown = cv2.imdecode(np.frombuffer(content, np.uint8), small)
        if recorded is None or shown is None or np.array_equal(recorded, shown):
            return
        height, width = decoded(file, orientation, content=content).shape
    right, bottom = f"{width - 1} - ", f"{height - 1} - "
    place = {2: f"{right}x, y", 3: f"{right}x, {bottom}y", 4: f"x, {bottom}y", 5: "y, x"}
    place |= {6: f"y, {bottom}x", 7: f"{right}y, {bottom}x", 8: f"{right}y, x"}
    how = "mirrored" if asked in MIRRORED else "turned"
    warn_caller(
        f"{file}: its EXIF data ask programs to show it {how}, and {pixels} count as the sensor recorded it, "
        f"{width} x {height} px: one that they show at (x, y) is ({place[asked]})"
    )


def search(
    sources: list[Any],
    board: Board,
    bars: Progress,
    title: str = "Finding corners",
    orientation: str = "sensor",
    in_folders: Collection[Path] = (),
    beside: Callable[..., object] | None = None,
) -> Searched:
    """The board's corners in photographs, on all cores, under a progress bar.

    Args:
        sources: photographs, of each of which pixels are decoded once.
        board: to look for.
        bars: where the progress is shown.
        title: of the progress bar.
        orientation: how pixels are counted.
        in_folders: folders that were named; what cannot be read of these is left out, and told.
        beside: makes something small of each photograph with the board while it is decoded, see `searched`.
    """
    task = bars.add_task(title, total=None)
    with ThreadPoolExecutor(max(1, min(len(sources), os.cpu_count() or 1))) as cores, _silent_opencv():
        found = search_in_folders(
            sources,
            board,
            in_folders,
            progress=lambda done, total: bars.update(task, completed=done, total=total),
            orientation=orientation,
            executor=cores,
            beside=beside,
        )
    detail(f"{title}: {counted(len(found.views), 'view')} of {counted(len(sources), 'photograph')}")
    return found


def search_in_folders(sources: list[Any], board: Board, folders: Collection[Path], **how: Any) -> Searched:
    """What `searched` finds, without what cannot be read of some folders, which is told.

    Raises:
        ValueError: nothing in them can be read; or as `searched`.
    """
    try:
        found = searched(sources, board, may_be_broken=folders, **how)
    except NotAnImageError as error:
        if error.path.parent not in folders or error.readable:
            raise
        raise ValueError(
            f"{error.path.parent}: want a folder with photographs ({', '.join(sorted(SUFFIXES))}), its "
            f"{counted(len(sources), 'image file')} cannot be read; copy them once more"
        ) from error
    for one in found.broken:
        note(f"{one if one.readable else f'{one.path}: cannot be read as an image'}; skipped")
    return found


def _is_video(path: Path) -> bool:
    return path.suffix.lower() in videos.SUFFIXES


def _named(path: Path) -> list[Path]:
    """A file, or those of a pattern; what is named is not left out."""
    # A video is listed by its frames, which takes long: a file that is there stands for itself.
    files = [path] if path.is_file() else [Path(one.label) for one in listed(str(path))]
    for file in files:
        for suffixes, remedy in REMEDIES.items():
            if file.suffix.lower() in suffixes:
                raise ValueError(f"{file}: {remedy.format('')}")
    return files


def _inside(folder: Path) -> str:
    """Which folders of a folder hold photographs, as a remedy; empty where none does."""
    inner = sorted(one for one in folder.iterdir() if one.is_dir() and not one.name.startswith("."))
    there = [one for one in inner if any(file.suffix.lower() in SUFFIXES for file in one.iterdir())]
    if not there:
        return ""
    named = ", ".join(map(str, there[:3])) + ", ..." * (len(there) > 3)
    return f"; there are in {named}: name {'that' if len(there) == 1 else 'one of them'}"


def _in_folder(folder: Path) -> list[Path]:
    """The photographs in a folder."""
    files = [file for file in folder.iterdir() if not file.is_dir()]
    for lost in sorted(file for file in files if not file.exists()):
        note(f"{lost}: a link to a file that is not there; skipped")
    files = [file for file in files if file.exists()]
    hidden = [file for file in files if file.name.startswith(".")]
    seen = [file for file in files if file not in hidden]
    kinds = {
        remedy: [file for file in seen if file.suffix.lower() in suffixes]
        for suffixes, remedy in {**REMEDIES, videos.SUFFIXES: A_VIDEO}.items()
    }
    there = [file for file in seen if file.suffix.lower() in SUFFIXES]
    others = len(seen) - sum(map(len, kinds.values())) - len(there)
    told = [f"{len(found)} {remedy.format('s' * (len(found) > 1))}" for remedy, found in kinds.items() if found]
    if not there:
        rest = "".join(f"; it holds {text}" for text in told) or _inside(folder) or "; name another"
        raise ValueError(
            f"{folder}: want a folder with photographs ({', '.join(sorted(SUFFIXES))}), found none in it{rest}"
        )
    for text in told:
        note(f"{folder}: skipped {text}")
    left = []
    if hidden:
        left.append(counted(len(hidden), "hidden file"))
    if others:
        left.append(counted(others, "file") + (" that is no photograph" if others == 1 else " that are no photographs"))
    if left:
        note(f"{folder}: skipped {' and '.join(left)}")
    return [Path(one.label) for one in listed(str(folder))]


@contextmanager
def _silent_opencv() -> Iterator[None]:
    """What is wrong with a broken file is nothing for the terminal: one line of ours says it."""
    # OpenCV 4 and 5 have this in different places.
    set_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    before = set_level(0)
    try:
        yield
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
