"""Options and inputs that commands share: the board, camera files, photographs and the corners in them."""

import argparse
import math
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, get_args

from rich.progress import Progress

from diffproj.targets.chessboard import Chessboard
from diffproj.targets.detection import detect
from diffproj.targets.images import SUFFIXES, Orientation, Source, listed
from diffproj.targets.views import Views

CAMERA_SUFFIXES = (".json", ".yaml", ".yml", ".xml")
SMALLEST_BOARD = 3
"""Inner corners each way that the corner detector needs."""


def board_size(text: str) -> tuple[int, int]:
    """Read inner corners such as `9x6`."""
    columns, separator, rows = text.lower().partition("x")
    if not (separator and columns.isdecimal() and rows.isdecimal()):
        raise argparse.ArgumentTypeError(f"want inner corners as COLUMNSxROWS, such as 9x6, got {text!r}")
    if min(int(columns), int(rows)) < SMALLEST_BOARD:
        raise argparse.ArgumentTypeError(
            f"want at least {SMALLEST_BOARD}x{SMALLEST_BOARD} inner corners (one less than the squares), got {text!r}"
        )
    return int(columns), int(rows)


def square_side(text: str) -> float:
    """Read the side of a square."""
    try:
        side = float(text)
    except ValueError:
        side = math.nan
    if not (math.isfinite(side) and side > 0):
        raise argparse.ArgumentTypeError(f"want the side of a square as a positive number, such as 25, got {text!r}")
    return side


def camera_file(text: str) -> Path:
    """Read the name of a camera file."""
    if Path(text).suffix.lower() not in CAMERA_SUFFIXES:
        raise argparse.ArgumentTypeError(f"want a file ending in {', '.join(CAMERA_SUFFIXES)}, got {text!r}")
    return Path(text)


def numbers(text: str, count: int) -> tuple[float, ...] | None:
    """Read so many finite numbers with commas between them; `None` where it is something else."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return None
    return values if len(values) == count and all(map(math.isfinite, values)) else None


def photographs(paths: Iterable[Path]) -> list[Source]:
    """Files as they are, and the photographs in folders, in natural order; each once, however often it is named.

    Raises:
        ValueError: a folder holds no photograph.
        FileNotFoundError: there is no such file.
    """
    found: dict[Path, Source] = {}
    for path in paths:
        if path.is_dir() and not any(file.suffix.lower() in SUFFIXES for file in path.iterdir()):
            raise ValueError(
                f"{path}: want a folder with photographs ({', '.join(sorted(SUFFIXES))}), found none in it"
            )
        for photograph in listed(str(path)):
            # The same corners twice would make the standard deviations look smaller than they are.
            found.setdefault(Path(str(photograph.source)).resolve(), photograph.source)
    return list(found.values())


def find_corners(
    sources: list[Any], board: Chessboard, bars: Progress, title: str = "Finding corners", orientation: str = "sensor"
) -> Views:
    """The board's corners in photographs, on all cores, under a progress bar."""
    task = bars.add_task(title, total=None)
    with ThreadPoolExecutor(min(len(sources), os.cpu_count() or 1)) as cores:
        return detect(
            sources,
            board,
            lambda done, total: bars.update(task, completed=done, total=total),
            orientation=orientation,
            executor=cores,
        )


def add_orientation(group: argparse._ArgumentGroup | argparse.ArgumentParser) -> None:
    """Give a command the option that says how the pixels of photographs are counted."""
    group.add_argument(
        "--orientation",
        choices=get_args(Orientation),
        default="sensor",
        help="how pixels are counted: as the sensor recorded them, or with the photograph turned upright as its EXIF "
        "data ask, which is what most programs show (default: sensor)",
    )
