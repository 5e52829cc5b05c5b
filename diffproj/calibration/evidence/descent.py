"""From the camera that `adjust` is given to the minimum: which start, the solver, and derivatives of where it ended."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj._core.numerics import gradient_only
from diffproj.calibration.evidence.knowledge import Knowledge
from diffproj.calibration.evidence.observation import Observation
from diffproj.calibration.evidence.observations import Seen
from diffproj.calibration.evidence.pose_parameters import PoseParameters
from diffproj.calibration.evidence.problem import Evidence, Losses
from diffproj.calibration.evidence.undetermined import natural
from diffproj.calibration.least_squares.solver import Prior, Status, solve
from diffproj.calibration.problem.constraints import ratio_only
from diffproj.geometry.camera import Camera

NEGLIGIBLE = 1e-18
"""Cost, in squared deviations, that counts as zero: of evidence without noise."""
FAR_OFF = 1e3
"""Distance from the origin, in that of what was seen, from which on places round enough to be felt."""
TOLERANCE, ROUNDING = 1e-13, 1e-12
"""Part of the cost that another step may still bring, and that rounding may."""
ROBUST_STEPS, NEWTON = 40, 20
"""Steps of reweighting, which shrink slowly under a robust loss, before at most so many of Newton's."""
PROFILE_STEPS = 20
"""Steps to the least cost with one direction held."""
FEW = 8
"""Steps of a first look, before the best of several starts is followed to its minimum."""
RESTRAINT = 1e-8
"""Weight of the start on each parameter in its natural unit: so small that it decides only what nothing else does."""


@dataclass(frozen=True)
class Task:
    """What is to be found of P cameras of batch shape `*B`.

    Attributes:
        pieces: the observations.
        camera: the given one, with its graph.
        batch: `*B`.
        known: which parameters move, and what is known of them.
    """

    pieces: tuple[Observation, ...]
    camera: Camera
    batch: tuple[int, ...]
    known: Knowledge

    def own(self) -> Tensor:
        """The camera's values `(P, q)`, with their graph."""
        R = self.camera.R.reshape(-1, 3, 3)
        packed = self.known.parameters(R).pack(self.camera)
        return packed.reshape(-1, packed.shape[-1])

    def evidence(
        self, parameters: PoseParameters, more: tuple[int, ...] = (), columns: Sequence[int] | None = None
    ) -> Evidence:
        """The problem, with an axis of starts in front of the batch."""
        columns = self.known.columns if columns is None else columns
        return Evidence(self.pieces, parameters, (*more, *self.batch), self.camera.size, tuple(columns))


class Rival(NamedTuple):
    """Another minimum of P cameras.

    Attributes:
        above: how much more it costs `(P,)`; infinite where there is none.
        R: `(P, 3, 3)`.
        place: of the camera `(P, 3)`.
    """

    above: Tensor
    R: Tensor
    place: Tensor


@dataclass(frozen=True)
class Found:
    """Where the solver ended.

    Attributes:
        parameters: with the rotations that turns are about.
        basis: of the directions in which they move `(P, q, r)`.
        prior: on the parameters.
        values: `(P, q)`.
        status: `(P,)`.
        iterations: `(P,)`.
        cost: `(P,)`.
        rival: the minimum at the other pose, where it was looked for.
    """

    parameters: PoseParameters
    basis: Tensor
    prior: Prior
    values: Tensor
    status: Tensor
    iterations: Tensor
    cost: Tensor
    rival: Rival | None = None


def descended(task: Task, R: Tensor, begin: Tensor, prior: Prior, more: tuple[int, ...], steps: int) -> Found:
    """The minimum that the solver reaches from values `(P, q)`, whose turns are about rotations `(P, 3, 3)`.

    `more` is the shape of the starts that stand in front of the batch of cameras.
    """
    parameters = task.known.parameters(R)
    evidence = task.evidence(parameters, more)
    basis = task.known.basis(begin)
    loss = _losses(task, evidence, begin)
    found = solve(
        evidence,
        begin,
        (),
        local_size=0,
        loss=loss,
        prior=_restrained(task, begin, prior),
        basis=basis,
        max_iterations=steps if loss is None else min(steps, ROBUST_STEPS),
        tolerance=TOLERANCE,
        negligible=_negligible(evidence, begin, reach(task, begin)),
    )
    ended = Found(parameters, basis, prior, found.shared, found.status, found.iterations, found.cost)
    return ended if loss is None or steps <= FEW else _polished(task, ended, more)


