"""The region of the image that a calibration's corners covered: outside of it a lens model extrapolates.

It is the convex hull of all used corners, grown by about half a square, as its reach in each of 64 directions: pixel p
lies inside where `u_k . p <= reach_k` for all unit vectors `u_k`. (The polygon with these sides is larger than the hull
by 0.1 % of its radius at most.) A few numbers a camera, whatever the number of views.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

DIRECTIONS = 64
"""In how many directions the reach is told."""

BLOCK = 2**16
"""How many pixels are looked at at once."""


def covered_region(
    pixels: Float[Tensor, "*batch v n 2"], used: Bool[Tensor, "*batch v n"]
) -> Float[Tensor, "*batch directions"]:
    """How far the used corners reach in each direction, in px `(*B, 64)`; minus infinity where none was used."""
    pixels = torch.where(used.unsqueeze(-1), pixels.detach(), torch.nan)
    u, v = pixels.flatten(-3, -2).unbind(-1)
    unused = u.isnan()
    u, v = u.nan_to_num(0.0), torch.where(unused, 0.0, v)
    beside = torch.where(unused, -torch.inf, 0.0).to(u)
    reach = [(x * u + y * v + beside).amax(-1) for x, y in _directions(pixels).tolist()]  # bit by bit: it fits a cache
    return torch.stack(reach, dim=-1) + _square(pixels).unsqueeze(-1) / 2


def in_region(
    pixels: Float[Tensor, "*#batch n 2"], reach: Float[Tensor, "*#batch directions"]
) -> Bool[Tensor, "*batch n"]:
    """Which pixels `(*B, N, 2)` lie in a region; none that is not finite does."""
    normals = _directions(pixels).to(pixels).mT
    parts = [(part @ normals <= reach.unsqueeze(-2)).all(-1) for part in pixels.detach().split(BLOCK, dim=-2)]
    return torch.cat(parts, dim=-1)


def _directions(like: Tensor) -> Tensor:
    angle = torch.arange(DIRECTIONS, dtype=torch.float64, device=like.device) * (2 * torch.pi / DIRECTIONS)
    return torch.stack([angle.cos(), angle.sin()], dim=-1).to(like.dtype)


def _square(pixels: Tensor) -> Tensor:
    """About the side of a square in px, over all views `(*B,)`, for corners `(*B, V, N, 2)`, NaN where not used.

    n corners that are spread evenly have n squares between them, and twelve times the root of their covariance's
    determinant is the area that they fill.
    """
    count = pixels[..., 0].isfinite().sum(-1)
    off = (pixels - pixels.nanmean(-2, keepdim=True)).nan_to_num(0.0)
    u, v = off.unbind(-1)
    spread = (u.square().sum(-1) * v.square().sum(-1) - (u * v).sum(-1).square()).clamp(min=0).sqrt()
    side = (12 * spread).sqrt() / count.clamp(min=1)
    return torch.where(count > 2, side, torch.nan).nanmedian(-1).values.nan_to_num(0.0)
