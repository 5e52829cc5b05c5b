"""Find a target in one photograph: each kind of target by its own detector."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from diffproj.targets.april_grid import AprilGrid
from diffproj.targets.boards import Board, with_article
from diffproj.targets.charuco import CharucoBoard, with_other_start
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.circle_grid import CircleGrid
from diffproj.targets.circles import find_circles
from diffproj.targets.corners import refine_grid
from diffproj.targets.exif import Exif
from diffproj.targets.images import as_8_bit
from diffproj.targets.marked import find_marked, not_found
from diffproj.targets.numbering import in_order
from diffproj.targets.repeated import Taken, covered
from diffproj.targets.search import find_pattern

ENDS = 2
"""Corners at the end of a ChArUco board that only its own pattern has from which no other is thought of. Of 90 views of
the other pattern none showed one."""

OTHER_SPACING = 0.08
"""How far the gaps between tags may be from what was given, relative to it. Of 2900 simulated views with a noise of
0.15 px, most of them close up through wide lenses, 98.6 % were within it; nearly all others were of boards of two to
nine tags at the edges of a barrel lens."""

OTHER_DIAMETER, EDGES = 0.2, 2.0
"""How far circles' diameters may be from what was given, relative to them and in px: by both, they are others. Of 740
images, blurred by 2 px, over-exposed, and with a gamma of .45 or 2.2 among them, those of more than 6 px were within
18 %, and smaller ones within 1.8 px."""

REMEDY = "give the diameter, not the radius, as it is on the print, in the unit of spacing"
"""What to do where they are others."""


class Found(NamedTuple):
    """What was found in one photograph.

    Attributes:
        grid: `(rows, columns, 2)` px, in order, NaN where hidden; None where there is no such board.
        seen: `(columns, rows)` of the largest pattern where there is no such chessboard; (0, 0) for none.
        hint: what is there instead of another board, and what to give then; empty for nothing.
        size: `(width, height)` of the photograph, which who reads it fills in.
        beside: what else was made of the photograph.
        again: whether the board is seen elsewhere in it as well; the larger one was taken.
        exif: what its file tells beside the pixels, which who reads it fills in.
    """

    grid: Float[np.ndarray, "rows columns 2"] | None
    seen: tuple[int, int] = (0, 0)
    hint: str = ""
    size: tuple[int, int] = (0, 0)
    beside: object = None
    again: bool = False
    exif: Exif | None = None


def find(image: Shaped[np.ndarray, "h w"], target: Board) -> Found:
    """Find the target in a grey image from 0 to 255, uint8 or float32."""
    found = _found(image, target)
    known = found.grid is not None or found.hint or not isinstance(target, CharucoBoard | AprilGrid)
    if known or target.rows == target.columns:  # the others look alike lying on their side
        return found
    exchanged = replace(target, columns=target.rows, rows=target.columns)
    other = _found(image, exchanged)
    if other.grid is None and not other.hint:
        return found
    besides = f", {other.hint.removeprefix('one ')}" if other.hint else ""
    return found._replace(hint=f"{with_article(exchanged)}, columns first{besides}")


def _found(image: Shaped[np.ndarray, "h w"], target: Board) -> Found:
    if isinstance(target, Chessboard):
        return _chessboard(image, target)
    if isinstance(target, AprilGrid):
        return _april_grid(image, target)
    if isinstance(target, CircleGrid):
        return _circle_grid(image, target)
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
    return Found(in_order(refined.grid, refined.begins_dark, board), board.size, again=len(boards) > 1)


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
    """The gaps between tags relative to their sides: the median over neighbours; NaN where no pair is seen.

    By the cross-ratio of the four corners of two tags along a line, which no perspective changes: with the gap s,
    `(1 + s)^2 / ((1 + s)^2 - 1)`.
    """
    found = []
    for lines in (grid, grid.swapaxes(0, 1)):
        a, b, c, d = (lines[:, k : lines.shape[1] - 3 + k : 2] for k in range(4))
        ac, bd, bc, ad = (np.linalg.norm(one - other, axis=-1) for one, other in ((a, c), (b, d), (b, c), (a, d)))
        ratio = (ac * bd / (bc * ad)).ravel()
        ratio = ratio[ratio > 1]  # not where one is hidden: NaN
        found.append(np.sqrt(ratio / (ratio - 1)) - 1)
    known = np.concatenate(found)
    return float(np.median(known)) if len(known) else float("nan")


def _circle_grid(image: Shaped[np.ndarray, "h w"], board: CircleGrid) -> Found:
    circles = find_circles(image, as_8_bit(image), board)
    if circles is None:
        return Found(None)
    # Circles are found whatever their diameter is said to be. Light, blur and ink move their edges: the limit is wide.
    off = abs(circles.diameter - board.diameter) / circles.diameter
    if off > OTHER_DIAMETER and off * circles.diameter_px > EDGES:
        seen, given = (f"{value:.3g}" for value in (circles.diameter, board.diameter))
        return Found(None, hint=f"one whose circles are about {seen} across where they should be {given}: {REMEDY}")
    return Found(circles.taken.points.reshape(*board.shape, 2), again=circles.taken.again)


def _charuco(image: Shaped[np.ndarray, "h w"], board: CharucoBoard) -> Found:
    grey = as_8_bit(image)
    taken, other = find_marked(image, grey, board), with_other_start(board)
    found = Found(None) if taken is None else Found(taken.points.reshape(*board.shape, 2), again=taken.again)
    if other is None or (taken is not None and board.columns % 2 == 0):
        return found
    # With an odd number of columns, either pattern is the other one square further on, but for the end that is its own.
    own = _at_its_own_end(taken, board)
    if own >= ENDS:
        return found
    others = find_marked(image, grey, other)
    if others is None:
        return found
    kind = "legacy" if other.legacy else "ordinary"
    if taken is None or own < _at_its_own_end(others, other):
        return Found(None, hint=f"one of the {kind} pattern: give legacy={other.legacy}")
    # Where its own end is not in view, it is the pattern that was asked for. Where it should be, and is not, who knows?
    if own > _at_its_own_end(others, other) or not not_found(image, board, taken.points, _own_end(board)):
        return found
    return Found(
        None,
        hint=f"one that may as well be of the {kind} pattern: show the ends of its rows, or give legacy={other.legacy}",
    )


def _own_end(board: CharucoBoard) -> Bool[np.ndarray, " n"]:
    """The corners of the column that the other pattern, laid upon this one so that most markers agree, does not have.

    The first column of an ordinary board, the last of a legacy one: there the other board has its border.
    """
    own = np.zeros(board.shape, dtype=bool)
    own[:, -1 if board.legacy else 0] = True
    return own.reshape(-1)


def _at_its_own_end(taken: Taken | None, board: CharucoBoard) -> int:
    """How many corners were found there."""
    return 0 if taken is None else int(np.isfinite(taken.points[_own_end(board), 0]).sum())
