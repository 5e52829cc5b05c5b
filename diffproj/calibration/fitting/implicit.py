"""Derivatives of the minimum by the data, from the implicit function theorem.

At the minimum the gradient of the cost by the parameters theta is zero for any data d, so that

    d theta / d d = -H^-1 d(gradient) / d d        H = the exact second derivative of the cost

This is the first derivative of `theta - H^-1 gradient(theta, d)` with theta and H detached from the autograd graph. H
has the block structure of the normal equations and is solved by the same Schur complement.

Parameters that are held at the camera's own values, and the ratio of focal lengths that are tied, are data as well:
theta and the directions in which it is free to move then follow them, and the cost with these.

That takes a cost which is the same function of parameters and data all the way. Where what is known of the target is
weighed against the noise that the residuals tell, the cost follows its own minimum, and what it would be for other data
is not in its derivatives: `check_differentiable` refuses that.
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj._core.numerics import gradient_only
from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Prior
from diffproj.calibration.problem.bow import bowed
from diffproj.calibration.problem.constraints import of_points, printing_precision, ratio_only
from diffproj.calibration.problem.parametrisation import POSE, moved
from diffproj.calibration.problem.shape import block_diagonal
from diffproj.targets.residuals import projected_minus_seen, put_back_minus_known


def check_differentiable(data: Data, options: Options) -> None:
    """Check that the minimum is that of one cost, whose derivatives tell how it moves with the data.

    Raises:
        ValueError: something known of the target's points is weighed anew after each minimum.
    """
    surveyed, told = data.surveyed(options.shape), data.known_noise and options.loss is None
    if data.spread is not None and not surveyed:
        raise ValueError(
            "differentiable: want several views of landmarks with a sigma, got one, whose corners are weighed by its "
            "pose; or leave out the sigma"
        )
    printed = options.shape == "free" and any(of_points(name) for name in options.priors or ())
    if (surveyed and not told) or (not surveyed and printed and data.weights is None):
        want = (
            "pixel_sigma= and no loss beside landmarks with a sigma"
            if surveyed
            else "pixel_sigma= or weights= beside priors on the target's points"
        )
        raise ValueError(
            f"differentiable: want {want}, got noise that the residuals tell; what is known of the points is weighed "
            "against it, which is in no derivative"
        )


def differentiated(found: Fit, data: Data, prior: Prior | None, options: Options, given: Tensor) -> Fit:
    """The same fit, with shared parameters and poses differentiable by pixels, points, weights and priors.

    And by those that the camera was given with `(P, few)`, where parameters are held at these or tied by them.
    """
    printed = None if data.surveyed(options.shape) else printing_precision(options.priors, data.batch, data.points)
    task, solution = found.task, found.solution
    base, basis = _following(task.basis, solution.shared, given, options.tied_focal)
    sources = [data.given_pixels, data.given_points, data.given_weights, printed, base, *(prior or ())]
    if not any(source is not None and source.requires_grad for source in sources):
        return found
    P, V = task.pixels.shape[:2]
    s = len(task.names)
    pixels = data.given_pixels.reshape(task.pixels.shape)
    weights = None if data.given_weights is None else data.given_weights.reshape(task.used.shape)
    with torch.enable_grad():
        # Each view has its own copy of the shared parameters: one backward pass gives a row of every view's block.
        few, count = task.parameters.few, task.parameters.points
        theta = solution.shared.new_zeros(P, V, few + POSE, requires_grad=True)
        moves = solution.shared.new_zeros(P, V, count, 3, requires_grad=True)
        shared = base.unsqueeze(1) + torch.cat([theta[..., :few], moves.flatten(2)], dim=-1)
        cost = _costs(task, shared, theta[..., few:], pixels, data, weights, found)
        gradient, pulls = torch.autograd.grad(
            cost.sum(), (theta, moves), create_graph=True, allow_unused=True, materialize_grads=True
        )
        H, own = _second(gradient, pulls, theta, moves)
        share = torch.ones_like(H[..., :1, :1]) if task.shares is None else task.shares[..., None, None]
        gradient = torch.cat([gradient[..., :few], pulls.flatten(2), gradient[..., few:]], dim=-1)
        U, g = (share * H[..., :s, :s]).sum(1), (share.squeeze(-1) * gradient[..., :s]).sum(1)
        U[:, few:, few:] = block_diagonal((share.unsqueeze(-1) * own).sum(1))
        if prior is not None:
            U = U + prior.precision.detach()
            g = g + (prior.precision @ (base - prior.mean).unsqueeze(-1)).squeeze(-1)
        if task.restraint is not None:
            U = U + torch.nn.functional.pad(task.restraint.precision, (few, 0, few, 0))
            held = task if printed is None else replace(task, printed=printed)
            g = g + torch.nn.functional.pad(_restraining(held, data.given_points - data.middle, found), (few, 0))
        E, W, h = H[..., :s, s:], H[..., s:, s:], gradient[..., s:]
        if task.basis is not None and basis is not None:
            T = task.basis.mT
            U, E, g = T @ U @ task.basis, T.unsqueeze(1) @ E, (basis.mT @ g.unsqueeze(-1)).squeeze(-1)
        # An unused view has W = 0 and h = 0: its pose has no gradient.
        unused = ~task.used.any(-1)[..., None, None] * torch.eye(POSE, dtype=W.dtype, device=W.device)
        F = torch.linalg.solve_ex((W + unused).mT, E.mT)[0].mT
        S = U - (share * (F @ E.mT)).sum(1)
        reduced = g - (share * (F @ h.unsqueeze(-1))).squeeze(-1).sum(1)
        dx = -torch.linalg.solve_ex(S, reduced.unsqueeze(-1))[0]
        dz = -torch.linalg.solve_ex(W + unused, h.unsqueeze(-1) + E.mT @ dx.unsqueeze(1))[0].squeeze(-1)
        if task.basis is not None:
            dx = task.basis @ dx
        shared = base + gradient_only(dx.squeeze(-1))
        local = moved(solution.local, gradient_only(dz))
    return Fit(task, solution._replace(shared=shared, local=local), found.rejected)


def _following(basis: Tensor | None, shared: Tensor, own: Tensor, tied: bool) -> tuple[Tensor, Tensor | None]:
    """The values `(P, s)` and the basis of their free directions, as they follow the camera's own values `(P, few)`.

    To first order: what no direction moves follows its own value, a tied f_y the ratio of both.
    """
    if basis is None or not own.requires_grad:
        return shared, basis
    few = own.shape[-1]
    held = (basis[:, :few] == 0).all(-1).all(0)
    step = torch.where(held, own - own.detach(), 0.0)
    if tied and not bool(held[:2].any()):
        turned = ratio_only(own, basis)
        basis, step = basis + turned, step + turned[:, :few, 0] * shared[:, :1]
    elif not bool(held.any()):
        return shared, basis
    return shared + torch.nn.functional.pad(step, (0, shared.shape[-1] - few)), basis


def _second(gradient: Tensor, pulls: Tensor, theta: Tensor, moves: Tensor) -> tuple[Tensor, Tensor]:
    """Second derivatives of each view's cost, from the first by `theta (P, V, few + 6)` and `moves (P, V, N, 3)`.

    Returns:
        `(P, V, s + 6, s + 6)`, displacements between the few shared parameters and the pose, without the block of the
        displacements themselves; and that, `(P, V, N, 3, 3)`, for no two points share a residual.
    """

    def rows(of: Tensor) -> tuple[Tensor, Tensor]:
        parts = [
            torch.autograd.grad(
                of[..., i].sum(), (theta, moves), retain_graph=True, allow_unused=True, materialize_grads=True
            )
            for i in range(of.shape[-1])
        ]
        return torch.stack([by_theta for by_theta, _ in parts], dim=-2), torch.stack([by for _, by in parts], dim=2)

    H, cross = (part.detach() for part in rows(gradient))
    cross, few = cross.flatten(3), theta.shape[-1] - POSE  # (P, V, few + 6, 3 N)
    nothing = cross.new_zeros(*cross.shape[:2], cross.shape[-1], cross.shape[-1])
    upper = torch.cat([H[..., :few, :few], cross[..., :few, :], H[..., :few, few:]], dim=-1)
    middle = torch.cat([cross[..., :few, :].mT, nothing, cross[..., few:, :].mT], dim=-1)
    lower = torch.cat([H[..., few:, :few], cross[..., few:, :], H[..., few:, few:]], dim=-1)
    own = rows(pulls)[1].detach().movedim(2, 3) if moves.numel() else moves.new_zeros(*moves.shape, 3)
    return torch.cat([upper, middle, lower], dim=-2), own


def _restraining(task: Task, points: Tensor, found: Fit) -> Tensor:
    """The gradient `(P, 3 N)` of what restrains free points, whose frame follows the target's points `(N, 3)`."""
    held = task.restraint_at(points)
    return (held.precision @ found.displacements().flatten(1).unsqueeze(-1)).squeeze(-1)


def _costs(
    task: Task, shared: Tensor, step: Tensor, pixels: Tensor, data: Data, weights: Tensor | None, found: Fit
) -> Tensor:
    """The cost of each view `(P, V)`, differentiable by shared `(P, V, s)`, pose step, pixels, points and weights."""
    flat = shared.flatten(0, 1)
    local = tuple(z.unsqueeze(1) for z in moved(found.solution.local, step))
    cameras = task.parameters.unpack(flat, tuple(z.flatten(0, 2).unsqueeze(1) for z in local))
    centred = data.frame.own(data.given_points)
    few = task.parameters.few
    points = bowed(centred, flat[:, None, few - 2 : few]) if task.bow else centred.expand(len(flat), 1, -1, 3)
    if task.free:
        points = points + flat[:, few:].unflatten(-1, (1, -1, 3))
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
