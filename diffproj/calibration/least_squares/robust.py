"""How much robust losses change the covariance, where residuals are over their deviations.

With scores `rho' e`, the covariance of an estimate is `H^-1 M H^-1`, with `H = a J^T J` and `M = q J^T J`: a is the
mean slope of the score and q its mean square, both per component. For normal residuals of variance 1 they are
integrals; outliers bound away from that, so that what the residuals themselves say counts where it is worse.

An item that the loss hardly counts and noise does not explain is none of these: the estimate lacks it, and what the
loss lets through of its pull goes into the estimate. So it counts by its own score and slope, as a corner does in
`trust/robust_loss.py`, with m near 1 for such an item and near 0 else, the more the loss takes of its squared pull:

    H = a sum (1 - m) J^T J + sum m (rho' J^T J + 2 rho'' (J^T e) (J^T e)^T)
    M = q sum (1 - m) J^T J + sum m rho'^2 (J^T e) (J^T e)^T
"""

import torch
from torch import Tensor

from diffproj.calibration.least_squares.losses import Loss, slope_and_bend

FARTHEST, NODES = 12.0, 4001
"""Where the integral over the length of a normal residual ends, and how many values it takes."""


NOISE = 9.0
"""-2 log of the chance of noise that is as large, at which an item that the loss hardly counts may as well be wrong as
be noise: for two components that of 3 deviations."""


def robust_matrices(loss: Loss | None, residuals: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """`H` and `M` `(P, q, q)` of residuals `(P, M, k)` over their deviations with derivatives `(P, q, M, k)`.

    A residual of 0 is of nothing that was seen.
    """

    def gram(each: Tensor | None = None) -> Tensor:
        weighted = rows if each is None else rows * each[:, None, :, None]
        return weighted.flatten(-2) @ rows.flatten(-2).mT

    if loss is None:
        both = gram()
        return both, both
    e = residuals.detach()
    squared, k = e.square().sum(-1), e.shape[-1]
    slope, bend = slope_and_bend(loss, squared)
    chance = torch.special.gammaincc(torch.full_like(squared, k / 2), squared / 2)
    own = (1 - slope.square()) * (1 - 1 / (1 + (2 * chance.log() / NOISE).square()))
    right = (squared > 0) * (1 - own)
    a, q = robust_factors(loss, residuals, right)
    pulls = (rows * e.unsqueeze(1)).sum(-1)
    # A redescending score's slope along the residual is below 0, which would make it surer than without it.
    along = (2 * bend).maximum(-slope / squared.clamp(min=torch.finfo(slope.dtype).tiny))
    H = a[:, None, None] * gram(right) + gram(own * slope) + (pulls * (own * along).unsqueeze(1)) @ pulls.mT
    M = q[:, None, None] * gram(right) + (pulls * (own * slope.square()).unsqueeze(1)) @ pulls.mT
    return H, M


def robust_factors(loss: Loss | None, residuals: Tensor, counted: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """`a` and `q` `(P,)` for residuals `(P, M, k)` over their deviations; both 1 for least squares.

    Items count alike, or by `counted` `(P, M)`.
    """
    P, M, k = residuals.shape
    one = residuals.new_ones(P)
    if loss is None or M == 0:
        return one, one
    r = torch.linspace(0, FARTHEST, NODES, dtype=residuals.dtype, device=residuals.device)
    density = r ** (k - 1) * (-r.square() / 2).exp()
    expected = _means(loss, r.square(), density / density.sum(), k)
    counted = one.new_ones(P, M) if counted is None else counted
    share = counted / counted.sum(-1, keepdim=True).clamp(min=1)
    found = _means(loss, residuals.detach().square().sum(-1), share, k)
    worse = found[1] / found[0].square() > expected[1] / expected[0].square()
    return torch.where(worse, found[0], expected[0]), torch.where(worse, found[1], expected[1])


def _means(loss: Loss, squared: Tensor, weight: Tensor, k: int) -> tuple[Tensor, Tensor]:
    slope, bend = slope_and_bend(loss, squared)
    a = (weight * (slope + 2 / k * bend * squared)).sum(-1).clamp(min=1e-3)
    return a, (weight * slope.square() * squared).sum(-1) / k
