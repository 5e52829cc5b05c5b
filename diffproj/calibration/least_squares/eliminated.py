"""Normal equations with the poses eliminated, and their inverses, where some unknowns may be undetermined.

In the blocks of `solver.py`: `S = U - sum E_v W_v^-1 E_v^T`.
"""

import torch
from torch import Tensor

from diffproj.calibration.least_squares.normal_equations import Equations

SINGULAR = 2e-15
"""Eigenvalue of S, scaled by the diagonal of U, at and below which it is rounding error."""


def reduced(equations: Equations, basis: Tensor | None, shares: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The normal matrix S of the free shared parameters `(P, q, q)` with all poses eliminated.

    With it F `(P, V, q, 6)`, the inverses of the poses' blocks, and which of these are singular.
    """
    U, E, W = equations.U, equations.E, equations.W
    if basis is not None:
        U, E = basis.mT @ U @ basis, basis.mT.unsqueeze(1) @ E
    inverse_W, unknown_views = local_inverse(W)
    F = E @ inverse_W
    counted = F if shares is None else F * shares[..., None, None]
    S = U - counted.movedim(1, 2).flatten(2) @ E.movedim(1, 2).flatten(2).mT
    return S, F, inverse_W, unknown_views


def inverse(S: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """The (pseudo-)inverse `(P, q, q)`, and which unknowns are undetermined `(P, q)`; `size` scales the unknowns."""
    sound = S.isfinite().all(-1).all(-1)
    S = torch.where(sound[:, None, None], S, torch.eye(S.shape[-1], dtype=S.dtype, device=S.device))
    scale = torch.where((size > 0) & size.isfinite(), size, 1.0).rsqrt()
    values, vectors = torch.linalg.eigh(S * scale.unsqueeze(-1) * scale.unsqueeze(-2))
    lost = values <= SINGULAR
    inverted = (
        vectors @ torch.diag_embed(torch.where(lost, 0.0, torch.where(lost, 1.0, values).reciprocal())) @ vectors.mT
    )
    unknown = ((vectors.square() * lost.unsqueeze(-2)).sum(-1) > 1e-6) | ~sound.unsqueeze(-1)
    return inverted * scale.unsqueeze(-1) * scale.unsqueeze(-2), unknown


def local_inverse(W: Tensor) -> tuple[Tensor, Tensor]:
    """The inverses of the poses' blocks `(P, V, 6, 6)`, 0 for a singular block, and which blocks are singular."""
    size = W.diagonal(dim1=-2, dim2=-1)
    scale = torch.where((size > 0) & size.isfinite(), size, 1.0).rsqrt()
    scaled = W * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    L, failed = torch.linalg.cholesky_ex(torch.where(scaled.isfinite(), scaled, 0.0))
    # With a unit diagonal, a pivot of the size of rounding errors means that the pose is not determined.
    unknown = (failed > 0) | (L.diagonal(dim1=-2, dim2=-1).square() <= 1e-13).any(-1)
    identity = torch.eye(W.shape[-1], dtype=W.dtype, device=W.device)
    L = torch.where(unknown[..., None, None], identity, L)
    inverted = torch.cholesky_inverse(L) * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    return torch.where(unknown[..., None, None], 0.0, inverted), unknown
