"""Find a chessboard in a photograph: its corners to a pixel or so, or why there are none."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from diffproj.targets.chessboard import Chessboard
from diffproj.targets.lattice import as_grid, lattices
from diffproj.targets.saddles import saddle_points

FIRST = 1100
"""Longer side in px of the copy that is searched thoroughly before others; half of it is looked at before."""

COARSE = 8.0
"""Least step in px of a board in the first, small copy: a shorter one may have lost corners on the way."""

FULL = 0.5
"""Share of a line of corners beside a board from which the pattern is said to go on there."""

WHOLE = 0.75
"""Share of its corners that a board must show; the others are hidden by what lies before it."""

HINT = 0.3
"""Share of a board's corners in a pattern from which OpenCV's detectors are asked, too."""

FINEST = 5.5
"""Least mean step in px of a pattern: finer ones are cloth, grilles and screens, whose corners nobody could place."""

NARROWEST = 16
"""Shorter side in px of an image that is searched: less has no room for a board."""

SMALLEST = 12
"""Corners of the smallest whole pattern that is taken for a board of its own."""

_ACCURATE = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY


class Pattern(NamedTuple):
    """A board in a photograph, or the largest pattern where none fits.

    Attributes:
        grid: `(rows, columns, 2)` px, to a pixel or so; NaN where a corner is hidden. None where no board fits.
        seen: `(columns, rows)` of the largest pattern in the photograph where no board fits; (0, 0) for none.
        others: further patterns of the board's size, elsewhere.
    """

    grid: Float[np.ndarray, "rows columns 2"] | None
    seen: tuple[int, int] = (0, 0)
    others: tuple[Float[np.ndarray, "rows columns 2"], ...] = ()


def find_pattern(image: UInt8[np.ndarray, "h w"], board: Chessboard) -> Pattern:
    """Find the board's corners in one grey image, in any of the orders that fit rows and columns.

    Copies of several sizes are searched for patterns of saddle points: one of at most 550 px, which shows most boards,
    then one of twice its size, one of half of it for blurred photographs, and larger ones for small boards. This takes
    a fraction of a second where nothing is found. Where a part of a pattern is found, but no board, OpenCV's two
    detectors are asked as well. All patterns of the copy that shows the board may be boards.
    """
    if min(image.shape) < NARROWEST:
        return Pattern(None)
    first = _resized(image, min(1.0, FIRST / max(image.shape)))
    half = _resized(first, 0.5)
    coarse = _patterns(half, image)
    found = matched(coarse[0], board) if coarse else None
    if (
        found is not None
        and extent_of(coarse[0]) == (max(board.size), min(board.size))
        and _is_plain(found, image, half)
    ):
        # A smaller board beside it may have lost corners in this copy.
        beside = any(_telling(other, board) for other in coarse[1:])
        boards = [matched(pattern, board) for pattern in _patterns(first, image)] if beside else []
        return Pattern(found, others=tuple(one for one in boards if one is not None and not _same(one, found)))
    seen, partial, other_boards = (0, 0), None, []
    for patterns in itertools.chain((_patterns(first, image), coarse), _further_patterns(first, image)):
        boards = []
        for pattern in patterns:
            found = matched(pattern, board)
            # Of another board, another copy may show no more, or no less, than what looks like this one.
            if found is not None and not any(_shadows(other, pattern) for other in other_boards):
                boards.append(found)
                continue
            extent = extent_of(pattern)
            if _larger(extent, board):
                other_boards.append(pattern)
            if extent[0] * extent[1] > seen[0] * seen[1]:
                seen, partial = extent, pattern
        if boards:
            return Pattern(boards[0], others=tuple(boards[1:]))
    if partial is None or not _telling(partial, board) or _is_other(seen, partial, board):
        return Pattern(None, seen)
    return Pattern(_by_opencv(image, partial, board), seen)


def _patterns(small: UInt8[np.ndarray, "h w"], image: UInt8[np.ndarray, "H W"]) -> list[Float[np.ndarray, "_r _c 2"]]:
    """The patterns in a copy of the image, in px of the image, largest first."""
    saddles = saddle_points(small)
    grids = [_carried(as_grid(cells, saddles.points), small, image) for cells in lattices(saddles)]
    return sorted((grid for grid in grids if _spacing(grid) >= FINEST), key=_area, reverse=True)


def _same(one: Float[np.ndarray, "r c 2"], other: Float[np.ndarray, "r c 2"]) -> bool:
    """Whether two patterns of one size are in one place."""
    apart = np.nanmean(one, axis=(0, 1)) - np.nanmean(other, axis=(0, 1))
    return float(np.hypot(*apart)) < _spacing(other)


def _telling(pattern: Float[np.ndarray, "r c 2"], board: Chessboard) -> bool:
    """Whether enough of a pattern is seen for a larger copy to be asked what it is."""
    return bool(np.isfinite(pattern[..., 0]).sum() >= HINT * len(board))


def _is_plain(
    grid: Float[np.ndarray, "r c 2"], image: UInt8[np.ndarray, "H W"], small: UInt8[np.ndarray, "h w"]
) -> bool:
    """Whether all corners are seen, and so far apart in the copy that none beyond them can have been lost."""
    least = COARSE * max(image.shape) / max(small.shape)
    return all(bool((np.linalg.norm(np.diff(grid, axis=axis), axis=-1) > least).all()) for axis in (0, 1))


def matched(grid: Float[np.ndarray, "r c 2"], board: Chessboard) -> Float[np.ndarray, "rows columns 2"] | None:
    """The part of a pattern that is the board; None where it is too small, or goes on beyond the board.

    A pattern whose lines beside the board are mostly empty is not said to go on: what stands there by chance, on a
    table's edge say, is left out. Some of the board's corners may be hidden, but none of its four sides.
    """
    best, most = None, WHOLE * len(board) - 1e-9
    for candidate in (grid, grid.swapaxes(0, 1)) if board.rows != board.columns else (grid,):
        occupied = np.isfinite(candidate[..., 0])
        for i in range(max(1, occupied.shape[0] - board.rows + 1)):
            for j in range(max(1, occupied.shape[1] - board.columns + 1)):
                part = occupied[i : i + board.rows, j : j + board.columns]
                if part.shape != (board.rows, board.columns) or part.sum() <= most or _goes_on(occupied, i, j, board):
                    continue
                if min(part[0].mean(), part[-1].mean(), part[:, 0].mean(), part[:, -1].mean()) >= FULL:
                    best, most = candidate[i : i + board.rows, j : j + board.columns], part.sum()
    return None if best is None else np.ascontiguousarray(best)


def _goes_on(occupied: Bool[np.ndarray, "r c"], i: int, j: int, board: Chessboard) -> bool:
    """Whether most of a line of corners just outside the board is there."""
    for lines, start, count in (
        (occupied[:, j : j + board.columns], i, board.rows),
        (occupied[i : i + board.rows].T, j, board.columns),
    ):
        for line in (start - 1, start + count):
            if 0 <= line < len(lines) and lines[line].mean() >= FULL:
                return True
    return False


def extent_of(grid: Float[np.ndarray, "r c 2"]) -> tuple[int, int]:
    """`(columns, rows)` of a pattern without outer lines that are mostly empty; columns are the longer side."""
    occupied = np.isfinite(grid[..., 0])
    while occupied.size:
        rows, columns = occupied.mean(axis=1), occupied.mean(axis=0)
        emptiest = min(rows[0], rows[-1], columns[0], columns[-1])
        if emptiest >= FULL:
            break
        if emptiest in (rows[0], rows[-1]):
            occupied = occupied[1:] if emptiest == rows[0] else occupied[:-1]
        else:
            occupied = occupied[:, 1:] if emptiest == columns[0] else occupied[:, :-1]
    short, long = sorted(occupied.shape)
    return (long, short) if short else (0, 0)


def _larger(seen: tuple[int, int], board: Chessboard) -> bool:
    """Whether a pattern has more corners than the board one way, so that another board is in view."""
    short, long = sorted(board.size)
    return seen[0] > long or seen[1] > short


def _is_other(seen: tuple[int, int], grid: Float[np.ndarray, "r c 2"], board: Chessboard) -> bool:
    """Whether a pattern is a board of its own: larger than the one sought one way, or whole and smaller."""
    whole = seen[0] * seen[1] >= SMALLEST and np.isfinite(grid[..., 0]).sum() >= 0.95 * seen[0] * seen[1]
    return _larger(seen, board) or bool(whole)


def _spacing(grid: Float[np.ndarray, "r c 2"]) -> float:
    """The mean step of a pattern along its denser direction, in px."""
    steps = [np.hypot(*(part[1:] - part[:-1]).reshape(-1, 2).T) for part in (grid, grid.swapaxes(0, 1))]
    known = [step[np.isfinite(step)] for step in steps]
    return min((float(step.mean()) for step in known if len(step)), default=0.0)


def _area(grid: Float[np.ndarray, "r c 2"]) -> float:
    """The area in px of the box around a pattern."""
    width, height = np.nanmax(grid, axis=(0, 1)) - np.nanmin(grid, axis=(0, 1))
    return float(width * height)


def _shadows(other: Float[np.ndarray, "_r _c 2"], one: Float[np.ndarray, "_R _C 2"]) -> bool:
    """Whether another board is in the same place, or so much larger that the one is likely a grille or a print."""
    if _area(other) > 16 * _area(one):
        return True
    middle = np.nanmean(one, axis=(0, 1))
    return bool((middle > np.nanmin(other, axis=(0, 1))).all() and (middle < np.nanmax(other, axis=(0, 1))).all())


def _further_patterns(
    first: UInt8[np.ndarray, "h w"], image: UInt8[np.ndarray, "H W"]
) -> Iterator[list[Float[np.ndarray, "_r _c 2"]]]:
    """The patterns in a quarter of the first copy, then in larger ones by steps of 2."""
    yield _patterns(_resized(first, 0.25), image)
    longest = max(image.shape)
    factor = 2 * FIRST / longest
    while factor < 2 and longest > FIRST:
        yield _patterns(_resized(image, min(1.0, factor)), image)
        factor *= 2
    if longest <= FIRST:
        yield _patterns(_resized(image, 2.0), image)


def _resized(image: UInt8[np.ndarray, "h w"], factor: float) -> UInt8[np.ndarray, "_h _w"]:
    if factor == 1:
        return image
    height, width = (max(1, round(side * factor)) for side in image.shape)
    kind = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=kind)


def _carried(
    grid: Float[np.ndarray, "rows columns 2"], small: UInt8[np.ndarray, "h w"], image: UInt8[np.ndarray, "H W"]
) -> Float[np.ndarray, "rows columns 2"]:
    """Corners of a copy in px of the image: edges map to edges, and pixel centres are at whole numbers."""
    scale = np.array(image.shape[::-1]) / small.shape[::-1]
    return (grid + 0.5) * scale - 0.5


def _by_opencv(
    image: UInt8[np.ndarray, "h w"], partial: Float[np.ndarray, "r c 2"], board: Chessboard
) -> Float[np.ndarray, "rows columns 2"] | None:
    """What OpenCV's detectors find around a part of a pattern, as it is and with dark and light exchanged."""
    low, high = np.nanmin(partial, axis=(0, 1)), np.nanmax(partial, axis=(0, 1))
    start = np.maximum(low - (high - low), 0).astype(int)
    stop = np.minimum(high + (high - low), image.shape[::-1]).astype(int)
    crop = image[start[1] : stop[1], start[0] : stop[0]]
    small = _resized(crop, min(1.0, FIRST / max(crop.shape)))
    for shown in (small, 255 - small):
        found, corners = cv2.findChessboardCorners(shown, board.size)
        if found:
            break
    else:
        found, corners = cv2.findChessboardCornersSB(small, board.size, flags=_ACCURATE)
    if not found:
        return None
    # OpenCV 4 gives (N, 1, 2), OpenCV 5 (N, 2).
    return _carried(corners.reshape(board.rows, board.columns, 2).astype(np.float64), small, crop) + start
