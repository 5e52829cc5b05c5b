"""The plane map's steps for few points on a CPU, in NumPy: there a step costs about half of what it does in PyTorch.

The products and sums are those of `plane_kernel.py`, and results agree with its to rounding.
"""

import numpy as np
import torch
from torch import Tensor


def divided(p: Tensor, matrix: Tensor, seen: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """The points, which are valid, `b . p`, and which are not valid (`None`: all are)."""
    vectors, M = p.numpy(force=True), matrix.numpy(force=True)
    points = np.empty((*vectors.shape[:-1], 3), vectors.dtype)
    with np.errstate(all="ignore"):
        products = _times(M[..., :4, :], vectors)
        denominator = products[..., 3, :]
        valid = denominator > _times(M[..., 4:, :], np.abs(vectors))[..., 0, :]  # false for NaN, too
        if seen is not None:
            valid &= seen.numpy()
        np.divide(products[..., :3, :], products[..., 3:, :], out=points.swapaxes(-1, -2))
    found, meets, below = torch.from_numpy(points), torch.from_numpy(valid), torch.from_numpy(denominator)
    if valid.all():
        return found, meets, below, None
    points[~valid] = 0.0
    denominator[~valid] = np.inf
    return found, meets, below, ~meets


def _times(matrix: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Products `(*B, m, N)` of matrices `(*B, m, 3)` and vectors `(*B, N, 3)`, or `(*B, N, 2)` with a 1 behind."""
    x, y = vectors[..., None, :, 0], vectors[..., None, :, 1]
    last = matrix[..., 2, None]
    if vectors.shape[-1] == 3:
        last = last * vectors[..., None, :, 2]
    products = x * matrix[..., 0, None]
    products += last
    products += y * matrix[..., 1, None]
    return products


def gradient(
    p: Tensor,
    matrix: Tensor,
    hidden: Tensor | None,
    denominator: Tensor,
    by_points: Tensor,
    wanted: tuple[bool, bool],
) -> tuple[Tensor | None, Tensor | None]:
    """By p `(*B, N, 2)` or `(*B, N, 3)`, and by the matrix `(*B, 5, 3)`, from that by the points `(*B, N, 3)`.

    `dX = (A dp - X (b . dp)) / (b . p)`, and 0 where there is no point.
    """
    vectors, M, upstream = (tensor.numpy(force=True) for tensor in (p, matrix, by_points))
    if hidden is not None:
        gone = hidden.numpy()[..., None]
        vectors, upstream = (np.where(gone, np.zeros((), part.dtype), part) for part in (vectors, upstream))
    parts = [vectors[..., axis] for axis in range(vectors.shape[-1])]
    with np.errstate(all="ignore"):
        inverse = 1 / denominator.numpy()
        by_numerators = upstream.swapaxes(-1, -2) * inverse[..., None, :]  # (*B, 3, N)
        rows = [by_numerators[..., axis, :] for axis in range(3)]
        # By p through the numerators; along p this is what the denominator takes back.
        through = [
            M[..., 0, j, None] * rows[0] + M[..., 1, j, None] * rows[1] + M[..., 2, j, None] * rows[2] for j in range(3)
        ]
        along = through[0] * parts[0] + through[1] * parts[1]
        along += through[2] * parts[2] if len(parts) == 3 else through[2]
        by_denominator = along
        by_denominator *= -inverse
        by_p = by_matrix = None
        if wanted[0]:
            by_p = np.empty_like(vectors)
            for j in range(len(parts)):
                np.add(through[j], by_denominator * M[..., 3, j, None], out=by_p[..., j])
        if wanted[1]:
            products = np.concatenate((by_numerators, by_denominator[..., None, :]), -2)
            by_matrix = np.zeros((*products.shape[:-2], 5, 3), products.dtype)  # s is constant
            for j in range(3):
                weighted = products * parts[j][..., None, :] if j < len(parts) else products
                weighted.sum(-1, out=by_matrix[..., :4, j])
    found = None if by_p is None else torch.from_numpy(by_p)
    return found, None if by_matrix is None else torch.from_numpy(by_matrix).sum_to_size(matrix.shape)
