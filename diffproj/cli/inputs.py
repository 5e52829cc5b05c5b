"""What options take, in several commands: a board, numbers, camera files and places to write to."""

import argparse
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

SMALLEST_BOARD, LARGEST_BOARD = 3, 1000
"""Inner corners each way that the corner detector needs, and more than any photograph resolves."""

HAND = 0.5
"""Standard deviation in px, along u and along v, of points that a person picks in a photograph."""

DETECTOR = "detector"
"""What `--pixel-sigma` takes for pixels that a program found as well as the board's corners."""

LARGEST_NUMBER = 1e100
"""Numbers beyond it are mistakes; with them, squares would overflow."""


def board_size(text: str) -> tuple[int, int]:
    """Read inner corners such as `9x6`."""
    columns, separator, rows = text.lower().partition("x")
    if not (separator and columns.isdecimal() and rows.isdecimal() and len(text) < 100):
        raise argparse.ArgumentTypeError(f"want inner corners as COLUMNSxROWS, such as 9x6, got {text!r}")
    if min(int(columns), int(rows)) < SMALLEST_BOARD:
        raise argparse.ArgumentTypeError(
            f"want at least {SMALLEST_BOARD}x{SMALLEST_BOARD} inner corners (one less than the squares), got {text!r}"
        )
    if max(int(columns), int(rows)) > LARGEST_BOARD:
        raise argparse.ArgumentTypeError(f"want at most {LARGEST_BOARD} inner corners each way, got {text!r}")
    return int(columns), int(rows)


def counts(text: str) -> tuple[int, int]:
    """Read how many things a board has, such as `8x6`."""
    columns, separator, rows = text.lower().partition("x")
    if not (separator and columns.isdecimal() and rows.isdecimal() and len(text) < 100):
        raise argparse.ArgumentTypeError(f"want numbers as COLUMNSxROWS, such as 8x6, got {text!r}")
    if max(int(columns), int(rows)) > LARGEST_BOARD:
        raise argparse.ArgumentTypeError(f"want at most {LARGEST_BOARD} each way, got {text!r}")
    return int(columns), int(rows)


def some_path(text: str) -> Path:
    """Read the name of a file or folder; an empty one would be that of the folder where one is."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(f"want the name of a file, got {text!r}")
    return Path(text)


def add_orientation(group: argparse._ArgumentGroup | argparse.ArgumentParser) -> None:
    """Give a command the option that says how the pixels of photographs are counted."""
    group.add_argument(
        "--orientation",
        choices=("sensor", "upright"),
        default="sensor",
        help="how pixels are counted: as the sensor recorded them, or with the photograph turned upright as its EXIF "
        "data ask, which is what most programs show (default: sensor)",
    )


def file_ending(*suffixes: str) -> Callable[[str], Path]:
    """What reads the name of a file of one of these kinds."""

    def read(text: str) -> Path:
        if Path(text).suffix.lower() not in suffixes or "\0" in text:
            raise argparse.ArgumentTypeError(f"want a file ending in {', '.join(suffixes)}, got {text!r}")
        return Path(text)

    return read


camera_file = file_ending(".json", ".yaml", ".yml", ".xml")
"""Reads the name of a camera file to write."""


def numbers(text: str, count: int) -> tuple[float, ...] | None:
    """Read so many numbers with commas between them; `None` where it is something else, or beyond 1e100."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return None
    return values if len(values) == count and all(abs(value) <= LARGEST_NUMBER for value in values) else None


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
    _check_place(option, path.parent)


def check_not_the_same(option: str, path: Path | None, read: Iterable[Path]) -> None:
    """Check that what is written does not replace what is read.

    Raises:
        ValueError: it would.
    """
    if path is not None and path.exists() and path.resolve() in (one.resolve() for one in read):
        raise ValueError(f"{option}: want another file than those that are read, got {path}; choose another name")


def check_folder(option: str, path: Path) -> None:
    """Find out before the long work whether a folder can be written to, or be made.

    Raises:
        ValueError: there is a file in its place.
        OSError: it cannot be written to.
    """
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise ValueError(f"{option}: want a folder, got the file {there}; choose another")
    _check_place(option, there)


def _check_place(option: str, folder: Path) -> None:
    """Check that files can be made in a folder."""
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OSError(f"{option}: cannot write to the folder {folder} ({error.strerror}); choose another") from error


@contextmanager
def writing(option: str, path: Path) -> Iterator[None]:
    """Say of which option a file was that could not be written."""
    try:
        yield
    except OSError as error:
        raise OSError(f"{option}: could not write {path} ({error.strerror}); choose another place") from error