def profile(task: Task, found: Found, starts: Tensor, basis: Tensor) -> Tensor:
    """The least cost `(K, P)` from K starts each `(K, P, q)` where only what a basis `(P, q, r)` spans moves."""
    K, P = starts.shape[:2]
    R = found.parameters.start
    parameters = found.parameters if R is None else replace(found.parameters, start=R.repeat(K, 1, 1))
    evidence = task.evidence(parameters, (K,))
    prior = Prior(*(part.repeat(K, *(1,) * (part.ndim - 1)) for part in found.prior[:2]))
    ended = solve(
        evidence,
        starts.flatten(0, 1),
        (),
        local_size=0,
        loss=_losses(task, evidence, starts.flatten(0, 1)),
        prior=prior,
        basis=basis.repeat(K, 1, 1),
        max_iterations=PROFILE_STEPS,
        negligible=1e-3,
        tolerance=1e-3,
    )
    return torch.where(ended.cost.isfinite(), ended.cost, torch.inf).reshape(K, P)


def _losses(task: Task, evidence: Evidence, values: Tensor) -> Losses | None:
    """The robust losses of all pieces as one; `None` where none has one."""
    losses = [getattr(piece, "loss", None) for piece in task.pieces]
    if all(one is None for one in losses):
        return None
    counts = [block.shape[1] for block in evidence.blocks(values)]
    return Losses(tuple(zip(counts, losses, strict=True)))


def _negligible(evidence: Evidence, values: Tensor, distance: Tensor) -> Tensor:
    """The cost `(P,)` that counts as zero: far from the origin, that of the rounding of places."""
    place = values[:, -3:].abs()
    least = torch.full_like(distance, NEGLIGIBLE)
    if not bool((place.amax(-1) > FAR_OFF * distance).any()):
        return least
    slopes = evidence.along(values)[1][[at >= values.shape[-1] - 3 for at in evidence.columns]]
    off = torch.finfo(values.dtype).eps * place.amax(-1) * slopes.square().sum((0, 2, 3)).sqrt()
    return least.maximum(off.square().nan_to_num(0.0, 0.0))


def _restrained(task: Task, begin: Tensor, prior: Prior) -> Prior:
    """The prior with a hair's weight on what nothing tells, which then stays where it began."""
    own = prior.precision.diagonal(dim1=-2, dim2=-1)
    hair = RESTRAINT * natural(begin, reach(task, begin)).square().reciprocal()
    mean = torch.where(own > 0, prior.mean, begin)
    return Prior(mean, torch.diag_embed(torch.where(own > 0, own, hair)))


def _polished(task: Task, found: Found, more: tuple[int, ...]) -> Found:
    """Newton's steps where robust losses slow reweighting down: near the minimum each squares what is left.

    A step that raises the cost, or a curvature that is not positive, leaves a camera where the solver left it.
    """
    values, status, cost = found.values, found.status, found.cost
    prior, T = found.prior, found.basis
    for _ in range(NEWTON):
        now, gradient, H = (part.detach() for part in _second_order(task, found.parameters, T, values, prior, more))
        L, bent = torch.linalg.cholesky_ex(H.nan_to_num())
        step = -torch.cholesky_solve(gradient.unsqueeze(-1), L)
        left = -(gradient.unsqueeze(-2) @ step).flatten() / 2
        sound = (bent == 0) & left.isfinite() & (status != Status.DIVERGED)
        trial = torch.where(sound.unsqueeze(-1), values + (T @ step).squeeze(-1), values)
        after = _cost(task, found.parameters, trial, prior, more)
        better = sound & (after <= now + ROUNDING * now)
        values, cost = torch.where(better.unsqueeze(-1), trial, values), torch.where(better, after, cost)
        done = better & (left <= TOLERANCE * now + NEGLIGIBLE)
        status = torch.where(done, Status.CONVERGED, status)
        if bool((done | ~better).all()):
            break
    return replace(found, values=values, status=status, cost=cost)


