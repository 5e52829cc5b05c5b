"""The boards: flat targets that photographs are searched for, and that can be printed."""

from typing import Any

from diffproj._core.arguments import called
from diffproj.targets.april_grid import AprilGrid
from diffproj.targets.charuco import CharucoBoard
from diffproj.targets.chessboard import Chessboard

Board = Chessboard | CharucoBoard | AprilGrid
"""The targets that photographs are searched for."""

_KINDS = "dp.Chessboard, dp.CharucoBoard or dp.AprilGrid"


def as_printed(board: Any, name: str = "board") -> Board:
    """A board as it is.

    Raises:
        TypeError: it is none.
    """
    if not isinstance(board, Board):
        raise TypeError(
            f"{name}: want a {_KINDS}, got {called(board)}; dp.Chessboard(columns, rows, square) makes one"
        )
    return board


def as_target(target: Any) -> Board:
    """A board that can be found, as it is.

    Raises:
        TypeError: it is none.
        ValueError: it is a chessboard of fewer than 3 x 3 inner corners.
    """
    as_printed(target, "target")
    if isinstance(target, Chessboard) and min(target.size) < 3:
        got = f"{target.columns} x {target.rows}"
        raise ValueError(f"target: want at least 3 x 3 inner corners for the board to be found, got {got}")
    return target
