"""Functions that are smooth at 0 although their formulas divide by 0 or take a root there; derivatives are exact.

Each is a power series close to 0 and the formula elsewhere. In each branch the argument is replaced where the other
branch applies, so that no gradient passes through a division by 0.
"""

import math

import torch
from torch import Tensor

from diffproj.lens.polynomial import series

NEAR_ZERO = 0.02
"""End of the series' range: up to it the arc tangent's 11 terms are exact to 1e-19, the others' 7 terms suffice."""
ARC_TANGENT = [(-1) ** n / (2 * n + 1) for n in range(11)]
ARC_TANGENT_SLOPE = [n * factor for n, factor in enumerate(ARC_TANGENT)][1:]
SINE = [(-1) ** n / math.factorial(2 * n + 1) for n in range(7)]
COSINE = [(-1) ** n / math.factorial(2 * n) for n in range(7)]


def angle_over_side(side_squared: Tensor, z: Tensor) -> Tensor:
    """`atan2(side, z) / side` for a side that may be 0 where `z` is positive."""
    near = (z > 0) & (side_squared < NEAR_ZERO * z * z)
    side = torch.where(near, 1, side_squared).sqrt()
    z_near = torch.where(near, z, 1)
    small = series(torch.where(near, side_squared, 0) / (z_near * z_near), ARC_TANGENT) / z_near
    return torch.where(near, small, torch.atan2(side, z) / side)


def angle_over_side_slopes(side_squared: Tensor, z: Tensor, ratio: Tensor) -> tuple[Tensor, Tensor]:
    """The derivatives of `angle_over_side`, whose value is `ratio`, by `side_squared` and by `z`."""
    near = (z > 0) & (side_squared < NEAR_ZERO * z * z)
    square, z_near = torch.where(near, 1, side_squared), torch.where(near, z, 1)
    small = series(torch.where(near, side_squared, 0) / (z_near * z_near), ARC_TANGENT_SLOPE) / z_near**3
    inverse = 1 / (side_squared + z * z)
    return torch.where(near, small, (z * inverse - ratio) / (2 * square)), -inverse


def sine_over_angle_and_cosine(angle_squared: Tensor) -> tuple[Tensor, Tensor]:
    """`sin(a) / a` and `cos(a)` as functions of `a^2`."""
    near = angle_squared < NEAR_ZERO
    angle = torch.where(near, 1, angle_squared).sqrt()
    small = torch.where(near, angle_squared, 0)
    sine_over_angle = torch.where(near, series(small, SINE), angle.sin() / angle)
    return sine_over_angle, torch.where(near, series(small, COSINE), angle.cos())
