"""Intervals of measured quantities that follow the curve from pixels to the plane, and know that no length is negative.

A bound of a quantity is its value after the step of all errors together that changes it most, of as many standard
deviations as the level takes. For a linear map that is `value -+ reach * deviation`; for one that is bent but monotone,
as the distance to a point near the horizon, it is the bound that the pixels tell. Where the step leaves the plane, there is
no bound on that side.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from diffproj.measurement import folded
from diffproj.measurement.propagation import Propagated
from diffproj.measurement.shapes import length
from diffproj.measurement.student import normal_reach


@torch.no_grad()
def curved_interval(
    spread: Propagated,
    function: Callable[[Tensor], Tensor],
    value: Tensor,
    lost: Tensor,
    kink: Tensor,
    level: float,
    reach: Tensor,
) -> tuple[Tensor, Tensor]:
    """Bounds of a function of points with value `(*B, M)`; `kink` is the standard deviation that its slope lacks."""
    one = torch.ones_like(value).unsqueeze(-1)
    low, high = value, value
    for side in (-1, 1):
        points, valid = spread.moved(one, side * reach)
        there = torch.func.vmap(function)(points.flatten(0, -3)).reshape(value.shape)
        there = torch.where(valid, there, side * torch.inf)
        low, high = torch.minimum(low, there), torch.maximum(high, there)
    return torch.where(lost, -torch.inf, low - reach * kink), torch.where(lost, torch.inf, high + reach * kink)


@torch.no_grad()
def norm_interval(
    spread: Propagated,
    function: Callable[[Tensor], tuple[Tensor, Tensor]],
    vector: Tensor,
    supplement: Tensor,
    lost: Tensor,
    limit: float,
    level: float,
    reach: Tensor,
) -> tuple[Tensor, Tensor]:
    """Bounds of the length of a vector `(*B, M, 3)`, or of what it lacks to the limit, where it is the supplement.

    Both ways along the vector the step on the curve tells how large a deviation is there; with that deviation the bounds
    are those of `folded`.
    """
    z = normal_reach(level)
    w, C, r = vector.detach(), spread.covariance.detach(), length(vector.detach())
    largest, longest = folded.longest_first(C)
    tiny = r <= 1e-9 * largest.sqrt()
    u = torch.where(tiny.unsqueeze(-1), longest, w / torch.where(tiny, 1.0, r).unsqueeze(-1))
    Cu = (C @ u.unsqueeze(-1)).squeeze(-1)
    along = (u * Cu).sum(-1).clamp(min=0)
    across = (C.diagonal(dim1=-2, dim2=-1).sum(-1) - along).clamp(min=0)
    cross = (Cu - along.unsqueeze(-1) * u).square().sum(-1)
    s = along.sqrt()

    def scale(side: int) -> Tensor:
        """The deviation on that side over the one at the measured place; infinite where the step leaves the plane."""
        points, valid = spread.moved(u, side * reach)
        there, turned = torch.func.vmap(function)(points.flatten(0, -3))
        there, turned = there.reshape(w.shape), turned.reshape(r.shape) ^ supplement
        size = length(there)
        there = there * torch.where(turned, limit / torch.where(size > 0, size, 1.0) - 1, 1.0).unsqueeze(-1)
        step = side * ((u * there).sum(-1) - r)
        plain = torch.where(s > 0, (step / torch.where(s > 0, z * s, 1.0)).clamp(min=0), reach / z)
        return torch.where(valid, plain, torch.inf)

    down, up = scale(-1), scale(1)
    q = torch.where(down.isfinite(), down, 1.0).square()
    low = folded.lower_bound(r, along * q, across * q, cross * q.square(), largest * q, level, z)
    q = torch.where(up.isfinite(), up, 1.0).square()
    high = folded.upper_bound(w, C * q[..., None, None], largest * q, longest, z)
    low = torch.where(lost | down.isinf(), 0.0, low)
    high = torch.where(lost | up.isinf(), torch.inf, high)
    return torch.where(supplement, limit - high, low).clamp(min=0), torch.where(supplement, limit - low, high).clamp(
        max=limit
    )
