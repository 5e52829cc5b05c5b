"""Pictures that `--draw` asks for: checked before the work, written whole after it."""

import argparse
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from diffproj._core.atomic import write_whole
from diffproj.cli.inputs import check_writable, writing

if TYPE_CHECKING:  # it is slow to load
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg", ".pdf")


def drawing(text: str) -> Path:
    """Read the name of a picture."""
    if Path(text).suffix.lower() not in SUFFIXES:
        raise argparse.ArgumentTypeError(f"want a file ending in {', '.join(SUFFIXES)}, got {text!r}")
    return Path(text)


def check_drawing(path: Path | None) -> None:
    """Find out before the long work whether a picture can be drawn, where one is asked for.

    Raises:
        ModuleNotFoundError: matplotlib is missing.
        ValueError: there is no such folder.
        OSError: its folder cannot be written to.
    """
    if path is not None:
        check_writable("--draw", path)
        import_module("diffproj.figures")


def check_no_photograph(path: Path | None, photographs: Iterable[object]) -> None:
    """Check that a picture does not replace a photograph.

    Raises:
        ValueError: it would.
    """
    if path is not None and path.exists() and path.resolve() in (Path(str(p)).resolve() for p in photographs):
        raise ValueError(f"--draw: want another file than the photographs, got {path}; choose another name")


def write_drawing(path: Path, figure: "Figure") -> None:
    """Write a picture, in the format that its ending tells.

    Raises:
        OSError: it cannot be written.
    """
    from diffproj.figures import content

    picture = content(figure, path.suffix.lower().removeprefix("."))
    with writing("--draw", path):
        write_whole(path, picture)
