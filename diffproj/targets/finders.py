"""Find a target in one photograph: each kind of target by its own detector."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from diffproj.targets.april_grid import AprilGrid
from diffproj.targets.boards import Board
from diffproj.targets.charuco import CharucoBoard, with_other_start
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.circle_grid import CircleGrid
from diffproj.targets.circles import find_circles
from diffproj.targets.corners import refine_grid
from diffproj.targets.images import as_8_bit
from diffproj.targets.marked import find_marked
from diffproj.targets.numbering import in_order
from diffproj.targets.search import find_pattern


class Found(NamedTuple):
    """What was found in one photograph.

    Attributes:
        grid: `(rows, columns, 2)` px, in order, NaN where hidden; None where there is no such board.
        seen: `(columns, rows)` of the largest pattern where there is no such chessboard; (0, 0) for none.
        hint: what is there instead of another board, and what to give then; empty for nothing.
        size: `(width, height)` of the photograph, which who reads it fills in.
    """

    grid: Float[np.ndarray, "rows columns 2"] | None
    seen: tuple[int, int] = (0, 0)
    hint: str = ""
    size: tuple[int, int] = (0, 0)


def find(image: Shaped[np.ndarray, "h w"], target: Board) -> Found:
    """Find the target in a grey image from 0 to 255, uint8 or float32."""
    if isinstance(target, Chessboard):
        return _chessboard(image, target)
    if isinstance(target, AprilGrid):
        corners = find_marked(image, as_8_bit(image), target)
        return Found(None if corners is None else corners.reshape(*target.shape, 2))
    if isinstance(target, CircleGrid):
        centres = find_circles(image, as_8_bit(image), target)
        return Found(None if centres is None else centres.reshape(*target.shape, 2))
    return _charuco(image, target)


def _chessboard(image: Shaped[np.ndarray, "h w"], board: Chessboard) -> Found:
    pattern = find_pattern(as_8_bit(image), board)
    if pattern.grid is None:
        return Found(None, pattern.seen)
    refined = refine_grid(image, pattern.grid)
    if not refined.is_board():
        return Found(None)
    return Found(in_order(refined.grid, image, board), board.size)


def _charuco(image: Shaped[np.ndarray, "h w"], board: CharucoBoard) -> Found:
    corners = find_marked(image, as_8_bit(image), board)
    if corners is not None:
        return Found(corners.reshape(*board.shape, 2))
    other = with_other_start(board)
    if other is not None and find_marked(image, as_8_bit(image), other) is not None:
        kind = "legacy" if other.legacy else "ordinary"
        return Found(None, hint=f"one of the {kind} pattern: give legacy={other.legacy}")
    return Found(None)
