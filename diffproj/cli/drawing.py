"""Pictures that `--draw` asks for: checked before the work, written whole after it."""

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from diffproj._core.atomic import write_whole
from diffproj.cli.inputs import check_not_the_same, check_writable, file_ending, writing

if TYPE_CHECKING:  # it is slow to load
    from matplotlib.figure import Figure

    from diffproj.targets.images import Photograph

drawing = file_ending(".png", ".svg", ".pdf")
"""Reads the name of a picture."""


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


def check_no_photograph(path: Path | None, photographs: Iterable["Photograph | Path"]) -> None:
    """Check that a picture does not replace a photograph.

    Raises:
        ValueError: it would.
    """
    check_not_the_same("--draw", path, (one if isinstance(one, Path) else Path(one.label) for one in photographs))


def write_drawing(path: Path, figure: "Figure") -> None:
    """Write a picture, in the format that its ending tells.

    Raises:
        OSError: it cannot be written.
    """
    from diffproj.figures import content

    picture = content(figure, path.suffix.lower().removeprefix("."))
    with writing("--draw", path):
        write_whole(path, picture)
