"""The numbers of a board's corners: which is the first, and which way the rows run."""

import numpy as np
from jaxtyping import Float, Shaped

from diffproj.targets.chessboard import Chessboard
from diffproj.targets.circle_grid import CircleGrid

Grid = Float[np.ndarray, "rows columns 2"]


def in_order(grid: Grid, image: Shaped[np.ndarray, "h w"], board: Chessboard) -> Grid:
    """Turn a board's corners into the order of `Chessboard.points`; see `detect` for the rule.

    Args:
        grid: corners in px, row by row in any of the orders that a detector may return; NaN where hidden.
        image: `(H, W)`, the grey image.
        board: the board; boards with rows = columns may be rotated by 90 degrees, others by 180.
    """
    grids = [grid, grid[::-1]]
    if board.rows == board.columns:
        grids += [candidate.swapaxes(0, 1) for candidate in grids]
    grids = [candidate for candidate in grids if _turns_clockwise(candidate)] or [grid]
    # Turned by 180 degrees, a board is as clockwise as before, and so are its squares with rows + columns even.
    grids = [(candidate, _is_darker(candidate, image)) for candidate in grids]
    alike = (board.rows + board.columns) % 2 == 0
    grids += [(candidate[::-1, ::-1], dark if alike else -dark) for candidate, dark in grids]
    found = [candidate for candidate, dark in grids if dark > 0] or [candidate for candidate, _ in grids]
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
    steps = np.stack([np.nanmean(np.diff(grid, axis=axis), axis=(0, 1)) for axis in (1, 0)])
    return steps / np.maximum(np.linalg.norm(steps, axis=-1, keepdims=True), 1e-9)


def _first(grid: Grid) -> Float[np.ndarray, "2"]:
    """The first corner, or where the seen ones' mean steps put it if it is hidden."""
    if np.isfinite(grid[0, 0, 0]):
        return grid[0, 0]
    across, down = (np.nanmean(np.diff(grid, axis=axis), axis=(0, 1)) for axis in (1, 0))
    rows, columns = grid.shape[:2]
    place = np.indices((rows, columns))[..., None]
    return np.nanmean(grid - place[0] * down - place[1] * across, axis=(0, 1))


def _turns_clockwise(grid: Grid) -> bool:
    """Whether right along the rows, then down the columns, is clockwise in the image (v points down)."""
    across, down = grid[:-1, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, :-1]
    return float(np.nansum(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])) > 0


def _is_darker(grid: Grid, image: Shaped[np.ndarray, "h w"]) -> float:
    """By how many grey values the square between the first four corners, and those of its colour, are darker.

    Decided by the mean of all squares between corners, which is robust to noise and uneven illumination; squares
    outside the corners are not used, since the image's border may cut them off.
    """
    squares = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    seen = np.isfinite(squares[..., 0])
    u, v = np.rint(np.where(seen[..., None], squares, 0)).astype(int).transpose(2, 0, 1)
    height, width = image.shape
    values = image[v.clip(0, height - 1), u.clip(0, width - 1)].astype(float)
    same = np.indices(values.shape).sum(axis=0) % 2 == 0
    return float(values[~same & seen].mean() - values[same & seen].mean())
