"""Kalibr's target files: the board that a camera is shown, in metres."""

from pathlib import Path
from typing import Any

from diffproj.files.document import Document
from diffproj.files.numbers import number, whole
from diffproj.targets.april_grid import AprilGrid
from diffproj.targets.boards import Board
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.circle_grid import CircleGrid

MOST = 10_000
"""Most of anything along a side of a board."""


def read_target(path: Path, diameter: float | None = None) -> Board:
    """The board that a target file of Kalibr describes, with metres as the world's unit.

    Args:
        path: a YAML file with `target_type`: `aprilgrid`, `checkerboard` or `circlegrid`.
        diameter: of circles in metres, which such a file does not tell.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: it is no target file, or describes a board that cannot be.
    """
    fields = Document.read(path).mapping
    kind = fields.get("target_type")
    if kind not in ("aprilgrid", "checkerboard", "circlegrid"):
        raise ValueError(
            f"{path}: want a target file of Kalibr with target_type aprilgrid, checkerboard or circlegrid, got {kind!r}"
        )
    try:
        return _board(str(kind), fields, diameter)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _board(kind: str, fields: dict[str, Any], diameter: float | None) -> Board:
    def counted(key: str) -> int:
        return whole(key, fields.get(key), MOST)

    def length(key: str) -> float:
        return number(key, fields.get(key))

    if kind == "aprilgrid":
        return AprilGrid(counted("tagCols"), counted("tagRows"), length("tagSize"), length("tagSpacing"))
    columns, rows = counted("targetCols"), counted("targetRows")
    if kind == "checkerboard":
        across, down = length("colSpacingMeters"), length("rowSpacingMeters")
        if abs(across - down) > 1e-9 * abs(down):
            raise ValueError(f"want squares, colSpacingMeters as rowSpacingMeters, got {across:g} and {down:g}")
        return Chessboard(columns, rows, down)
    if diameter is None:
        raise ValueError("want the diameter of its circles too, which the file does not tell; --diameter gives it")
    shifted = fields.get("asymmetricGrid", False)
    if not isinstance(shifted, bool):
        raise ValueError(f"asymmetricGrid: want True or False, got {shifted!r}")
    return CircleGrid(columns, rows, length("spacingMeters"), diameter, "rows" if shifted else False)
