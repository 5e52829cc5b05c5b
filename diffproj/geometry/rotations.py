"""Which matrices are rotations, and the check of a pose that a user hands in."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.numerics import arrays_of

ROTATION_TOLERANCE = 1e-5
"""How far `R^T R` may be from the identity, entry by entry, where a user hands a camera in."""

IDENTITY = np.eye(3)


def is_rotation(R: Float[Tensor, "*shape 3 3"]) -> Bool[Tensor, "*shape"]:
    """Which matrices are rotations, to `ROTATION_TOLERANCE`."""
    return _are_rotations(torch, R, torch.eye(3, dtype=R.dtype, device=R.device))


def _are_rotations(library: Any, R: Any, identity: Any) -> Any:
    # No matrix product, which autocast and TF32 round.
    error = abs((R[..., None] * R[..., None, :]).sum(-3) - identity)
    return (error <= ROTATION_TOLERANCE).all(-1).all(-1) & (library.linalg.det(R) > 0)


def check_pose(R: Tensor, t: Tensor) -> None:
    """Check values of a pose.

    Raises:
        ValueError: not finite, or no rotation.
    """
    library, (R, t) = arrays_of(R, t)
    identity = IDENTITY if library is np else torch.eye(3, dtype=R.dtype, device=R.device)
    if not bool(library.isfinite(t).all()):
        raise ValueError("t: want finite values, got NaN or infinity")
    with np.errstate(over="ignore", invalid="ignore"):
        rotations = _are_rotations(library, R, identity)
    if not bool(rotations.all()):
        raise ValueError(
            "R: want rotation matrices (orthonormal to 1e-5, determinant +1), got others; "
            "kornia's axis_angle_to_rotation_matrix makes them from rotation vectors"
        )
