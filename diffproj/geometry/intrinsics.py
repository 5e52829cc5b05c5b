"""The intrinsics `K = [[F, c], [0, 0, 1]]`: as a matrix, as parameters, and under a warp of the image.

`F` is `diag(f_x, f_y)` for a calibrated camera. After a rotation, reflection or shear of the image it is another
invertible 2x2 matrix, and the camera model stays exact.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.numerics import (
    all_within,
    arrays_of,
    entries,
    has_values,
    in_float64,
    is_short,
    least_depth,
    linear,
    rounding,
    side_by_side,
    wants_derivative,
)
from diffproj.lens.compiling import coordinates

SQUARED = 0.45
"""The power of the largest number up to which a pixel counts as finite: its square, and what is left of it, are."""


def intrinsic_matrix(
    focal: Float[Tensor, "*batch 2"], center: Float[Tensor, "*batch 2"], skew: Float[Tensor, "*batch"] | None = None
) -> Float[Tensor, "*batch 3 3"]:
    """K from focal lengths, principal point and skew, in px."""
    (f_x, f_y), (c_x, c_y) = focal.unbind(-1), center.unbind(-1)
    zero, one = torch.zeros_like(f_x), torch.ones_like(f_x)
    row = [f_x, zero if skew is None else skew, c_x]
    return torch.stack([*row, zero, f_y, c_y, zero, zero, one], dim=-1).unflatten(-1, (3, 3))


def focal_and_center(K: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """`f_x f_y c_x c_y` from an upper triangular K: the inverse of `intrinsic_matrix`, but for the skew."""
    return torch.cat([K.diagonal(dim1=-2, dim2=-1)[..., :2], K[..., :2, 2]], dim=-1)


def pixel_to_normalized(K: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 2 2"]:
    """The inverse of `F`: maps a pixel's offset from the principal point to the normalised plane."""
    a, b, c, d = K[..., :2, :2].flatten(-2).unbind(-1)
    determinant = torch.addcmul(a * d, b, c, value=-1)
    return (torch.stack([d, -b, -c, a], dim=-1) / determinant.unsqueeze(-1)).unflatten(-1, (2, 2))


def normalised(
    pixels: Float[Tensor, "*#batch n 2"], K: Float[Tensor, "*#batch 3 3"]
) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
    """Pixels on the normalised plane, still distorted `(*B, N, 2)`, and which are finite; of others that of `(0, 0)`.

    Without derivatives each component is in one piece of memory.
    """
    limit = torch.finfo(pixels.dtype).max ** SQUARED
    derivative = wants_derivative(pixels, K)
    if not derivative and has_values(pixels, K) and is_short(pixels):  # in this order: a length is no part of a graph
        return _normalised_short(pixels.numpy(force=True), K.numpy(force=True), limit)
    center = K[..., :2, 2].unsqueeze(-1).unbind(-2)
    u, v = pixels.unbind(-1) if derivative else coordinates(pixels)
    offset = [u - center[0], v - center[1]]
    if all_within(pixels, limit):  # the usual case
        finite = torch.ones_like(u, dtype=torch.bool)
    else:
        finite = torch.maximum(u.abs(), v.abs()) < limit
        offset = [torch.where(finite, part, 0.0) for part in offset]
    return side_by_side(linear(entries(pixel_to_normalized(K)), offset)), finite


def _normalised_short(pixels: np.ndarray, K: np.ndarray, limit: float) -> tuple[Tensor, Tensor]:
    """The same of few pixels, in NumPy."""
    a, b, c, d = (K[..., row, column, None] for row in (0, 1) for column in (0, 1))
    xy = np.empty((2, *np.broadcast_shapes(pixels.shape[:-1], a.shape)), pixels.dtype)
    with np.errstate(all="ignore"):
        finite = np.abs(pixels).max(-1) < limit
        u, v = (pixels[..., axis] - K[..., axis, 2, None] for axis in (0, 1))
        if not finite.all():
            u, v = (np.where(finite, part, np.zeros((), part.dtype)) for part in (u, v))
        determinant = a * d - b * c
        np.subtract(u * (d / determinant), v * (b / determinant), out=xy[0])
        np.subtract(v * (a / determinant), u * (c / determinant), out=xy[1])
    return torch.from_numpy(xy).movedim(0, -1), torch.from_numpy(finite)


