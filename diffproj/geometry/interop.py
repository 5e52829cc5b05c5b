"""Conversion of a camera's parameters from and to OpenCV's arrays and Kornia's `PinholeCamera`.

Both share diffproj's conventions (world to camera, pixel centres at integers), so only shapes and types change;
rotation vectors are axis times angle in radians. This file handles tensors only; `Camera` is built from them elsewhere.
"""

import cv2
import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from diffproj._core.arguments import Array
from diffproj._core.numerics import at_least_float32, check_tensor, has_values

ArrayLike = Tensor | Array


def tensors_from_opencv(
    K: ArrayLike, dist: ArrayLike | None, rvec: ArrayLike | None, tvec: ArrayLike | None
) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]:
    """`(K, coefficients, R, t)` with OpenCV's row and column vectors flattened; absent arguments stay `None`.

    Arrays become float64, or take the dtype and device of K if it is a tensor; tensors keep their autograd graph.

    Raises:
        ValueError: a vector is neither `(*B, k)` nor a row or column.
    """
    K = check_tensor("K", K, 3, 3, like=torch.empty(0, dtype=torch.float64, device="cpu"))
    coefficients = None if dist is None else _vector("dist", dist, K)
    if coefficients is not None and coefficients.shape[-1] == 0:
        coefficients = None
    R, vectors = None, None if rvec is None else _three("rvec", _vector("rvec", rvec, K))
    if vectors is not None:
        if vectors.shape[:-1].numel():
            R = axis_angle_to_rotation_matrix(vectors)
            if has_values(R) and not bool(R.isfinite().all()):
                raise ValueError("rvec: want angles in radians, got numbers too large for any")
        else:  # which Kornia refuses
            R = vectors.new_empty(*vectors.shape, 3)
    t = None if tvec is None else _three("tvec", _vector("tvec", tvec, K))
    if vectors is not None and K.ndim == 2 and (t is None or t.ndim == 1):
        _refuse_rotation(vectors)
    return K, coefficients, R, t


def _refuse_rotation(vectors: Tensor) -> None:
    """Refuse a rotation matrix in the place of a rotation vector: it would pass for three cameras."""
    if vectors.shape[-2:] != (3, 3) or not has_values(vectors):
        return
    gram = vectors.detach() @ vectors.detach().mT
    if bool(((gram - torch.eye(3, dtype=gram.dtype, device=gram.device)).abs() < 1e-5).all()):
        raise ValueError(
            "rvec: want rotation vectors, got what looks like a rotation matrix; cv2.Rodrigues(R)[0] is its vector, or "
            "build dp.Camera(K, R, t)"
        )


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
        size = sizes.pop() if sizes else None
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


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to("cpu", torch.float64).numpy().copy()


def _three(name: str, vector: Tensor) -> Tensor:
    if vector.shape[-1] != 3:
        raise ValueError(f"{name}: want 3 numbers, got {vector.shape[-1]}")
    return vector


def _vector(name: str, given: ArrayLike, K: Tensor) -> Tensor:
    """A vector `(*B, k)` from one that OpenCV may give as a row `(1, k)` or a column `(k, 1)`."""
    value, batch = check_tensor(name, given, like=K), K.shape[:-2]
    if has_values(value) and not bool(value.isfinite().all()):
        raise ValueError(f"{name}: want finite numbers, got NaN or infinity")
    if value.ndim >= 2 and value.shape[-1] == 1:
        return value.squeeze(-1)
    if value.ndim == len(batch) + 2 and value.shape[-2] == 1:
        return value.squeeze(-2)
    if value.ndim == 0:
        raise ValueError(f"{name}: want shape (*B, k), or a row or column, got {tuple(value.shape)}")
    return value
