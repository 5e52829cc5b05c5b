"""The extent of a lens's domain: the first radius at which a required property fails.

The radius is bracketed on a grid that spans all scales, then on finer grids in the bracketing cell, until it is known
to rounding. The lower end of the last cell is returned, where the property was found to hold.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

UNIFORM_END = 4.0
"""End of the grid's uniform part, in units of the lens's length scale; from there on it is geometric."""
GRID_END = 1e6
"""End of the grid, in the same unit, at least: beyond, the term of highest order dominates."""
UNIFORM_NODES, GEOMETRIC_NODES = 192, 192
CELL_NODES, ROUNDS = 128, 6
"""Nodes of the finer grids, and the number of grids in all."""

Property = Callable[[Any, int], Any]


def library_of(values: Any) -> Any:
    """The library that an array or tensor is of. What is written in words of both runs in NumPy on a CPU.

    Of the few hundred radii of one lens NumPy's steps take a third of the time of PyTorch's.
    """
    return torch if isinstance(values, Tensor) else np


def even_steps(count: int, like: Any) -> Any:
    """`1 / count`, `2 / count`, ... to 1, as an array or as a tensor like another."""
    if isinstance(like, Tensor):
        return torch.arange(1, count + 1, dtype=like.dtype, device=like.device) / count
    return np.arange(1, count + 1) / count


def radius_grid(scale: Any, last: Any) -> Any:
    """Radii `(*B, M)` from nearly 0 to `GRID_END` times the length scale `(*B,)`, or to `last` if that is more."""
    library = library_of(scale)
    near = UNIFORM_END * even_steps(UNIFORM_NODES, scale)
    end = (last / scale).clip(GRID_END)[..., None]
    far = UNIFORM_END * (end / UNIFORM_END) ** even_steps(GEOMETRIC_NODES, scale)
    return scale[..., None] * library.concatenate((near + library.zeros_like(end), far), -1)


def first_failure(
    holds: Property, grid: Any, *, nodes: int = CELL_NODES, rounds: int = ROUNDS, needed: Any = None
) -> tuple[Any, Any]:
    """Find the largest radius up to which a property holds, coarse to fine. Arrays, or tensors.

    Args:
        holds: takes radii `(*B, M)` and the number of the round, and returns where the property holds. It is assumed
            to hold at radius 0.
        grid: the radii of round 0, `(*B, M)`, ascending.
        nodes: radii per cell in the following rounds.
        rounds: number of rounds, the first included.
        needed: radii `(*B,)` with which the result will be compared: no more rounds are run than that takes.

    Returns:
        The last radius at which the property holds `(*B,)`, and whether it fails anywhere on the grid `(*B,)`.
    """
    library, short = library_of(grid), 1 - even_steps(nodes, grid)
    low, high, failed = _first_bad_cell(library, holds(grid, 0), grid, library.zeros_like(grid[..., 0]))
    for number in range(1, rounds):
        below = (2 * low - high).clip(0)  # the finer grid may find an earlier failure
        if needed is not None and bool((~failed | (below >= needed) | (high < needed)).all()):
            break
        radii = high[..., None] - (high - below)[..., None] * short
        low, high, _ = _first_bad_cell(library, holds(radii, number), radii, below)
    return low, failed


def _first_bad_cell(library: Any, good: Any, radii: Any, start: Any) -> tuple[Any, Any, Any]:
    """The ends of the first cell whose upper end fails (the last cell if none does), and whether any does."""
    bad = ~good
    failed = bad.any(-1)
    index = library.where(failed, (bad * 1).argmax(-1), radii.shape[-1] - 1)[..., None]
    edges = library.concatenate((start[..., None], radii), -1)
    if library is np and index.ndim == 1:  # of one lens, in a third of the time
        return edges[index[0]], edges[index[0] + 1], failed
    take = np.take_along_axis if library is np else torch.take_along_dim
    low, high = take(edges, index, -1), take(edges, index + 1, -1)
    return low[..., 0], high[..., 0], failed
