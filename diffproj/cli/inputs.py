"""What options take, in several commands: a board, numbers, camera files and places to write to."""

import argparse
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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


def check_writable(option: str, path: Path) -> None:
    """Find out before the long work, and not after it, whether a file can be written.

    Raises:
        ValueError: it is a folder, or its own folder does not exist.
        OSError: its folder cannot be written to.
    """
    if path.is_dir():
        raise ValueError(f"{option}: want a file, got a folder: {path}")
    if not path.parent.is_dir():
        raise ValueError(f"{option}: no such folder: {path.parent}; make it first, or choose another")
    try:
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise OSError(
            f"{option}: cannot write to the folder {path.parent} ({error.strerror}); choose another"
        ) from error


@contextmanager
def writing(option: str, path: Path) -> Iterator[None]:
    """Say of which option a file was that could not be written."""
    try:
        yield
    except OSError as error:
        raise OSError(f"{option}: could not write {path} ({error.strerror}); choose another place") from error
