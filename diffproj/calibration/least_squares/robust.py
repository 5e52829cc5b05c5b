"""How much robust losses change the covariance, where residuals are over their deviations.

With scores `rho' e`, the covariance of an estimate is `H^-1 M H^-1`, with `H = a J^T J` and `M = q J^T J`: a is the
mean slope of the score and q its mean square, both per component. For normal residuals of variance 1 they are
integrals; outliers bound away from that, so that what the residuals themselves say counts where it is worse.
"""

import torch
from torch import Tensor

from diffproj.calibration.least_squares.losses import Loss, slope_and_bend

FARTHEST, NODES = 12.0, 4001
"""Where the integral over the length of a normal residual ends, and how many values it takes."""


def robust_factors(loss: Loss | None, residuals: Tensor) -> tuple[Tensor, Tensor]:
    """`a` and `q` `(P,)` for residuals `(P, M, k)` over their deviations; both 1 for least squares."""
    P, M, k = residuals.shape
    one = residuals.new_ones(P)
    if loss is None or M == 0:
        return one, one
    r = torch.linspace(0, FARTHEST, NODES, dtype=residuals.dtype, device=residuals.device)
    density = r ** (k - 1) * (-r.square() / 2).exp()
    expected = _means(loss, r.square(), density / density.sum(), k)
    found = _means(loss, residuals.detach().square().sum(-1), one.new_full((P, M), 1 / M), k)
    worse = found[1] / found[0].square() > expected[1] / expected[0].square()
    return torch.where(worse, found[0], expected[0]), torch.where(worse, found[1], expected[1])


def _means(loss: Loss, squared: Tensor, weight: Tensor, k: int) -> tuple[Tensor, Tensor]:
    slope, bend = slope_and_bend(loss, squared)
    a = (weight * (slope + 2 / k * bend * squared)).sum(-1).clamp(min=1e-3)
    return a, (weight * slope.square() * squared).sum(-1) / k