def differentiated(task: Task, found: Found) -> Tensor:
    """The values `(P, q)` with their derivatives by everything that carries a graph: see `implicit.py`."""
    T = found.basis
    with torch.enable_grad():
        own = task.own()
        moving = torch.zeros(own.shape[-1], dtype=torch.bool, device=own.device)
        moving[list(task.known.columns)] = True
        base = torch.where(moving, found.values.detach(), own)
        if task.known.tied:  # f_y follows f_x by the camera's own ratio
            turned = ratio_only(own, T)
            base, T = base + turned[..., 0] * found.values[:, :1].detach(), T + turned
        _, gradient, H = _second_order(task, found.parameters, T, base, task.known.prior(own, task.batch))
        step = -torch.linalg.solve_ex(H, gradient.unsqueeze(-1))[0]
        return base + (T.detach() @ gradient_only(step)).squeeze(-1)


def _second_order(
    task: Task, parameters: PoseParameters, T: Tensor, base: Tensor, prior: Prior, more: tuple[int, ...] = ()
) -> tuple[Tensor, Tensor, Tensor]:
    """The cost `(P,)`, its gradient `(P, r)` along a basis, with its graph, and its exact second derivative."""
    with torch.enable_grad():
        theta = base.detach().new_zeros(len(base), T.shape[-1], requires_grad=True)
        cost = _cost(task, parameters, base + (T @ theta.unsqueeze(-1)).squeeze(-1), prior, more)
        gradient = torch.autograd.grad(cost.sum(), theta, create_graph=True)[0]
        rows = [torch.autograd.grad(part.sum(), theta, retain_graph=True)[0] for part in gradient.unbind(-1)]
    return cost, gradient, torch.stack(rows, dim=-2).detach()


def _cost(task: Task, parameters: PoseParameters, values: Tensor, prior: Prior, more: tuple[int, ...]) -> Tensor:
    off = torch.where(prior.precision.diagonal(dim1=-2, dim2=-1) > 0, values - prior.mean, 0.0)
    cost = (off.unsqueeze(-2) @ prior.precision @ off.unsqueeze(-1)).flatten() / 2
    for piece, block in zip(task.pieces, task.evidence(parameters, more).blocks(values), strict=True):
        squared, loss = block.square().sum(-1), getattr(piece, "loss", None)
        cost = cost + (squared if loss is None else loss.value(squared)).sum(-1) / 2
    return cost


def spare(task: Task, found: Found) -> Tensor:
    """How many more residuals and priors there are than unknowns `(P,)`, those of observations among these."""
    blocks = task.evidence(found.parameters).blocks(found.values)
    seen = sum((block.detach() != 0).any(-1).sum(-1) * block.shape[-1] for block in blocks)
    seen = seen - sum(getattr(piece, "own_unknowns", 0) for piece in task.pieces)
    known = (found.prior.precision.detach().diagonal(dim1=-2, dim2=-1) > 0).sum(-1)
    return seen + known - found.basis.shape[-1]


def surveyed(task: Task) -> tuple[Tensor, Tensor]:
    """All surveyed points `(N, 3)` of the observations, and which of them each camera sees `(P, N)`."""
    seen = [piece for piece in task.pieces if isinstance(piece, Seen)]
    K = task.camera.K.detach()
    if not seen:
        P = K.reshape(-1, 3, 3).shape[0]
        return K.new_zeros(0, 3), torch.zeros(P, 0, dtype=torch.bool, device=K.device)
    visible = [piece.visible.to(K.device).expand(*task.batch, -1).reshape(-1, len(piece)) for piece in seen]
    return torch.cat([piece.points.detach().to(K) for piece in seen]), torch.cat(visible, dim=-1)


def reach(task: Task, values: Tensor) -> Tensor:
    """The distance of what was seen `(P,)`: of the surveyed points that were, else the height of the camera.

    Values may be those of several starts in front of the batch of cameras.
    """
    center = values[:, -3:]
    height = center[:, 2].abs().clamp(min=1e-9)
    points, visible = surveyed(task)
    if not bool(visible.any()):
        return height
    far = (points - center.unsqueeze(1)).norm(dim=-1)
    far = torch.where(visible.repeat(len(far) // len(visible), 1), far, torch.nan).nanmedian(-1).values
    return torch.where(far.isnan(), height, far.maximum(1e-3 * height))
