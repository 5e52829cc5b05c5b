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
from diffproj.targets.marked import find_marked, shows_rather
from diffproj.targets.numbering import in_order
from diffproj.targets.repeated import covered
from diffproj.targets.search import find_pattern

OTHER_SPACING = 0.15
"""How far the gaps between tags may be from what was given, relative to it."""


class Found(NamedTuple):
    """What was found in one photograph.

    Attributes:
        grid: `(rows, columns, 2)` px, in order, NaN where hidden; None where there is no such board.
        seen: `(columns, rows)` of the largest pattern where there is no such chessboard; (0, 0) for none.
        hint: what is there instead of another board, and what to give then; empty for nothing.
        size: `(width, height)` of the photograph, which who reads it fills in.
        beside: what else was made of the photograph.
        again: whether the board is seen elsewhere in it as well; the larger one was taken.
    """

    grid: Float[np.ndarray, "rows columns 2"] | None
    seen: tuple[int, int] = (0, 0)
    hint: str = ""
    size: tuple[int, int] = (0, 0)
    beside: object = None
    again: bool = False


def find(image: Shaped[np.ndarray, "h w"], target: Board) -> Found:
    """Find the target in a grey image from 0 to 255, uint8 or float32."""
    if isinstance(target, Chessboard):
        return _chessboard(image, target)
    if isinstance(target, AprilGrid):
        return _april_grid(image, target)
    if isinstance(target, CircleGrid):
        taken = find_circles(image, as_8_bit(image), target)
        return Found(None) if taken is None else Found(taken.points.reshape(*target.shape, 2), again=taken.again)
    return _charuco(image, target)


def _chessboard(image: Shaped[np.ndarray, "h w"], board: Chessboard) -> Found:
    pattern = find_pattern(as_8_bit(image), board)
    if pattern.grid is None:
        return Found(None, pattern.seen)
    patterns = [refine_grid(image, grid) for grid in (pattern.grid, *pattern.others)]
    boards = [one for one in patterns if one.is_board()]
    if not boards:
        blurred = "one too blurred for its corners to be placed: take it in focus, camera and board at rest"
        return Found(None, hint=blurred if any(one.vague for one in patterns) else "")
    refined = max(boards, key=lambda one: covered(one.grid.reshape(-1, 2)))
    return Found(in_order(refined.grid, image, board), board.size, again=len(boards) > 1)


def _april_grid(image: Shaped[np.ndarray, "h w"], board: AprilGrid) -> Found:
    taken = find_marked(image, as_8_bit(image), board)
    if taken is None:
        return Found(None)
    grid = taken.points.reshape(*board.shape, 2)
    # Tags are read whatever their distance is said to be: their corners tell what it is.
    spacing = _spacing_of(grid)
    if abs(spacing - board.spacing) > OTHER_SPACING * board.spacing:
        return Found(None, hint=f"one whose tags stand {spacing:.2f} of their side apart: give spacing={spacing:.2f}")
    return Found(grid, again=taken.again)


def _spacing_of(grid: Float[np.ndarray, "rows columns 2"]) -> float:
    """The gaps between tags relative to the sides of the tags beside them: the median; NaN where no pair is seen."""
    ratios = []
    for lines in (grid, grid.swapaxes(0, 1)):
        steps = np.linalg.norm(np.diff(lines, axis=1), axis=-1)
        ratios.append((2 * steps[:, 1::2] / (steps[:, :-2:2] + steps[:, 2::2])).ravel())
    known = np.concatenate(ratios)
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else float("nan")


def _charuco(image: Shaped[np.ndarray, "h w"], board: CharucoBoard) -> Found:
    grey = as_8_bit(image)
    taken = find_marked(image, grey, board)
    other = with_other_start(board)
    # With an odd number of columns most markers stand to each other alike on both, one square further on: those at the
    # ends of rows tell which it is. Where none of them is in view, it is the one that was asked for.
    alike = other if board.columns % 2 == 1 else None
    if taken is not None and not (alike is not None and shows_rather(grey, alike, board)):
        return Found(taken.points.reshape(*board.shape, 2), again=taken.again)
    if other is not None and find_marked(image, grey, other) is not None:
        kind = "legacy" if other.legacy else "ordinary"
        return Found(None, hint=f"one of the {kind} pattern: give legacy={other.legacy}")
    return Found(None)
