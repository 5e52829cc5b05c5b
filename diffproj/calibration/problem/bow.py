"""A board that is a little bent: the paraboloid of two parameters that stands for it.

`z = bow_x (1 - xi^2) + bow_y (1 - eta^2)`, with xi and eta from -1 to 1 over the board's extent along x and y: the bows
are what the board's centre stands off its edges, in world units.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def bow_shape(points: Float[Tensor, "n 3"]) -> Float[Tensor, "2 n"]:
    """`1 - xi^2` and `1 - eta^2` at the board's points."""
    along = points[:, :2].mT
    low, high = along.amin(-1, keepdim=True), along.amax(-1, keepdim=True)
    half = (high - low).clamp(min=torch.finfo(points.dtype).tiny) / 2
    return 1 - ((along - (low + high) / 2) / half).square()


def bow_deviation(points: Float[Tensor, "n 3"], bow: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch n 3"]:
    """Standard deviations of the points' coordinates, for a bow with this covariance."""
    shape = bow_shape(points)
    z = (shape * (bow @ shape)).sum(-2).clamp(min=0).sqrt()
    return torch.nn.functional.pad(z.unsqueeze(-1), (2, 0))


def bowed(points: Float[Tensor, "n 3"], bow: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch n 3"]:
    """The points of a flat board `(N, 3)` as its bow `(*B, 2)` lifts them."""
    z = (bow.unsqueeze(-1) * bow_shape(points)).sum(-2)
    return points + torch.nn.functional.pad(z.unsqueeze(-1), (2, 0))
