"""Lattices of saddle points: chessboard patterns, whole or in part, bent by any lens."""

from collections import deque
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from diffproj.targets.saddles import Saddles

NEAREST = 10
"""Neighbours among which a point's partners on the pattern are sought."""

REACH = 0.35
"""Greatest distance of a point from where its row goes on, relative to the step along the row."""

OPPOSITE = -0.5
"""Greatest cosine between the phases of neighbours on a pattern."""

KEPT = 0.75
"""Share of a sheared pattern's points that it must have along its columns, too: what stood there by chance may go."""

SMALLEST = 9
"""Points of the smallest pattern worth looking at."""

Cell = tuple[int, int]


def lattices(saddles: Saddles) -> Iterator[dict[Cell, int]]:
    """Patterns among saddle points, one after the other, as points' numbers by row and column.

    A pattern starts at a point that stands midway between two others of opposite phase in two directions. It grows
    cell by cell to the point nearest to where its row goes on: steps along a row keep their direction and the ratio of
    their lengths, which perspective and lens change slowly. Where it turns out sheared, as it may from a point at its
    edge, it grows once more along its columns.
    """
    count = len(saddles.points)
    if count < SMALLEST:
        return
    near, opposite = _neighbours(saddles)
    points = (saddles.points[:, 0] + 1j * saddles.points[:, 1]).tolist()
    rows = zip(near.tolist(), opposite.tolist(), strict=True)
    partners = [[q for q, fits in zip(*row, strict=True) if fits] for row in rows]
    used: set[int] = set()
    for seed, axes in _seeds(points, partners, used):
        found = _grown(seed, axes, points, partners, used)
        upright = _upright(found, axes)
        if upright != axes:
            again = _grown(seed, upright, points, partners, used)
            found = again if len(again) >= KEPT * len(found) else found
        if len(found) >= SMALLEST:
            used.update(found.values())
            yield found


def _neighbours(saddles: Saddles) -> tuple[Int[np.ndarray, "n k"], Bool[np.ndarray, "n k"]]:
    """The nearest points of each, nearest first, and which of them have the opposite phase at a like contrast."""
    points, phases = saddles
    square = (points**2).sum(axis=1)
    distance = square[:, None] + square[None] - 2 * points @ points.T
    np.fill_diagonal(distance, np.inf)
    count = min(NEAREST, len(points) - 1)
    near = np.argpartition(distance, count - 1, axis=1)[:, :count]
    near = np.take_along_axis(near, np.take_along_axis(distance, near, axis=1).argsort(axis=1), axis=1)
    size = np.linalg.norm(phases, axis=1)
    cosine = (phases[:, None] * phases[near]).sum(axis=-1) / np.maximum(size[:, None] * size[near], 1e-9)
    ratio = size[near] / np.maximum(size[:, None], 1e-9)
    return near, (cosine < OPPOSITE) & (ratio > 0.3) & (ratio < 1 / 0.3)


def _seeds(
    points: list[complex], partners: list[list[int]], used: set[int]
) -> Iterator[tuple[int, tuple[complex, complex]]]:
    """Points midway between partners in two directions, and the steps along these; none of those in use by then."""
    for seed, others in enumerate(partners):
        if seed in used:
            continue
        here = points[seed]
        ways = [(there := points[q] - here, 0.25 * abs(there)) for q in others]
        steps: list[complex] = []
        for k, (there, most) in enumerate(ways):
            for back, least in ways[k + 1 :]:
                off = abs(there + back)
                if off < most and off < least:
                    steps.append((there - back) / 2)
        for k, first in enumerate(steps):
            across = [s for s in steps[k + 1 :] if abs((first.conjugate() * s).imag) > 0.3 * abs(first) * abs(s)]
            if across:
                yield seed, (first, across[0])
                break


def _grown(
    seed: int, axes: tuple[complex, complex], points: list[complex], partners: list[list[int]], used: set[int]
) -> dict[Cell, int]:
    """The pattern that grows from a seed: numbers of points by (row, column)."""
    cells: dict[Cell, int] = {(0, 0): seed}
    taken = {seed}
    waiting = deque([(0, 0)])
    directions = {(0, 1): axes[0], (0, -1): -axes[0], (1, 0): axes[1], (-1, 0): -axes[1]}
    while waiting:
        i, j = waiting.popleft()
        here = points[cells[i, j]]
        for (di, dj), start in directions.items():
            cell = (i + di, j + dj)
            if cell in cells:
                continue
            step = _step(cells, points, (i, j), (di, dj)) or start
            want, reach = here + step, REACH * abs(step)
            best = None
            for q in partners[cells[i, j]]:
                if (off := abs(points[q] - want)) < reach and q not in taken and q not in used:
                    best, reach = q, off
            if best is not None:
                cells[cell] = best
                taken.add(best)
                waiting.append(cell)
    return cells


def _upright(cells: dict[Cell, int], axes: tuple[complex, complex]) -> tuple[complex, complex]:
    """The steps along rows and columns, or shorter ones along which a pattern fills less of a rectangle.

    At its edge, a board has no corner on one side. Then one far aside may stand, by chance, where it makes a pair with
    one of the next row but two columns on: the same corners, numbered along rows that slant.
    """
    where = np.array(list(cells))
    row, column = where.T
    best, least = axes, _box(row, column)
    for two in (-2, 2):
        for shorter, size in (
            ((axes[0], axes[1] + two * axes[0]), _box(row, column - two * row)),
            ((axes[0] + two * axes[1], axes[1]), _box(row - two * column, column)),
        ):
            if size < least and abs(shorter[0]) + abs(shorter[1]) < abs(axes[0]) + abs(axes[1]):
                best, least = shorter, size
    return best


def _box(row: Int[np.ndarray, " n"], column: Int[np.ndarray, " n"]) -> int:
    """How many cells the rectangle around these has."""
    return int((np.ptp(row) + 1) * (np.ptp(column) + 1))


def _step(cells: dict[Cell, int], points: list[complex], cell: Cell, direction: Cell) -> complex | None:
    """The next step along a row or column, from the steps before it, or from the rows beside it."""
    (i, j), (di, dj) = cell, direction
    here, before = cells[cell], cells.get((i - di, j - dj))
    if before is not None:
        step = points[here] - points[before]
        earlier = cells.get((i - 2 * di, j - 2 * dj))
        if earlier is not None:
            step *= min(1.5, max(0.6, abs(step) / abs(points[before] - points[earlier])))
        return step
    for side in (-1, 1):
        beside, ahead = (i + side * dj, j + side * di), (i + side * dj + di, j + side * di + dj)
        if beside in cells and ahead in cells:
            return points[cells[ahead]] - points[cells[beside]]
    return None


def as_grid(cells: dict[Cell, int], points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "rows columns 2"]:
    """A pattern's points by row and column, NaN where a cell is empty."""
    where = np.array(list(cells))
    where -= where.min(axis=0)
    grid = np.full((*(where.max(axis=0) + 1), 2), np.nan)
    grid[where[:, 0], where[:, 1]] = points[list(cells.values())]
    return grid
