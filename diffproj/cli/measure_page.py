"""The measuring page that `--page` asks for: checked before the work, written whole after it."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from diffproj._core.atomic import write_whole
from diffproj.cli.inputs import check_writable, some_path, writing

if TYPE_CHECKING:  # they are slow to load
    from diffproj.cli.scene import Scene
    from diffproj.geometry.plane import Plane

SUFFIXES = (".html", ".htm")


def page_file(text: str) -> Path:
    """Read the name of a page."""
    path = some_path(text)
    if path.suffix.lower() not in SUFFIXES:
        raise argparse.ArgumentTypeError(f"want a file ending in {' or '.join(SUFFIXES)}, got {text!r}")
    return path


def check_page(path: Path | None) -> None:
    """Find out before the long work whether the page can be written, where one is asked for.

    Raises:
        ValueError: there is no such folder.
        OSError: its folder cannot be written to.
    """
    if path is not None:
        check_writable("--page", path)


def write_page(options: argparse.Namespace, scene: "Scene", plane: "Plane", sigma: float | str) -> None:
    """Write the page in which people measure in the photograph.

    Raises:
        ValueError: the photograph has another size than the camera's images.
        OSError: it cannot be read, or the page not be written.
    """
    import numpy as np

    from diffproj.report.document import document
    from diffproj.report.measuring import measuring_part

    known = scene.photograph
    part = measuring_part(
        options.photograph if known is None else np.asarray(known.source),
        scene.calibration,
        plane,
        scene.view,
        sigma,
        unit=scene.square.unit or scene.calibration.unit,
        orientation=options.orientation,
        name=None if known is None else known.name,
    )
    with writing("--page", options.page):
        write_whole(options.page, document(part.title, [part]))
