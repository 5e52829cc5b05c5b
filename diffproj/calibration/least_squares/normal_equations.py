"""The normal equations of a batch of problems, and the damped step that solves them.

The blocks are those of `solver.py`. With few views the calls take the time, so that there are as few as will do.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Equations(NamedTuple):
    """The undamped normal equations at a point, in all shared unknowns: U `(P, s, s)`, E, W, g and h.

    `c (P, V)` is each block's reweighted sum of squares, `1/2 sum_n w rho' |e_vn|^2`.
    """

    U: Tensor
    E: Tensor
    W: Tensor
    g: Tensor
    h: Tensor
    c: Tensor


def damped_step(
    equations: Equations, damping: Float[Tensor, " p"], basis: Float[Tensor, "p s q"] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve the damped normal equations by the Schur complement.

    The step lowers the quadratic model by

        1/2 (sum |y_v|^2 + |L^-1 (g - sum Y_v^T y_v)|^2) + lambda/2 (dx . diag(U) dx + sum dz_v . diag(W_v) dz_v)

    with `L L^T = S`.

    Args:
        equations: undamped.
        damping: lambda `(P,)`.
        basis: of the directions in which x may move; all if left out.

    Returns:
        `(dx, dz, reduction)`: the step, `(P, s)` and `(P, V, l)`, and the cost reduction predicted by the quadratic
        model, `(P,)`. Zero, zero and infinite where the matrices are not positive definite.
    """
    U, E, W, g, h, _ = equations
    P, V, size = h.shape
    E_T, g, h = E.mT.reshape(P, V * size, E.shape[2]), g.unsqueeze(-1), h.reshape(P, V * size, 1)
    if basis is not None and basis.shape[-1] > 0:
        E_T, U, g = E_T.bmm(basis), basis.mT.bmm(U).bmm(basis), basis.mT.bmm(g)
    elif basis is not None:
        E_T, U, g = E_T[:, :, :0], U[:, :0, :0], g[:, :0]
    q = U.shape[-1]
    L_local, local_failed = torch.linalg.cholesky_ex(_damped(W, damping.view(P, 1, 1)))
    panel = torch.cat([E_T, h], dim=-1).view(P, V, size, q + 1)
    Y = torch.linalg.solve_triangular(L_local, panel, upper=False).reshape(P, V * size, q + 1)
    eliminated = Y.mT.bmm(Y)
    L, failed = torch.linalg.cholesky_ex(_damped(U, damping.view(P, 1)) - eliminated[:, :q, :q])
    pull = eliminated[:, :q, q:] - g
    dx = torch.cholesky_solve(pull, L)
    y = torch.baddbmm(Y[:, :, q:], Y[:, :, :q], dx).view(P, V, size, 1)
    dz = torch.linalg.solve_triangular(L_local.mT, y, upper=True).neg_()
    gain = eliminated[:, q, q] + (pull * dx).sum((1, 2))
    held = (U.diagonal(dim1=1, dim2=2).unsqueeze(-1) * dx.square()).sum((1, 2))
    held += (W.diagonal(dim1=2, dim2=3).unsqueeze(-1) * dz.square()).sum((1, 2, 3))
    reduction = torch.addcmul(gain, damping, held).div_(2)
    dx, dz = (dx if basis is None else basis.bmm(dx)).squeeze(-1), dz.squeeze(-1)
    if not bool(failed.any()) and not bool(local_failed.any()):
        return dx, dz, reduction.nan_to_num_(torch.inf, torch.inf, torch.inf)
    sound = (failed == 0) & (local_failed == 0).all(-1) & reduction.isfinite()
    return (
        torch.where(sound.unsqueeze(-1), dx, 0.0),
        torch.where(sound[:, None, None], dz, 0.0),
        torch.where(sound, reduction, torch.inf),
    )


def _damped(matrix: Tensor, damping: Tensor) -> Tensor:
    """The matrix with its diagonal times `1 + damping`.

    Of an unknown without effect on the residuals, row and column are 0: a hair on the diagonal makes its step 0.
    """
    sum_ = matrix.clone()
    diagonal = sum_.diagonal(dim1=-2, dim2=-1)
    diagonal.addcmul_(diagonal, damping).clamp_(min=torch.finfo(matrix.dtype).tiny ** 0.5)
    return sum_


def decoupled_reduction(equations: Equations, basis: Tensor | None) -> Tensor:
    """Reduction predicted if each unknown moved alone, `(P,)`: a norm of the gradient that no damping reduces."""
    U, _, W, g, h, _ = equations
    if basis is not None and basis.shape[-1] > 0:
        U, g = basis.mT @ U @ basis, times(basis.mT, g)
    elif basis is not None:
        U, g = U[:, :0, :0], g[:, :0]
    size, local_size = (M.diagonal(dim1=-2, dim2=-1) for M in (U, W))
    alone, local_alone = (
        torch.where(scale > 0, slope.square() / scale, 0.0) for scale, slope in ((size, g), (local_size, h))
    )
    return (alone.sum(-1) + local_alone.sum((-2, -1))) / 2


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrices `(*B, m, n)` times vectors `(*B, n)`."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
