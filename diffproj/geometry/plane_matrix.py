"""The matrix of the map from a camera's pixels to a plane, as `back_projection.py` derives it.

It is worked out in float64, and in NumPy where nothing but values is asked for, which takes half the time.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffproj._core.numerics import arrays_of, has_values, in_float64, rounding, wants_derivative
from diffproj.geometry.camera import Camera
from diffproj.geometry.float32 import looks_at_rounding, warn_of_rounding
from diffproj.geometry.plane import Plane


def plane_matrix(camera: Camera, plane: Plane, warn: bool) -> Tensor:
    """`[A; b; s] (*B, 5, 3)`, scaled to `max |A, b| = 1/4`; zero where the camera's centre lies in the plane."""
    given = camera.K, camera.R, camera.t, plane.normal, plane.offset
    behind_lens, dtype = camera.distortion is not None, camera.dtype
    if wants_derivative(*given) or not has_values(*given):
        parts = [in_float64(part) for part in given]
        M, b, height = _unscaled(torch, behind_lens, *parts)
        with torch.no_grad():  # the factor changes no point, so no derivative has to pass through it
            factor, size, reach = _scale(torch, M, b, height, parts[2], parts[4], dtype)
        matrix = torch.cat([M * factor, size], dim=-2).to(dtype)
    else:
        library, parts = arrays_of(*given, double=True)
        with np.errstate(all="ignore"):
            M, b, height = _unscaled(library, behind_lens, *parts)
            factor, size, reach = _scale(library, M, b, height, parts[2], parts[4], dtype)
            matrix = library.concatenate((M * factor, size), -2)
        if library is np:  # which converts in a third of the time
            matrix = torch.from_numpy(matrix.astype(camera.t.numpy(force=True).dtype, copy=False))
        matrix = matrix.to(dtype)
    if warn and looks_at_rounding(camera.t):
        warn_of_rounding(reach, abs(height))
    return matrix


def _unscaled(
    library: Any, behind_lens: bool, K: Any, R: Any, t: Any, normal: Any, offset: Any
) -> tuple[Any, Any, Any]:
    """`M = [A; b] (*B, 4, 3)`, the normal in the camera frame `(*B, 3)` and `d - n . C`, as arrays or as tensors."""
    b = (R * normal[..., None, :]).sum(-1)
    height = offset + (b * t).sum(-1)  # n . C = -b . t
    minus_center = (R * t[..., None]).sum(-2)
    A = height[..., None, None] * R.swapaxes(-1, -2) - minus_center[..., None] * b[..., None, :]
    M = library.concatenate((A, b[..., None, :]), -2)
    if behind_lens:
        return M, b, height
    # So far G is R^T, as behind a lens: a pinhole's M is that times diag(F^-1, 1).
    f_xx, f_xy, f_yx, f_yy = (K[..., row, column, None, None] for row in (0, 1) for column in (0, 1))
    determinant = f_xx * f_yy - f_xy * f_yx
    x, y, z = (M[..., column, None] for column in range(3))
    columns = (x * f_yy - y * f_yx) / determinant, (y * f_xx - x * f_xy) / determinant, z
    return library.concatenate(columns, -1), b, height


def _scale(library: Any, M: Any, b: Any, height: Any, t: Any, offset: Any, dtype: torch.dtype) -> tuple[Any, Any, Any]:
    """The factor of M `(*B, 1, 1)`, the row s `(*B, 1, 3)`, and how far all is from the world's origin `(*B,)`."""
    largest = np.maximum.reduce if library is np else torch.amax
    reach = abs(offset) + _length(b) * _length(t)
    # A quarter, so that no pixel is large enough for a sum of three products to overflow.
    factor = library.where(height < 0, -0.25, 0.25) / largest(abs(M), (-2, -1))  # not copysign, which ONNX lacks
    factor = library.where(abs(height) > rounding(dtype) * reach, factor, 0.0)[..., None, None]
    # Of the terms of b . p, and of what b was built from: where b is to be 0, it is what rounding left.
    size = abs(M[..., 3:, :] * factor)
    size = rounding(dtype) * (size + torch.finfo(dtype).eps * largest(size, -1)[..., None])
    return factor, size, reach


def _length(vector: Any) -> Any:
    return (vector * vector).sum(-1) ** 0.5
