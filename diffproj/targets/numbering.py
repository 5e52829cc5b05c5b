"""The numbers of a board's corners: which is the first, and which way the rows run."""

import numpy as np
from jaxtyping import Float

from diffproj.targets.chessboard import Chessboard
from diffproj.targets.circle_grid import CircleGrid

Grid = Float[np.ndarray, "rows columns 2"]


def in_order(grid: Grid, begins_dark: bool, board: Chessboard) -> Grid:
    """Turn a board's corners into the order of `Chessboard.points`; see `detect` for the rule.

    Args:
        grid: corners in px, row by row in any of the orders that a detector may return; NaN where hidden. Those that
            are not hidden do not lie on one line.
        begins_dark: whether the square between its first four corners is dark, hidden or not.
        board: the board; boards with rows = columns may be rotated by 90 degrees, others by 180.
    """
    # From its other end, a column begins with the other colour where it has even many squares: one less than corners.
    begins_alike = board.rows % 2 == 0
    if not _turns_clockwise(grid):
        grid, begins_dark = grid[::-1], begins_dark == begins_alike
    grids = [(grid, begins_dark)]
    if board.rows == board.columns:
        grids.append((np.rot90(grid), begins_dark == begins_alike))
    # Turned by 180 degrees, a board is as clockwise as before, and so are its squares with rows + columns even.
    alike = (board.rows + board.columns) % 2 == 0
    grids += [(candidate[::-1, ::-1], dark == alike) for candidate, dark in grids]
    found = [candidate for candidate, dark in grids if dark] or [candidate for candidate, _ in grids]
    return np.ascontiguousarray(min(found, key=lambda candidate: float(np.linalg.norm(_first(candidate)))))


def follow(grids: list[Grid], board: Chessboard | CircleGrid) -> list[Grid]:
    """Give boards that look alike when turned one origin through a sequence of photographs.

    Of the orders that look alike, each photograph takes the one whose rows turn least from the photograph before. This
    is the board's own as long as it rolls by less than 90 degrees (a square one of even size: 45) between the two.
    """
    if board.turns == 1:
        return grids
    followed: list[Grid] = []
    for grid in grids:
        turns = [np.rot90(grid, 4 // board.turns * k) for k in range(board.turns)]
        if followed:
            before = _directions(followed[-1])
            turns.sort(key=lambda turn: -float((_directions(turn) * before).sum()))
        followed.append(np.ascontiguousarray(turns[0]))
    return followed


def _directions(grid: Grid) -> Float[np.ndarray, "2 2"]:
    """Unit vectors in the image along the rows and down the columns."""
    steps = _middle_and_steps(grid)[1:]
    return steps / np.maximum(np.linalg.norm(steps, axis=-1, keepdims=True), 1e-9)


def _first(grid: Grid) -> Float[np.ndarray, "2"]:
    """The first corner, or where the seen ones' mean steps put it if it is hidden."""
    if np.isfinite(grid[0, 0, 0]):
        return grid[0, 0]
    middle, across, down = _middle_and_steps(grid)
    rows, columns = grid.shape[:2]
    return middle - (columns - 1) / 2 * across - (rows - 1) / 2 * down


def _turns_clockwise(grid: Grid) -> bool:
    """Whether right along the rows, then down the columns, is clockwise in the image (v points down).

    Where a projection turns no three corners the other way round, as none of a board before the camera does, the sign
    is exactly theirs, however few are seen.
    """
    _, across, down = _middle_and_steps(grid)
    return float(across[0] * down[1] - across[1] * down[0]) > 0


def _middle_and_steps(grid: Grid) -> Float[np.ndarray, "3 2"]:
    """The grid's middle in px, and its steps along the rows and down the columns, as all seen corners have them.

    Fitted to the corners' places, not the mean of differences between neighbours: where a line of corners is hidden,
    none may have a neighbour.
    """
    seen = np.isfinite(grid[..., 0])
    rows, columns = grid.shape[:2]
    row, column = np.indices((rows, columns))[:, seen]
    design = np.stack([np.ones(len(row)), column - (columns - 1) / 2, row - (rows - 1) / 2], axis=-1)
    return np.linalg.lstsq(design, grid[seen], rcond=None)[0]
