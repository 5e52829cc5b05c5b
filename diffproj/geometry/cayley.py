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


def cross_matrix(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrices `(*B, 3, 3)` that take the cross product with vectors `(*B, 3)` from the left."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def turn_rate(omega: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """How `Q(omega) R` turns about the axes, in radians, as omega moves `(*B, 3, 3)`; the identity at 0."""
    half = omega / 2
    one = torch.eye(3, dtype=omega.dtype, device=omega.device)
    return (one + cross_matrix(half)) / (1 + half.square().sum(-1))[..., None, None]


def turn_between(R: Float[Tensor, "*batch 3 3"], other: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """The omega `(*B, 3)` of `other = Q(omega) R`; of rotations half a turn apart it is not finite."""
    turn = other @ R.mT
    axis = torch.stack(
        [turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0], turn[..., 1, 0] - turn[..., 0, 1]],
        dim=-1,
    )
    return 2 * axis / (1 + turn.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True))
