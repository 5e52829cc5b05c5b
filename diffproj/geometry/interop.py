"""Conversion of a camera's parameters from and to OpenCV's arrays and Kornia's `PinholeCamera`.

Both share diffproj's conventions (world to camera, pixel centres at integers), so only shapes and types change;
rotation vectors are axis times angle in radians. This file handles tensors only; `Camera` is built from them elsewhere.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from diffproj._core.numerics import at_least_float32, has_values

ArrayLike = Tensor | np.ndarray | Sequence[Any]


def tensors_from_opencv(
    K: ArrayLike, dist: ArrayLike | None, rvec: ArrayLike | None, tvec: ArrayLike | None
) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]:
    """`(K, coefficients, R, t)` with OpenCV's row and column vectors flattened; absent arguments stay `None`.

    Arrays become float64, or take the dtype and device of K if it is a tensor; tensors keep their autograd graph.

    Raises:
        ValueError: a vector is neither `(*B, k)` nor a row or column.
    """
    kind = K if isinstance(K, Tensor) else torch.empty(0, dtype=torch.float64, device="cpu")
    K = _tensor(K, kind)
    batch = K.shape[:-2]
    coefficients = None if dist is None else _vector("dist", _tensor(dist, kind), batch)
    if coefficients is not None and coefficients.shape[-1] == 0:
        coefficients = None
    R = None
    if rvec is not None:
        rotation_vector = _vector("rvec", _tensor(rvec, kind), batch)
        if rotation_vector.shape[-1] != 3:
            raise ValueError(f"rvec: want 3 numbers, got {rotation_vector.shape[-1]}")
        R = axis_angle_to_rotation_matrix(rotation_vector)
    t = None if tvec is None else _vector("tvec", _tensor(tvec, kind), batch)
    return K, coefficients, R, t


def arrays_for_opencv(
    K: Tensor, coefficients: Tensor | None, R: Tensor, t: Tensor
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`(K, dist, rvec, tvec)` as float64 arrays with the batch axes in front.

    Raises:
        ValueError: K has skew: OpenCV uses only focal lengths and principal point.
    """
    K_array, R_array, t_array = _array(K), _array(R), _array(t)
    skew = np.abs(K_array[..., 0, 1] / K_array[..., 0, 0]).max(initial=0.0)
    if skew:
        raise ValueError(
            f"K: want no skew, for OpenCV ignores it; got axes of the image {skew:.3g} rad off the right angle"
        )
    batch = K_array.shape[:-2]
    dist = np.zeros((*batch, 0)) if coefficients is None else _array(coefficients)
    vectors = [cv2.Rodrigues(matrix)[0].ravel() for matrix in R_array.reshape(-1, 3, 3)]
    return K_array, dist, np.array(vectors).reshape(*batch, 3), t_array


def tensors_from_kornia(pinhole: PinholeCamera) -> tuple[Tensor, Tensor, Tensor, tuple[int, int] | None]:
    """`(K, R, t, size)` of Kornia's camera; `size` is `None` where its values cannot be read.

    Raises:
        ValueError: the cameras of the batch have images of different sizes.
    """
    K, R, t = pinhole.intrinsics[..., :3, :3], pinhole.extrinsics[..., :3, :3], pinhole.extrinsics[..., :3, 3]
    size = None
    if has_values(pinhole.width, pinhole.height):
        sizes = {(int(w), int(h)) for w, h in zip(pinhole.width, pinhole.height, strict=True)}
        if len(sizes) > 1:
            raise ValueError(f"camera: want one image size for the batch, got {sorted(sizes)}; convert them one by one")
        size = sizes.pop()
    return at_least_float32(K), at_least_float32(R), at_least_float32(t), size


def pinhole_from_tensors(K: Tensor, R: Tensor, t: Tensor, size: tuple[int, int]) -> PinholeCamera:
    """Kornia's camera with batch shape `(B,)`; a single camera becomes a batch of one.

    Raises:
        ValueError: there is more than one batch axis.
    """
    if K.ndim > 3:
        raise ValueError(f"camera: want batch shape () or (B,) for PinholeCamera, got {tuple(K.shape[:-2])}")
    K, R, t = K.reshape(-1, 3, 3), R.reshape(-1, 3, 3), t.reshape(-1, 3, 1)
    intrinsics = torch.nn.functional.pad(K, (0, 1, 0, 1)) + torch.diag(K.new_tensor([0.0, 0, 0, 1]))
    extrinsics = torch.cat([torch.cat([R, t], dim=-1), K.new_tensor([[[0.0, 0, 0, 1]]]).expand(len(K), 1, 4)], dim=-2)
    width, height = (K.new_full((len(K),), side) for side in size)
    return PinholeCamera(intrinsics, extrinsics, height, width)


def _tensor(value: ArrayLike, kind: Tensor) -> Tensor:
    if isinstance(value, Tensor):
        return value
    return torch.tensor(np.asarray(value, dtype=np.float64), dtype=kind.dtype, device=kind.device)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to("cpu", torch.float64).numpy().copy()


def _vector(name: str, value: Tensor, batch: torch.Size) -> Tensor:
    """A vector `(*B, k)` from one that OpenCV may give as a row `(1, k)` or a column `(k, 1)`."""
    if value.ndim >= 2 and value.shape[-1] == 1:
        return value.squeeze(-1)
    if value.ndim == len(batch) + 2 and value.shape[-2] == 1:
        return value.squeeze(-2)
    if value.ndim == 0:
        raise ValueError(f"{name}: want shape (*B, k), or a row or column, got {tuple(value.shape)}")
    return value
