"""The boards: flat targets that photographs are searched for, and that can be printed."""

from functools import lru_cache
from typing import Any

from diffproj._core.arguments import called
from diffproj.targets.april_grid import AprilGrid
from diffproj.targets.charuco import CharucoBoard
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.circle_grid import CircleGrid

Board = Chessboard | CharucoBoard | AprilGrid | CircleGrid
"""The targets that photographs are searched for."""

_KINDS = "dp.Chessboard, dp.CharucoBoard, dp.AprilGrid or dp.CircleGrid"


def as_printed(board: Any, name: str = "board") -> Board:
    """A board as it is.

    Raises:
        TypeError: it is none.
    """
    if not isinstance(board, Board):
        raise TypeError(f"{name}: want a {_KINDS}, got {called(board)}; dp.Chessboard(columns, rows, square) makes one")
    return board


@lru_cache(maxsize=64)  # the artwork is a whole picture
def faces_away(board: Board) -> bool:
    """Whether the board's z points into it, away from the camera, as its frame has it."""
    _, right, down = board.artwork.axes
    return float(right[0] * down[1] - right[1] * down[0]) > 0


def with_article(board: Board) -> str:
    """What a board is, in words that can stand after "want".

    Example:
        >>> with_article(AprilGrid(6, 6, 22.0, 0.3)), with_article(Chessboard())
        ('an AprilGrid with 6 x 6 tags', 'a board with 9 x 6 inner corners')
    """
    return f"{'an' if board.title[0] in 'aA' else 'a'} {board.title}"


def origin_doubt(board: Chessboard | CircleGrid) -> str:
    """What to know about a board that looks the same when turned: which point is the first is not seen.

    Example:
        >>> origin_doubt(Chessboard(8, 6))[:74]
        'a board with 8 x 6 inner corners looks the same when turned by 180 degrees'
    """
    what, other = "corner", "one whose columns + rows is odd, such as 9 x 6"
    if isinstance(board, CircleGrid):
        what, other = "circle", "an asymmetric one of an odd number of lines, such as 11 x 4"
    return (
        f"{with_article(board)} looks the same when turned by {360 // board.turns} degrees: the first {what}, and with "
        f"it the origin of the world, is one nearest to the photograph's top left, and may be another in the next "
        f"photograph; keep the board as it is, or use {other}"
    )


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
