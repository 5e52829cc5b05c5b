"""The photographs of one camera of a fleet, searched for the board: the work of one task, here or on a worker."""

import hashlib
import os
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

from diffproj.cli.photographs import photographs, search_in_folders
from diffproj.cli.terminal import NOTES, failure, in_options
from diffproj.targets.boards import Board
from diffproj.targets.images import SUFFIXES
from diffproj.targets.views import Views


@dataclass(frozen=True)
class Folder:
    """What is to be searched.

    Attributes:
        path: of the folder.
        board: what to look for.
        orientation: how pixels are counted.
    """

    path: Path
    board: Board
    orientation: str


@dataclass(frozen=True)
class Searched:
    """What was found.

    Attributes:
        views: where the board is; `None` where it is nowhere.
        photographs: how many were searched.
        seconds: how long that took.
        notes: what was left out, and why.
        error: why there are no views.
    """

    views: Views | None
    photographs: int
    seconds: float
    notes: tuple[str, ...]
    error: str | None = None


def searched(folder: Folder) -> Searched:
    """Search the photographs of a folder, one after the other; what goes wrong is told in the result."""
    begin, count, views, error = time.perf_counter(), 0, None, None
    with warnings.catch_warnings(record=True) as warned, NOTES.capture() as said:
        warnings.simplefilter("always")
        try:
            sources = photographs([folder.path])
            count = len(sources)
            views = search_in_folders(sources, folder.board, [folder.path], orientation=folder.orientation).views
        except (ValueError, OSError, RuntimeError) as problem:
            error = failure(problem)
    lines = [line.removeprefix("diffproj: ") for line in said.get().splitlines()]
    notes = (*lines, *(in_options(str(warning.message)) for warning in warned))
    return Searched(views, count, time.perf_counter() - begin, notes, error)


def state_of(folder: Path) -> str:
    """What tells whether photographs came, went or changed: their names, sizes and times, in short.

    Their contents are not read, for of a large fleet that takes minutes. Empty where the folder cannot be looked into,
    or a photograph went meanwhile: what it holds, or why it holds nothing, the search tells.
    """
    told = hashlib.blake2b(digest_size=16)
    try:
        for file in sorted(one for one in folder.iterdir() if one.suffix.lower() in SUFFIXES and one.exists()):
            about = file.stat()
            told.update(repr((file.name, about.st_size, about.st_mtime_ns)).encode("utf-8", "surrogateescape"))
    except OSError:
        return ""
    return told.hexdigest()


def on_one_core() -> None:
    """Set up a worker: there are as many of them as cores."""
    import cv2
    import torch

    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
