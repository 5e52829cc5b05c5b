"""How a distorted point follows the direction that it belongs to, for every lens and for none."""

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.protocol import Lens


def by_direction(lens: Lens | None, direction: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*out n 2 3"]:
    """Derivatives of the distorted points by valid directions `(*B, N, 3)`: `(*B, N, 2, 3)`.

    In closed form for the lenses of this package, in reverse mode for others: forward mode has one state for the whole
    process, and two threads that use it get in each other's way.
    """
    if isinstance(lens, CoefficientLens):
        return lens.by_direction(direction)
    if lens is not None:
        xy, pull = torch.func.vjp(lambda direction: lens.project_direction(direction)[0], direction)[:2]
        x, y = torch.zeros_like(xy), torch.zeros_like(xy)
        x[..., 0], y[..., 1] = 1.0, 1.0
        return torch.stack([pull(x)[0], pull(y)[0]], dim=-2)
    x, y, z = direction.unbind(-1)
    inverse, zero = 1 / z, torch.zeros_like(z)
    rows = [torch.stack([inverse, zero, -x / z * inverse], -1), torch.stack([zero, inverse, -y / z * inverse], -1)]
    return torch.stack(rows, dim=-2)
