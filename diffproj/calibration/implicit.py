"""Derivatives of the minimum by the data, from the implicit function theorem.

At the minimum the gradient of the cost by the parameters theta is zero for any data d, so that

    d theta / d d = -H^-1 d(gradient) / d d        H = the exact second derivative of the cost

This is the first derivative of `theta - H^-1 gradient(theta, d)` with theta and H detached from the autograd graph. H
has the block structure of the normal equations and is solved by the same Schur complement.
"""

import torch
from torch import Tensor

from diffproj.calibration.bow import bowed
from diffproj.calibration.data import Data
from diffproj.calibration.fit import Fit
from diffproj.calibration.parametrisation import POSE, moved
from diffproj.calibration.solver import Prior
from diffproj.calibration.task import Task
from diffproj.targets.residuals import projected_minus_seen, put_back_minus_known


def differentiated(found: Fit, data: Data, prior: Prior | None) -> Fit:
    """The same fit, with shared parameters and poses differentiable by pixels, points, weights and prior."""
    sources = [data.given_pixels, data.given_points, data.given_weights, *(prior or ())]
    if not any(source is not None and source.requires_grad for source in sources):
        return found
    task, solution = found.task, found.solution
    P, V = task.pixels.shape[:2]
    s = len(task.names)
    pixels = data.given_pixels.reshape(task.pixels.shape)
    weights = None if data.given_weights is None else data.given_weights.reshape(task.used.shape)
    with torch.enable_grad():
        # Each view has its own copy of the shared parameters: one backward pass gives a row of every view's block.
        theta = solution.shared.new_zeros(P, V, s + POSE, requires_grad=True)
        cost = _costs(task, solution.shared.unsqueeze(1) + theta[..., :s], theta[..., s:], pixels, data, weights, found)
        gradient = torch.autograd.grad(cost.sum(), theta, create_graph=True)[0]
        H = torch.stack(
            [torch.autograd.grad(gradient[..., i].sum(), theta, retain_graph=True)[0] for i in range(s + POSE)], dim=-2
        ).detach()
        share = torch.ones_like(H[..., :1, :1]) if task.shares is None else task.shares[..., None, None]
        U, g = (share * H[..., :s, :s]).sum(1), (share.squeeze(-1) * gradient[..., :s]).sum(1)
        if prior is not None:
            U = U + prior.precision.detach()
            g = g + (prior.precision @ (solution.shared - prior.mean).unsqueeze(-1)).squeeze(-1)
        E, W, h = H[..., :s, s:], H[..., s:, s:], gradient[..., s:]
        if task.basis is not None:
            T = task.basis.mT
            U, E, g = T @ U @ task.basis, T.unsqueeze(1) @ E, (T @ g.unsqueeze(-1)).squeeze(-1)
        # An unused view has W = 0 and h = 0: its pose has no gradient.
        unused = ~task.used.any(-1)[..., None, None] * torch.eye(POSE, dtype=W.dtype, device=W.device)
        F = torch.linalg.solve_ex((W + unused).mT, E.mT)[0].mT
        S = U - (share * (F @ E.mT)).sum(1)
        reduced = g - (share * (F @ h.unsqueeze(-1))).squeeze(-1).sum(1)
        dx = -torch.linalg.solve_ex(S, reduced.unsqueeze(-1))[0]
        dz = -torch.linalg.solve_ex(W + unused, h.unsqueeze(-1) + E.mT @ dx.unsqueeze(1))[0].squeeze(-1)
        if task.basis is not None:
            dx = task.basis @ dx
        shared = solution.shared + _gradient_only(dx.squeeze(-1))
        local = moved(solution.local, _gradient_only(dz))
    return Fit(task, solution._replace(shared=shared, local=local), found.rejected)


def _gradient_only(step: Tensor) -> Tensor:
    """Zero, with the derivative of the step: the solver's minimum keeps its value to the bit."""
    return step - step.detach()


def _costs(
    task: Task, shared: Tensor, step: Tensor, pixels: Tensor, data: Data, weights: Tensor | None, found: Fit
) -> Tensor:
    """The cost of each view `(P, V)`, differentiable by shared `(P, V, s)`, pose step, pixels, points and weights."""
    flat = shared.flatten(0, 1)
    local = tuple(z.unsqueeze(1) for z in moved(found.solution.local, step))
    cameras = task.parameters.unpack(flat, tuple(z.flatten(0, 2).unsqueeze(1) for z in local))
    centred = data.frame.own(data.given_points)
    points = bowed(centred, flat[:, None, -2:]) if task.bow else centred.expand(len(flat), 1, -1, 3)
    seen = torch.where(task.used.unsqueeze(-1), pixels, 0.0).flatten(0, 1).unsqueeze(1)
    error = put_back_minus_known if task.objective == "plane" else projected_minus_seen
    residual, _ = error(cameras, points, seen, task.used.flatten(0, 1).unsqueeze(1))
    if task.whitening is not None:
        residual = (task.whitening.flatten(0, 1).unsqueeze(1) @ residual.unsqueeze(-1)).squeeze(-1)
    squared = residual[..., :2].square().sum(-1)
    value = squared if task.loss is None else task.loss.value(squared)
    if weights is not None:
        value = value * weights.flatten(0, 1).unsqueeze(1)
    return value.sum((-2, -1)).unflatten(0, task.used.shape[:2]) / 2
