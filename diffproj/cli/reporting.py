"""The report that `--report` asks for: checked before the work, written whole after it."""

import argparse
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffproj._core.atomic import write_whole
from diffproj.cli.inputs import check_writable, writing

if TYPE_CHECKING:  # the help needs neither
    from diffproj.calibration.results.calibration import Calibration
    from diffproj.calibration.validation import CrossValidation
    from diffproj.targets.detection import Searched

SUFFIXES = (".html", ".htm")


def report_file(text: str) -> Path:
    """Read the name of a report."""
    if Path(text).suffix.lower() not in SUFFIXES:
        raise argparse.ArgumentTypeError(f"want a file ending in .html, got {text!r}")
    return Path(text)


def check_report(path: Path | None) -> None:
    """Find out before the long work whether a report can be written, where one is asked for.

    Raises:
        ModuleNotFoundError: Jinja2 is missing.
        ValueError: there is no such folder.
        OSError: its folder cannot be written to.
    """
    if path is not None:
        check_writable("--report", path)
        import_module("jinja2")


def kept_for(path: Path | None, photographs: int, board: Any) -> Callable[..., object] | None:
    """What keeps of a photograph, while it is decoded, what a report shows of it; nothing where none is asked for."""
    if path is None:
        return None
    from diffproj.report.pictures import keeper  # here, for it takes a while to load

    return keeper(photographs, len(board.points))


def report_text(
    calibration: "Calibration",
    options: argparse.Namespace,
    found: "Searched",
    board: Any,
    folds: "CrossValidation | None",
) -> str:
    """The report on a calibration of views that were found, with them held out as they were, or in five folds."""
    from diffproj.report.pictures import of_search
    from diffproj.report.write import FOLDS, report  # here, for it takes a while to load

    return report(
        calibration,
        of_search(found),
        FOLDS if folds is None else folds,
        target=board,
        orientation=options.orientation,
        camera_file=str(options.output),
    )


def write_page(path: Path, text: str) -> None:
    """Write a page.

    Raises:
        OSError: it cannot be written.
    """
    with writing("--report", path):
        write_whole(path, text)
