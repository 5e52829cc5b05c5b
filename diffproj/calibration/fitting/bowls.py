"""The cost of each view by the shared parameters, with its pose eliminated: nearly quadratic, a bowl.

In the blocks of `least_squares/solver.py`, with g and h the gradients of a view's cost: `H = U - E W^-1 E^T` and
`g - E W^-1 h`. Sums of bowls have their lowest place in closed form, so that what other poses, or other groups of
views, would lead to is compared without running the solver.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.task import Task
from diffproj.calibration.problem.parametrisation import POSE, Pose


class Bowls(NamedTuple):
    """Costs of views by q shared parameters, `c + g x + x H x / 2`: `(P, V, q, q)`, `(P, V, q)` and `(P, V)`."""

    H: Tensor
    g: Tensor
    c: Tensor


def bowls(task: Task, shared: Tensor, poses: Pose) -> Bowls:
    """The bowls of the views at shared parameters `(P, s)` and poses `(P, V, ...)`: by the free ones, from there.

    Where a view has none, its cost is infinite; an unused view costs nothing.
    """
    panel = task.problem.linearise(shared, poses)
    squared = panel[:, :, -1].square().sum(2)
    weights = torch.ones_like(squared) if task.weights is None else task.weights
    value = squared if task.loss is None else task.loss.value(squared)
    cost = (value * weights).sum(-1) / 2
    if task.loss is not None:
        weights = weights * task.loss.weight(squared)
    rows = (panel * weights.sqrt()[:, :, None, None]).flatten(-2)
    gram = rows @ rows.mT
    s = gram.shape[-1] - POSE - 1
    U, E, W = gram[..., :s, :s], gram[..., :s, s:-1], gram[..., s:-1, s:-1]
    L, failed = torch.linalg.cholesky_ex(W.nan_to_num())
    Y = torch.linalg.solve_triangular(L, torch.cat([E.mT, gram[..., s:-1, -1:]], dim=-1), upper=False)
    Y, y = Y[..., :-1], Y[..., -1:]
    H, g = U - Y.mT @ Y, (gram[..., :s, -1:] - Y.mT @ y).squeeze(-1)
    c = cost - y.square().sum((-2, -1)) / 2
    if task.basis is not None:
        T = task.basis.unsqueeze(1)
        H, g = T.mT @ H @ T, (T.mT @ g.unsqueeze(-1)).squeeze(-1)
    sound = (failed == 0) & c.isfinite() & g.isfinite().all(-1)
    idle = ~task.used.any(-1)
    shares = torch.ones_like(c) if task.shares is None else task.shares
    shares = torch.where(sound & ~idle, shares, 0.0)
    H, g = (torch.where(sound[..., None], part.flatten(2), 0.0).reshape(part.shape) for part in (H, g))
    c = torch.where(idle, 0.0, torch.where(sound, c * shares, torch.inf))
    return Bowls(H * shares[..., None, None], g * shares.unsqueeze(-1), c)


def of_prior(task: Task, shared: Tensor) -> tuple[Tensor, Tensor]:
    """What the prior adds to the sums of H `(P, q, q)` and g `(P, q)`."""
    s = shared.shape[-1]
    T = torch.eye(s, dtype=shared.dtype, device=shared.device) if task.basis is None else task.basis
    if task.prior is None:
        Q, pull = shared.new_zeros(len(shared), s, s), torch.zeros_like(shared)
    else:
        Q = task.prior.whole
        pull = (Q @ (shared - task.prior.mean).unsqueeze(-1)).squeeze(-1)
    return T.mT @ Q @ T, (T.mT @ pull.unsqueeze(-1)).squeeze(-1)
