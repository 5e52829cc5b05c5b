"""How far a lens reaches: the first radius at which a property that must hold stops holding.

A radius is searched on a grid that spans all scales, then in the cell that the grid found, then in the cell of that
cell, until the answer is known to rounding. The lower end of the last cell is returned: there the property was seen
to hold.
"""

from collections.abc import Callable

import torch
from torch import Tensor

NEAR = 4.0
"""The grid is uniform up to this many times the lens's own scale, and geometric from there on."""
FAR = 1e6
"""At this many times its own scale the term of highest order alone decides what a lens does."""
NEAR_NODES, FAR_NODES = 192, 192
CELL_NODES, ROUNDS = 128, 6

Sound = Callable[[Tensor, int], Tensor]


def radius_grid(like: Tensor) -> Tensor:
    """Radii from nearly 0 to `FAR` in units of the lens's own scale."""
    near = torch.linspace(NEAR / NEAR_NODES, NEAR, NEAR_NODES, dtype=like.dtype, device=like.device)
    far = torch.linspace(0, 1, FAR_NODES + 1, dtype=like.dtype, device=like.device)[1:]
    return torch.cat([near, NEAR * (FAR / NEAR) ** far])


def first_failure(
    sound: Sound, grid: Tensor, *, nodes: int = CELL_NODES, rounds: int = ROUNDS
) -> tuple[Tensor, Tensor]:
    """Search the largest radius up to which `sound` holds, coarse to fine.

    Args:
        sound: takes radii `(*B, M)` and the number of the round, tells for each of them whether the property holds.
            It is taken to hold at radius 0.
        grid: the radii to begin with, `(*B, M)`, ascending.
        nodes: how many radii to look at in a cell.
        rounds: how often to look closer.

    Returns:
        The last radius known to be sound `(*B,)`, and whether any radius of the grid was unsound `(*B,)`.
    """
    fractions = torch.linspace(0, 1, nodes + 1, dtype=grid.dtype, device=grid.device)[1:]
    low, high, failed = _first_bad_cell(sound(grid, 0), grid, torch.zeros_like(grid[..., 0]))
    for number in range(1, rounds):
        below = (2 * low - high).clamp_min(0)  # a finer look may find fault with what looked sound
        radii = torch.lerp(below.unsqueeze(-1), high.unsqueeze(-1), fractions)
        low, high, _ = _first_bad_cell(sound(radii, number), radii, below)
    return low, failed


def _first_bad_cell(good: Tensor, radii: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The ends of the first cell whose upper end is bad; the last cell where none is."""
    last = radii.shape[-1] - 1
    bad = ~good
    failed = bad.any(-1)
    index = torch.where(failed, bad.to(torch.uint8).argmax(-1), last).unsqueeze(-1)
    edges = torch.cat([start.unsqueeze(-1), radii], dim=-1)
    return edges.gather(-1, index).squeeze(-1), edges.gather(-1, index + 1).squeeze(-1), failed
