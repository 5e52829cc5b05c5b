"""Bundled example data: the corners of a real board, detected in 26 photographs.

The photographs, 640 x 480 px from the left and right cameras of a stereo pair, are those of the folder `examples/data`
in Debian's package `opencv-doc` 4.6.0. They are not included. `python -m diffproj.targets FOLDER` repeats the
detection; `data/left.json` and `data/right.json` record how they were made.
"""

import json
import os
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np

from diffproj._core.arguments import choice
from diffproj._core.atomic import write_whole
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.detection import detect
from diffproj.targets.views import Views

Side = Literal["left", "right"]
"""The two cameras of the stereo pair."""

NUMBERS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14)
"""Numbers of the photographs of each camera; `opencv-doc` has no number 10."""

BOARD = Chessboard(columns=9, rows=6, square=25.0)
"""The board in the photographs; `left_intrinsics.yml` beside them gives its square's side as 0.025 m."""

REGENERATE = "python -m diffproj.targets FOLDER"
"""The command that repeats the detection for the photographs in a folder."""

DIGITS = 4
"""Decimals of the recorded pixels, far below the accuracy of corner detection."""


def example_views(side: Side | str) -> Views:
    """The corners of the 9 x 6 board with 25 mm squares in 13 photographs of one of two real cameras.

    Detected by `detect`, in px with integers at pixel centres. The lens has visible distortion. Left and right
    photographs of the same number were taken simultaneously.

    Args:
        side: `"left"` or `"right"`.

    Returns:
        The views, float64, named by their photographs.

    Raises:
        TypeError: the side is no string.
        ValueError: it is another one.

    Example:
        >>> views = example_views("left")
        >>> views
        Views(13 views of 54 corners, 640 x 480 px, torch.float64)
        >>> views[2:5].names
        ('left03.jpg', 'left04.jpg', 'left05.jpg')
    """
    choice("side", side, get_args(Side))
    record = json.loads(
        resources.files("diffproj.targets").joinpath("data", f"{side}.json").read_text(encoding="utf-8")
    )
    corners = np.array([view["corners_px"] for view in record["views"]], dtype=np.float64)
    return Views(
        corners.reshape(len(corners), -1, 2), names=[view["file"] for view in record["views"]], size=record["size_px"]
    )


def photographs(folder: str | os.PathLike[str], side: Side) -> list[Path]:
    """The files of one camera's photographs in a folder, in order."""
    return [Path(folder) / f"{side}{number:02d}.jpg" for number in NUMBERS]


def regenerate(
    folder: str | os.PathLike[str],
    target: str | os.PathLike[str] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Path]:
    """Detect the corners in the photographs again, then write `left.json` and `right.json`, each atomically.

    Args:
        folder: of the 26 photographs.
        target: folder to write to; the package's data folder by default.
        progress: called with `(done, total)` after each photograph.

    Returns:
        The files written.

    Raises:
        FileNotFoundError: a photograph is missing.
        ValueError: the board is not found in every photograph, or one is no image. Nothing is written then.
        OSError: the target is no folder that can be written.
    """
    target = Path(target) if target is not None else Path(__file__).parent / "data"
    files = [file for side in get_args(Side) for file in photographs(folder, side)]
    views = detect(files, BOARD, progress)
    if len(views) != len(files):
        raise ValueError(f"{folder}: want the board in all {len(files)} photographs, found it in {len(views)}")
    texts = {}
    for number, side in enumerate(get_args(Side)):
        first = number * len(NUMBERS)
        texts[target / f"{side}.json"] = _as_json(views[first : first + len(NUMBERS)], side)
    for path, text in texts.items():
        write_whole(path, text)
    return list(texts)


def _as_json(views: Views, side: str) -> str:
    """The record of one camera as readable JSON, with a line for each row of the board."""
    record = {
        "about": f"Inner corners of a chessboard in the {side} camera's photographs, in px, whole numbers at pixel "
        "centres, row by row in the order of diffproj.Chessboard.points.",
        "source": {"distribution": "Debian", "package": "opencv-doc", "version": "4.6.0", "folder": "examples/data"},
        "measured_by": {"function": "diffproj.detect", "opencv": cv2.__version__, "rounded_to_px": 10.0**-DIGITS},
        "regenerate": REGENERATE,
        "board": {"columns": BOARD.columns, "rows": BOARD.rows, "square_mm": BOARD.square},
        "size_px": views.size,
    }
    header = "".join(f"{json.dumps(key)}: {json.dumps(value)},\n" for key, value in record.items())
    grids = views.pixels.reshape(len(views), BOARD.rows, BOARD.columns, 2).numpy().round(DIGITS).tolist()
    entries = []
    for name, grid in zip(views.names, grids, strict=True):
        rows = ",\n  ".join(json.dumps(row) for row in grid)
        entries.append(f'{{"file": {json.dumps(name)}, "corners_px": [\n  {rows}]}}')
    return f'{{{header}"views": [\n' + ",\n".join(entries) + "]}\n"
