"""Weights of landmarks that are themselves uncertain: what their errors do in the image counts along with the noise.

A landmark whose coordinates have the covariance S is seen `J dX` off, J the derivative of its pixel by the point. So
its residual has the covariance

    C = J S J^T + s^2 I        s the noise of a pixel coordinate

and residuals multiplied by `s C^(-1/2)` have the noise s in every direction, which is what the solver, the error bars
and the tests of a fit work with (errors in variables, to first order; Deming 1943). C depends on the pose, and s, where
it is not known, on the residuals: both are taken anew from the last minimum until they stand.

Of one view that is the whole error. Several views see the same landmark off in the same way, which no weight says:
there the landmarks' places are unknowns that the views share (`free_points.py`). Where a known camera is located, each
view's pose is its own, whatever else is in the batch, and only its covariance with those of other views tells what they
have in common (`in_common`).
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.task import Task

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


def in_common(task: Task, shared: Tensor, local: tuple[Tensor, ...], inverse_W: Tensor) -> Tensor | None:
    """How each view's pose is moved by the landmarks' errors, as by independent ones of variance 1 `(P, V, 6, 3 N)`.

    Args:
        task: with the landmarks' covariances in their own frame, and the residuals whitened by them.
        shared: parameters `(P, s)`.
        local: poses.
        inverse_W: the covariance of each pose for residuals of variance 1 `(P, V, 6, 6)`.

    Returns:
        `None` where landmarks are exact.
    """
    if task.spread is None or task.whitening is None:
        return None
    panel = task.problem.linearise(shared, local)
    weight = task.used.to(panel) if task.weights is None else task.weights * task.used
    if task.loss is not None:
        weight = weight * task.loss.weight(panel[:, :, -1].square().sum(2))
    by_pose = panel[:, :, -7:-1]  # (P, V, 6, 2, N)
    by_point = torch.einsum("pvikn,pvij->pvjkn", by_pose[:, :, 3:], local[0])
    values, axes = torch.linalg.eigh(task.spread)
    root = axes * values.clamp(min=0).sqrt().unsqueeze(-2)
    pulls = torch.einsum("pvakn,pvjkn,pvn,njm->pvanm", by_pose, by_point, weight, root).flatten(-2)
    return inverse_W @ pulls
