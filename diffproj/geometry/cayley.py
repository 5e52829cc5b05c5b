"""Small rotations by Cayley's map: the one way in which this package moves a rotation by three numbers.

`Q(w)` turns about the axis `w` by `2 atan(|w| / 2)`,

    Q(w) = I + 2 / (1 + |v|^2) ([v]x + [v]x^2)        v = w / 2.

It is a rotation for every finite `w`, agrees with the exponential map (the rotation vector) in its first and second
derivative at 0, is rational, so that it costs a quarter of it, and all its derivatives are exact at 0.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def turned(R: Float[Tensor, "*batch 3 3"], omega: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """`Q(omega) R` for rotations `(*B, 3, 3)` and `(*B, 3)` in radians; elementwise, so that autocast costs nothing."""
    half = omega.unsqueeze(-1) / 2
    across = torch.linalg.cross(half, R, dim=-2)
    across = across + torch.linalg.cross(half, across, dim=-2)
    return R + across * (2 / (1 + half.square().sum(-2, keepdim=True)))
