"""The extent of a lens's domain: the first radius at which a required property fails.

The radius is bracketed on a grid that spans all scales, then on finer grids in the bracketing cell, until it is known
to rounding. The lower end of the last cell is returned, where the property was found to hold.
"""

from collections.abc import Callable

import torch
from torch import Tensor

UNIFORM_END = 4.0
"""End of the grid's uniform part, in units of the lens's length scale; from there on it is geometric."""
GRID_END = 1e6
"""End of the grid, in the same unit, at least: beyond, the term of highest order dominates."""
UNIFORM_NODES, GEOMETRIC_NODES = 192, 192
CELL_NODES, ROUNDS = 128, 6
"""Nodes of the finer grids, and the number of grids in all."""

Property = Callable[[Tensor, int], Tensor]


def radius_grid(scale: Tensor, last: Tensor) -> Tensor:
    """Radii `(*B, M)` from nearly 0 to `GRID_END` times the length scale `(*B,)`, or to `last` if that is more."""
    near = torch.linspace(
        UNIFORM_END / UNIFORM_NODES, UNIFORM_END, UNIFORM_NODES, dtype=scale.dtype, device=scale.device
    )
    far = torch.linspace(0, 1, GEOMETRIC_NODES + 1, dtype=scale.dtype, device=scale.device)[1:]
    end = (last / scale).clamp_min(GRID_END).unsqueeze(-1)
    far = UNIFORM_END * (end / UNIFORM_END) ** far
    return scale.unsqueeze(-1) * torch.cat([near.expand(*far.shape[:-1], UNIFORM_NODES), far], dim=-1)


def first_failure(
    holds: Property, grid: Tensor, *, nodes: int = CELL_NODES, rounds: int = ROUNDS
) -> tuple[Tensor, Tensor]:
    """Find the largest radius up to which a property holds, coarse to fine.

    Args:
        holds: takes radii `(*B, M)` and the number of the round, and returns where the property holds. It is assumed
            to hold at radius 0.
        grid: the radii of round 0, `(*B, M)`, ascending.
        nodes: radii per cell in the following rounds.
        rounds: number of rounds, the first included.

    Returns:
        The last radius at which the property holds `(*B,)`, and whether it fails anywhere on the grid `(*B,)`.
    """
    fractions = torch.linspace(0, 1, nodes + 1, dtype=grid.dtype, device=grid.device)[1:]
    low, high, failed = _first_bad_cell(holds(grid, 0), grid, torch.zeros_like(grid[..., 0]))
    for number in range(1, rounds):
        below = (2 * low - high).clamp_min(0)  # the finer grid may find an earlier failure
        radii = torch.lerp(below.unsqueeze(-1), high.unsqueeze(-1), fractions)
        low, high, _ = _first_bad_cell(holds(radii, number), radii, below)
    return low, failed


def _first_bad_cell(good: Tensor, radii: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The ends of the first cell whose upper end fails (the last cell if none does), and whether any does."""
    last = radii.shape[-1] - 1
    bad = ~good
    failed = bad.any(-1)
    index = torch.where(failed, bad.to(torch.uint8).argmax(-1), last).unsqueeze(-1)
    edges = torch.cat([start.unsqueeze(-1), radii], dim=-1)
    return edges.gather(-1, index).squeeze(-1), edges.gather(-1, index + 1).squeeze(-1), failed