def through_pinhole(direction: Sequence[Tensor], derivative: bool) -> tuple[list[Tensor], Tensor]:
    """Perspective division by components `(*B, N)`, and where the direction is finite and leads forward.

    Elsewhere it gives 0 where a derivative is asked, and anything where none is.
    """
    x, y, z = direction
    reach, limits = x.abs() + y.abs(), torch.finfo(z.dtype)
    # Derivatives hold 1 / z, which must not overflow; and x / z, not x times 1 / z, whose derivative would sooner.
    valid = (z > limits.eps * reach + least_depth(z.dtype)) & (reach + z <= limits.max)
    if derivative:
        x, y, z = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0), torch.where(valid, z, 1.0)
    return [x / z, y / z], valid


def upright(
    K: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """An upper triangular K and the turn of the image that it leaves out: `F = F_upper q`, q a rotation.

    Returns:
        `K_upper (*B, 3, 3)`, with positive focal lengths unless the image is mirrored, and cosine and sine of the angle
        that q turns by, from x towards y `(*B,)`. A turn by a right angle that rounding has spoilt is one again.
    """
    a, b, c, d = K[..., :2, :2].flatten(-2).unbind(-1)
    mirrored = a * d < b * c
    f_y = torch.hypot(c, d)
    f_y = torch.where(mirrored & (d < 0), -f_y, f_y)
    cosine, sine = d / f_y, c / f_y
    f_x, skew = a * cosine - b * sine, a * sine + b * cosine
    skew = torch.where(skew.abs() <= rounding(K.dtype) * (f_x.abs() + f_y.abs()), 0.0, skew)
    zero = torch.zeros_like(f_x)
    F = torch.stack([f_x, skew, zero, f_y], dim=-1).unflatten(-1, (2, 2))
    return torch.cat([torch.cat([F, K[..., :2, 2:]], dim=-1), K[..., 2:, :]], dim=-2), cosine, sine


def warped(
    K: Float[Tensor, "*#batch 3 3"], matrix: Float[Tensor, "*#batch 3 3"], ahead: Sequence[float] | None
) -> tuple[Float[Tensor, "*out 3 3"], Float[Tensor, "*out 3 3"] | None]:
    """The intrinsics of a warped image, and the rotation of the camera that the warp implies.

    A warp maps homogeneous pixels `p = K X_cam` to `H p`. `H K` factors into new intrinsics and a rotation,

        H K = |g| K' Q,        g the last row of H K, and the last row of Q its direction,

    so the warped image is that of a camera with `K'`, rotated by `Q`: `X_cam' = Q X_cam`. Of all such rotations Q is
    the smallest; it is the identity where H is affine. The scale of H is arbitrary; its sign is chosen such that the
    pixel `ahead` stays in front of the camera.

    Args:
        K: `(*B, 3, 3)`.
        matrix: H `(*B, 3, 3)`, from pixels of the image to pixels of the warped image.
        ahead: a pixel of the image that the warped image shows; the principal point if left out.

    Returns:
        `K'` and `Q`, both `(*B, 3, 3)` in the dtype of K; `None` in the place of Q where all warps are seen to be
        affine.
    """
    if wants_derivative(K, matrix) or not has_values(K, matrix):
        return tuple(part.to(K.dtype) for part in _warped(torch, in_float64(K), in_float64(matrix), ahead))  # type: ignore[return-value]
    library, (K_given, H) = arrays_of(K, matrix, double=True)
    if library is np and not H[..., 2, :2].any():  # the usual case
        upper = (H[..., None] * K_given[..., None, :, :]).sum(-2) / H[..., 2:, 2:]
        return torch.as_tensor(upper, dtype=K.dtype, device=K.device), None
    upper, Q = (torch.as_tensor(part, dtype=K.dtype, device=K.device) for part in _warped(library, K_given, H, ahead))
    return upper, Q


def _warped(library: Any, K: Any, matrix: Any, ahead: Sequence[float] | None) -> tuple[Any, Any]:
    """The same of arrays, or of tensors."""
    u, v = (K[..., 0, 2], K[..., 1, 2]) if ahead is None else ahead
    G = (matrix[..., None] * K[..., None, :, :]).sum(-2)
    w = matrix[..., 2, 0] * u + matrix[..., 2, 1] * v + matrix[..., 2, 2]
    G = library.where((w < 0)[..., None, None], -G, G)
    length = (G[..., 2, :] * G[..., 2, :]).sum(-1)[..., None] ** 0.5
    last = G[..., 2, :] / length
    # Rows x and y of Q: the identity's, less last (x, y) / (1 + z), less (x, y) in the third place.
    x, y, z = (last[..., axis] for axis in range(3))
    far, both = 1 + z, -x * y / (1 + z)
    first, second = library.stack((1 - x * x / far, both, -x), -1), library.stack((both, 1 - y * y / far, -y), -1)
    Q = library.stack((first, second, last), -2)
    upper = (G[..., :2, None, :] * Q[..., None, :, :]).sum(-1) / length[..., None]  # G Q^T
    below = library.zeros_like(upper[..., :1, :]) + (upper.new_tensor if library is torch else np.array)([0.0, 0, 1])
    return library.concatenate((upper, below), -2), Q


def check_intrinsics(K: Tensor) -> None:
    """Check values of K.

    Raises:
        ValueError: not finite, a last row other than (0, 0, 1), or singular.
    """
    eps = torch.finfo(K.dtype).eps
    library, (K,) = arrays_of(K)
    if not bool(library.isfinite(K).all()):
        raise ValueError("K: want finite values, got NaN or infinity")
    if bool(((abs(K[..., 2, 0]) > 1e-5) | (abs(K[..., 2, 1]) > 1e-5) | (abs(K[..., 2, 2] - 1) > 1e-5)).any()):
        if bool(((abs(K[..., 0, 2]) < 1e-5) & (abs(K[..., 1, 2]) < 1e-5) & (abs(K[..., 2, 2] - 1) < 1e-5)).any()):
            raise ValueError("K: want the last row (0, 0, 1), got it as the last column; transpose K")
        raise ValueError("K: want the last row (0, 0, 1), got another; divide by K[..., 2, 2]")
    with np.errstate(over="ignore", invalid="ignore"):
        a, b, c, d = (K[..., row, column] for row in (0, 1) for column in (0, 1))
        singular = abs(a * d - b * c) <= 8 * eps * (a * a + b * b + c * c + d * d)
    if bool(singular.any()):
        raise ValueError("K: want an invertible matrix, got a singular one; are both focal lengths set?")


def check_warp(name: str, matrix: Tensor, K: Tensor, behind_lens: bool) -> None:
    """Check values of a warp of a camera's image.

    Raises:
        ValueError: not finite, singular, or a projective warp for a camera with a lens.
    """
    least = rounding(matrix.dtype)
    library, (matrix, K) = arrays_of(matrix, K, double=True)
    if not bool(library.isfinite(matrix).all()):
        raise ValueError(f"{name}: want finite values, got NaN or infinity")
    # Multiplied by K, the entries of a row have similar magnitudes, whatever the warp's shift and scale.
    with np.errstate(all="ignore"):
        rows = (matrix[..., None] * K[..., None, :, :]).sum(-2)
        rows = rows / (rows * rows).sum(-1)[..., None] ** 0.5
        singular = ~(abs(library.linalg.det(rows)) > least)
    if bool(singular.any()):
        raise ValueError(f"{name}: want an invertible one, got a singular one")
    if behind_lens and bool((matrix[..., 2, :2] != 0).any()):
        raise ValueError(
            f"{name}: want an affine one (last row 0, 0, 1) for a camera with a lens, got a projective one: no lens "
            "model describes the image that it makes; rectify the image first"
        )
