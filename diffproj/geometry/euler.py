"""Rotation matrices from the paper's Euler angles, and the inverse; for axis-angle vectors see Kornia.

The paper (Siswantoro et al. 2013, Eq. 1) composes a rotation from three angles in radians,

    R = R_x(psi) R_y(phi) R_z(theta),

each factor a right-handed rotation about its axis. Written out,

    R = [ cos phi cos theta                      -cos phi sin theta                       sin phi          ]
        [ ...                                     ...                                    -sin psi cos phi  ]
        [ ...                                     ...                                     cos psi cos phi  ]

from which the angles are recovered. At phi = +-pi/2 (gimbal lock) only psi +- theta is determined, and psi is set to 0.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, meeting
from diffproj._core.numerics import broadcast_batches, check_same_kind, check_tensor


def rotation_from_euler(
    psi: Float[Tensor, "*#batch"] | Array | float,
    phi: Float[Tensor, "*#batch"] | Array | float,
    theta: Float[Tensor, "*#batch"] | Array | float,
) -> Float[Tensor, "*#batch 3 3"]:
    """Compose `R_x(psi) R_y(phi) R_z(theta)`.

    Args:
        psi: angles about x in radians, `(*B,)`.
        phi: angles about y in radians, `(*B,)`.
        theta: angles about z in radians, `(*B,)`.

    Returns:
        Rotation matrices `(*B, 3, 3)`.

    Raises:
        TypeError: an argument is no floating-point tensor and no array, or dtypes differ.
        ValueError: shapes do not broadcast, or devices differ.

    Example:
        >>> quarter = torch.tensor(torch.pi / 2, dtype=torch.float64)
        >>> zero = torch.zeros_like(quarter)
        >>> rotation_from_euler(zero, zero, quarter).round().int()  # rotates +x to +y
        tensor([[ 0, -1,  0],
                [ 1,  0,  0],
                [ 0,  0,  1]], dtype=torch.int32)
    """
    kind = meeting(*(angle for angle in (psi, phi, theta) if isinstance(angle, Tensor)))
    kind = torch.empty(0, dtype=torch.float64, device="cpu") if kind is None else kind
    psi, phi = check_tensor("psi", psi, like=kind), check_tensor("phi", phi, like=kind)
    theta = check_tensor("theta", theta, like=kind)
    check_same_kind(psi=psi, phi=phi, theta=theta)
    broadcast_batches(psi=psi.shape, phi=phi.shape, theta=theta.shape)
    sin_x, cos_x = psi.sin(), psi.cos()
    sin_y, cos_y = phi.sin(), phi.cos()
    sin_z, cos_z = theta.sin(), theta.cos()
    rows = (
        (cos_y * cos_z, -cos_y * sin_z, sin_y.expand((cos_x * cos_y * cos_z).shape)),
        (sin_x * sin_y * cos_z + cos_x * sin_z, cos_x * cos_z - sin_x * sin_y * sin_z, -sin_x * cos_y),
        (sin_x * sin_z - cos_x * sin_y * cos_z, sin_x * cos_z + cos_x * sin_y * sin_z, cos_x * cos_y),
    )
    return torch.stack([torch.stack(torch.broadcast_tensors(*row), dim=-1) for row in rows], dim=-2)


def euler_from_rotation(
    R: Float[Tensor, "*batch 3 3"] | Array,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Recover `psi`, `phi`, `theta` from `R = R_x(psi) R_y(phi) R_z(theta)`.

    Args:
        R: rotation matrices `(*B, 3, 3)`.

    Returns:
        `(psi, phi, theta)` in radians, each `(*B,)`; `phi` is in [-pi/2, pi/2]. At gimbal lock, `phi = +-pi/2`, where
        only a combination of the other two is determined, `psi` is 0.

    Raises:
        TypeError: `R` is no floating-point tensor.
        ValueError: `R` is not of shape `(*B, 3, 3)`.

    Example:
        >>> angles = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64).unbind()
        >>> [round(float(angle), 12) for angle in euler_from_rotation(rotation_from_euler(*angles))]
        [0.1, -0.2, 0.3]
    """
    R = check_tensor("R", R, 3, 3)
    cos_phi_squared = R[..., 0, 0] ** 2 + R[..., 0, 1] ** 2
    locked = cos_phi_squared <= (16 * torch.finfo(R.dtype).eps) ** 2
    one, zero = torch.ones_like(cos_phi_squared), torch.zeros_like(cos_phi_squared)
    # atan2(0, 0) and sqrt(0) have no derivative: their arguments are replaced at gimbal lock.
    phi = torch.atan2(R[..., 0, 2], torch.where(locked, zero, torch.where(locked, one, cos_phi_squared).sqrt()))
    psi = torch.atan2(torch.where(locked, zero, -R[..., 1, 2]), torch.where(locked, one, R[..., 2, 2]))
    theta = torch.atan2(
        torch.where(locked, R[..., 1, 0], -R[..., 0, 1]), torch.where(locked, R[..., 1, 1], R[..., 0, 0])
    )
    return psi, phi, theta
