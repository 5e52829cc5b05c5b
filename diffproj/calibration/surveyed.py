"""Weights of landmarks that are themselves uncertain: what their errors do in the image counts along with the noise.

A landmark whose coordinates have the covariance S is seen `J dX` off, J the derivative of its pixel by the point. So
its residual has the covariance

    C = J S J^T + s^2 I        s the noise of a pixel coordinate

and residuals multiplied by `s C^(-1/2)` have the noise s in every direction, which is what the solver, the error bars
and the tests of a fit work with (errors in variables, to first order; Deming 1943). C depends on the pose, and s, where
it is not known, on the residuals: both are taken anew from the last minimum until they stand.

Of one view that is the whole error. Several views see the same landmark off in the same way, which no weight says:
there the landmarks' places are unknowns that the views share (`free_points.py`).
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.task import Task

FINEST_PX = 0.05
"""Noise of a pixel coordinate that is assumed at least: landmarks' errors alone may explain all residuals."""


def whitening(task: Task, shared: Tensor, local: tuple[Tensor, ...], variance: Tensor) -> Tensor:
    """The matrices `s C^(-1/2)` of each corner `(P, V, N, 2, 2)`.

    Args:
        task: with the landmarks' covariances in their own frame.
        shared: parameters `(P, s)`.
        local: poses.
        variance: of residuals of weight 1 `(P,)`.
    """
    spread = task.points.new_zeros(3, 3) if task.spread is None else task.spread
    panel = replace(task, whitening=None).problem.linearise(shared, local)
    by_point = torch.einsum("pvikn,pvij->pvnkj", panel[:, :, -4:-1], local[0])
    seen = by_point @ spread @ by_point.mT
    each = variance.nan_to_num(0.0).clamp(min=FINEST_PX**2)[:, None, None].expand(task.used.shape)
    if task.weights is not None:
        each = (variance[:, None, None] if task.known_noise else each) / torch.where(task.used, task.weights, 1.0)
    C = seen + torch.diag_embed(each.unsqueeze(-1).expand(*each.shape, 2))
    C = torch.where(task.used[..., None, None], C, torch.eye(2, dtype=C.dtype, device=C.device))
    return each.sqrt()[..., None, None] * torch.linalg.inv(torch.linalg.cholesky(C))
