"""Initial estimate for Newton's method: a small table of the inverse along the radius, so that few steps suffice.

Along a ray from the centre let `rho = f(r)` be the distorted radius and `rho_max = f(r_max)` that at the edge. At a
fold the inverse has a square root, `r_max - r ~ sqrt(rho_max - rho)`. As a function of

    u = sqrt(1 - rho / rho_max)

it is smooth up to the edge, so that linear interpolation between a few uniform nodes in `u` is accurate enough. The
table holds `r / rho` averaged over all rays, which is smooth at the centre too. Tangential and prism terms make
`rho_max` vary with the cosine and sine of the ray's direction (`sway`); the ratio is corrected by the same variation,
the more the closer to the edge.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

NODES = 64
"""Nodes of the table."""
SAMPLES = 96
"""Samples of the forward profile from which it is built."""


class InverseTable(NamedTuple):
    """A tabulated inverse.

    Attributes:
        rho_max: `(*B, 3)`, the distorted radius at which the table ends: mean, cosine part, sine part.
        ratio: `(*B, NODES)`, `r / rho` of the mean at uniform nodes in `u`.
    """

    rho_max: Tensor
    ratio: Tensor

    def ratio_at(self, x: Tensor, y: Tensor, rho: Tensor) -> Tensor:
        """`r / rho` for distorted points `(*B, N)` of radius `rho`; beyond the table's end, that at its end."""
        mean, cosine, sine = self.rho_max.unsqueeze(-2).unbind(-1)
        tiny = torch.full_like(mean, torch.finfo(rho.dtype).tiny)
        along_mean = torch.addcmul(tiny, rho, mean)
        along_ray = torch.addcmul(torch.addcmul(along_mean, x, cosine), y, sine)
        out = rho * rho / along_ray
        if torch.compiler.is_exporting():  # of operations that ONNX has
            position = torch.where(out < 1, 1 - out, 0.0).clamp_max(1).sqrt() * (NODES - 1)
        else:
            position = torch.fmax(1 - out, torch.zeros_like(mean)).clamp_max_(1).sqrt_().mul_(NODES - 1)  # 0 for NaN
        index = position.long()
        ratio = _interpolated(self.ratio, index, position - index)
        return torch.addcmul(ratio, ratio * out, along_mean / along_ray - 1)


def _interpolated(nodes: Tensor, index: Tensor, fraction: Tensor) -> Tensor:
    slope = torch.nn.functional.pad(nodes.diff(dim=-1), (0, 1))
    if nodes.ndim == 1:
        return torch.addcmul(nodes[index], fraction, slope[index])
    shape = (*index.shape[:-1], NODES)
    return torch.addcmul(nodes.expand(shape).gather(-1, index), fraction, slope.expand(shape).gather(-1, index))


def inverse_table(profile: Callable[[Tensor], Tensor], radius: Tensor, sway: Tensor) -> InverseTable:
    """Tabulate the inverse of a radial profile with slope 1 at the centre.

    Args:
        profile: maps radii `(*B, n)` to distorted radii, averaged over all rays.
        radius: the finite radius at which the table ends `(*B,)`; the profile must increase up to it.
        sway: cosine and sine coefficients of the distorted radius at the end, `(*B, 2)`.

    Returns:
        The table.
    """
    t = torch.linspace(0, 1, SAMPLES, dtype=radius.dtype, device=radius.device)
    nodes = torch.linspace(0, 1, NODES, dtype=radius.dtype, device=radius.device)
    radius = radius.unsqueeze(-1)
    rho = profile(radius * (1 - t * t))
    rho_max = rho[..., :1]
    u = (1 - rho / rho_max).clamp(0, 1).sqrt()
    right = (u.unsqueeze(-2) < nodes.unsqueeze(-1)).sum(-1).clamp(1, SAMPLES - 1)
    u0, u1 = u.gather(-1, right - 1), u.gather(-1, right)
    t_node = torch.lerp(t[right - 1], t[right], ((nodes - u0) / (u1 - u0)).clamp(0, 1))
    ratio = radius * (1 - t_node**2) / (rho_max * (1 - nodes**2))
    at_centre = torch.arange(NODES, device=radius.device) == NODES - 1
    ratio = torch.where(at_centre | ~ratio.isfinite(), 1, ratio)
    return InverseTable(torch.cat([rho_max, sway], dim=-1), ratio)
