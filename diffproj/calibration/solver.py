"""Batched Levenberg-Marquardt with a Schur complement, for few shared and many small local unknowns.

The solver knows no cameras. It minimises, for each of P problems side by side, over the shared unknowns x (s numbers)
and V local blocks z_v (l tangent coordinates each),

    F(x, z) = 1/2 sum_vn w_vn rho(|e_vn(x, z_v)|^2) + 1/2 (x - m)^T Q (x - m)

where `e_vn` are residuals of k components, `w` weights, `rho` a robust loss and the last term a prior. With A_v, B_v
the Jacobians of block v's residuals to x and z_v, each residual's row scaled by `sqrt(w rho')` (reweighting),

    U = Q + sum A_v^T A_v     E_v = A_v^T B_v     W_v = B_v^T B_v     g = Q (x - m) + sum A_v^T e_v     h_v = B_v^T e_v

    [ U + lambda diag(U)     E_1 ... E_V          ] [ dx   ]     [ g   ]
    [ E_v^T            W_v + lambda diag(W_v)     ] [ dz_v ] = - [ h_v ]

and the local unknowns drop out: with the Cholesky factors `L_v L_v^T = W_v + lambda diag(W_v)`,

    Y_v = L_v^-1 E_v^T     y_v = L_v^-1 h_v     S = U + lambda diag(U) - sum Y_v^T Y_v
    S dx = -(g - sum Y_v^T y_v)                 dz_v = -L_v^-T (Y_v dx + y_v)

so that time grows with V, not with its cube. Where x may only move along a basis T (frozen or tied unknowns),
`dx = T dq` and the same equations hold with `A_v T` in the place of A_v.

Computed per accepted point: the panel `[A_v B_v e_v]^T` and, by one batched product, its Gram matrix, which holds U,
E_v, W_v, g, h_v and the cost at once. Per trial: L_v, Y_v, S and a new panel. Nothing else.

Each problem has its own lambda, acceptance and stopping, and no operation mixes problems: a hopeless neighbour changes
no bit of a result. The cost never rises: a step is taken that was tried and found no worse, but for the last one, which
promises less than a part in 10^8 and is not tried. How each ended is a `Status`, never an exception.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffproj.calibration.losses import Loss

FIRST_DAMPING = 1e-6
"""Small, so that a good start is met with Newton's own steps."""
FIRST_RISE, FIRST_FALL = 2.0, 3.0
"""By how much a first failure raises the damping, and a first success may lower it."""
SEARCHING = 10.0
"""By how much the very first failure raises it, as long as nothing is known of its size."""
HEAVY_DAMPING = 1e-3
"""Damping under which a step says nothing of how far the minimum is."""
LAST_PROMISE = 1e-8
"""A step that promises to lower the cost by less than this part of it may be the last one."""
FASTEST = 0.02
"""By how much promises shrink from step to step at best, as far as is believed: near the end they do so evenly."""
ROUNDING = 1e-12
"""The part of the cost below which a sum of many squares is rounding."""
SMALLEST_DAMPING = 1e-15
LARGEST_DAMPING = 1e14
"""Where no step lowers the cost even with this, none will."""
LocalState = tuple[Tensor, ...]
"""Tensors `(P, V, ...)` that say where the local blocks are; only the problem knows what they mean."""


class Status(IntEnum):
    """How a problem ended."""

    CONVERGED = 0
    """No step promises to lower the cost by more than the tolerance."""
    MAX_ITERATIONS = 1
    """It was still falling when the iterations ended."""
    DIVERGED = 2
    """No step lowers the cost although its gradient is not zero, or the residuals are not finite at the start."""
    DEGENERATE = 3
    """There is a lowest cost, but the data do not determine the unknowns. (Said by the caller, who knows them.)"""


@runtime_checkable
class Problem(Protocol):
    """What the solver asks of P problems side by side."""

    def linearise(self, shared: Tensor, local: LocalState) -> Tensor:
        """The panel `(P, V, s + l + 1, k, N)`: derivatives to x, derivatives to z_v, and the residuals, as rows.

        Not finite where the residuals have no value; the tensor may be overwritten by the next call.
        """
        ...

    def retract(self, local: LocalState, step: Tensor) -> LocalState:
        """Move the local blocks by tangent vectors `(P, V, l)`."""
        ...


class Prior(NamedTuple):
    """`1/2 (x - mean)^T precision (x - mean)`: mean `(P, s)`, precision `(P, s, s)`."""

    mean: Tensor
    precision: Tensor


class Equations(NamedTuple):
    """The undamped normal equations at a point, before any basis: U `(P, s, s)`, E, W, g and h as above.

    `c (P, V)` is what each block adds to the cost, with the weights and without rho.
    """

    U: Tensor
    E: Tensor
    W: Tensor
    g: Tensor
    h: Tensor
    c: Tensor

    def along(self, basis: Tensor | None) -> "Equations":
        """The same equations for shared unknowns that move along a basis `(P, s, q)`."""
        if basis is None:
            return self
        T = basis.mT
        return Equations(T @ self.U @ basis, T.unsqueeze(1) @ self.E, self.W, _times(T, self.g), self.h, self.c)


class Solution(NamedTuple):
    """Where the problems ended; tensors have P in front.

    Attributes:
        shared: x `(P, s)`.
        local: the local blocks.
        cost: F `(P,)`, as it was before the last step, which was not tried.
        status: `Status` codes `(P,)`.
        iterations: steps tried `(P,)`.
        equations: the normal equations at the same place, with the last weights.
    """

    shared: Float[Tensor, "p s"]
    local: LocalState
    cost: Float[Tensor, " p"]
    status: Int[Tensor, " p"]
    iterations: Int[Tensor, " p"]
    equations: Equations


@np.errstate(all="ignore")  # infinite and undefined promises are looked at, not warned of
def solve(
    problem: Problem,
    shared: Float[Tensor, "p s"],
    local: LocalState,
    *,
    local_size: int,
    weights: Float[Tensor, "p v n"] | None = None,
    loss: Loss | None = None,
    prior: Prior | None = None,
    basis: Float[Tensor, "p s q"] | None = None,
    max_iterations: int = 50,
    tolerance: float = 3e-14,
    negligible: float = 0.0,
    progress: Callable[[int, Tensor], None] | None = None,
) -> Solution:
    """Minimise the cost of every problem.

    Args:
        problem: residuals, Jacobians and retraction.
        shared: the start, x `(P, s)`; s may be 0.
        local: the start of the local blocks.
        local_size: l.
        weights: `(P, V, N)`, not negative; 1 everywhere if left out.
        loss: a robust loss; least squares if left out.
        prior: on the shared unknowns.
        basis: the directions in which x may move; all if left out.
        max_iterations: steps to try at most.
        tolerance: a problem has converged when the step after the next, as its steps shrink, will lower the cost by no
            more than this part.
        negligible: a cost, in the cost's unit, that counts as zero.
        progress: called after each step with its number, from 1, and the costs `(P,)`.

    Returns:
        The solution; see `Status` for how a problem may end.
    """
    terms = _Terms(problem, local_size, weights, loss, prior)
    cost, equations = terms.at(shared, local)
    pace = _Pace(_array(cost))
    for iteration in range(1, max_iterations + 1):
        along = equations.along(basis)
        q, dz, promise = damped_step(along, torch.from_numpy(pace.damping).to(cost))
        dx = q if basis is None else _times(basis, q)
        trial = shared + dx, problem.retract(local, dz)
        promised = _array(promise)
        # A heavily damped step promises little anywhere: then it is the gradient that has to be negligible.
        heavy = pace.damping > HEAVY_DAMPING
        prospect = np.where(heavy, _array(_alone(along)), promised) if heavy.any() else promised
        done = pace.settle(prospect, tolerance, negligible)
        if done.any():
            # The last step promises hardly anything and brings the unknowns nearer still: it is not tried.
            last = done & (promised <= LAST_PROMISE * pace.cost)
            shared, local = chosen(last, trial, (shared, local))
        if not pace.active.any():
            break
        trial_cost, trial_equations = terms.at(*trial)
        better = pace.learn(_array(trial_cost), promised)
        state, new = (shared, local, cost, equations), (*trial, trial_cost, trial_equations)
        shared, local, cost, equations = chosen(better, new, state)
        if progress is not None:
            progress(iteration, cost)
    ends = pace.status.astype(np.int64), pace.iterations
    status, iterations = (torch.from_numpy(end).to(cost.device) for end in ends)
    return Solution(shared, local, cost, status, iterations, equations)


class _Pace:
    """Damping, acceptance and stopping of each problem: a few numbers for each, kept where Python reaches them fast."""

    def __init__(self, cost: np.ndarray) -> None:
        self.cost = cost
        self.damping = np.full_like(cost, FIRST_DAMPING)
        self.rise, self.fall = np.full_like(cost, SEARCHING), np.full_like(cost, FIRST_FALL)
        self.active = np.isfinite(cost)
        self.status = np.where(self.active, Status.MAX_ITERATIONS, Status.DIVERGED)
        self.iterations = np.zeros(cost.shape, dtype=np.int64)
        self.before = np.full_like(cost, np.inf)
        self.failed = np.zeros(cost.shape, dtype=bool)

    def settle(self, prospect: np.ndarray, tolerance: float, negligible: float) -> np.ndarray:
        """Stop those that have nothing left to gain, which are returned, and those that are stuck."""
        # The step at hand is taken at the end: what counts is what the one after it would bring, as promises shrink.
        after = prospect * np.clip(prospect / self.before, FASTEST, 1)
        self.before = np.where(self.active, prospect, self.before)
        small = (after <= tolerance * self.cost) & (prospect <= LAST_PROMISE * self.cost)
        # Where a promise is rounding of the cost, whether a trial is better is chance: a failure ends it.
        exhausted = (self.failed & (prospect <= ROUNDING * self.cost)) | (prospect <= 1e-3 * ROUNDING * self.cost)
        done = self.active & (small | exhausted | (self.cost <= negligible))
        stuck = self.active & ~done & (self.damping > LARGEST_DAMPING)
        self.status[done], self.status[stuck] = Status.CONVERGED, Status.DIVERGED
        self.active &= ~(done | stuck)
        self.iterations += self.active
        return done

    def learn(self, cost: np.ndarray, promise: np.ndarray) -> np.ndarray:
        """Which of the active problems accept the trial; their damping follows from how true the promise was.

        After Nielsen 1999: a step that went as the quadratic model said lowers the damping, a poor one keeps or raises
        it. Successes and failures in a row gather pace; in a bent valley, where they alternate, both are small.
        """
        better = self.active & (cost <= self.cost) & np.isfinite(promise)  # false where the trial is NaN
        worse = self.failed = self.active & ~better
        model = 1 - (2 * (self.cost - cost) / promise - 1) ** 3
        factor = np.where(better, np.maximum(np.minimum(model, 2), 1 / self.fall), np.where(worse, self.rise, 1))
        self.damping = np.maximum(self.damping * factor, SMALLEST_DAMPING)
        self.rise = np.where(better, FIRST_RISE, np.where(worse, 2 * self.rise, self.rise))
        self.fall = np.where(better, np.minimum(3 * self.fall, 1e6), np.where(worse, FIRST_FALL, self.fall))
        self.cost = np.where(better, cost, self.cost)
        return better


def damped_step(equations: Equations, damping: Float[Tensor, " p"]) -> tuple[Tensor, Tensor, Tensor]:
    """One step of the block equations.

    Args:
        equations: along the basis.
        damping: lambda `(P,)`.

    Returns:
        `(dx, dz, promise)`: the step `(P, q)` and `(P, V, l)`, and by how much the quadratic model falls along it
        `(P,)`. Zero, zero and infinite where the matrices are not positive definite.
    """
    U, E, W, g, h, _ = equations
    D, D_local = (_positive(M.diagonal(dim1=-2, dim2=-1)) for M in (U, W))
    lam = damping.unsqueeze(-1)
    L, local_failed = torch.linalg.cholesky_ex(_with_diagonal(W, lam.unsqueeze(-1) * D_local))
    Y = torch.linalg.solve_triangular(L, torch.cat([E.mT, h.unsqueeze(-1)], dim=-1), upper=False)
    Y, y = Y[..., :-1], Y[..., -1:]
    flat = Y.flatten(1, 2)
    S = torch.baddbmm(_with_diagonal(U, lam * D), flat.mT, flat, alpha=-1)
    reduced = g - _times(flat.mT, y.flatten(1))
    L_shared, failed = torch.linalg.cholesky_ex(S)
    dx = -torch.cholesky_solve(reduced.unsqueeze(-1), L_shared)
    dz = -torch.linalg.solve_triangular(L.mT, Y @ dx.unsqueeze(1) + y, upper=True).squeeze(-1)
    dx = dx.squeeze(-1)
    descent = -(g * dx).sum(-1) - (h * dz).sum((-2, -1))
    promise = (descent + damping * ((D * dx.square()).sum(-1) + (D_local * dz.square()).sum((-2, -1)))) / 2
    sound = (failed == 0) & (local_failed == 0).all(-1) & promise.isfinite()
    return (
        torch.where(sound.unsqueeze(-1), dx, 0.0),
        torch.where(sound[:, None, None], dz, 0.0),
        torch.where(sound, promise, torch.inf),
    )


def _alone(equations: Equations) -> Tensor:
    """By how much the model would fall if every unknown moved alone, a size of the gradient that no damping shrinks."""
    U, _, W, g, h, _ = equations
    D, D_local = (_positive(M.diagonal(dim1=-2, dim2=-1)) for M in (U, W))
    return ((g.square() / D).sum(-1) + (h.square() / D_local).sum((-2, -1))) / 2


class _Terms:
    """The cost and its normal equations at a point."""

    def __init__(
        self, problem: Problem, local_size: int, weights: Tensor | None, loss: Loss | None, prior: Prior | None
    ) -> None:
        self.problem, self.local_size, self.weights, self.loss, self.prior = problem, local_size, weights, loss, prior

    def at(self, shared: Tensor, local: LocalState) -> tuple[Tensor, Equations]:
        panel = self.problem.linearise(shared, local)
        robust = None
        if self.weights is not None or self.loss is not None:
            squared = panel[..., -1, :, :].square().sum(-2)
            weights = torch.ones_like(squared) if self.weights is None else self.weights
            if self.loss is not None:
                robust = (weights * self.loss.value(squared)).sum((-2, -1)) / 2
                weights = weights * self.loss.weight(squared)
            panel = panel * weights.sqrt()[:, :, None, None]
        rows = panel.flatten(-2)
        gram = rows @ rows.mT
        s = rows.shape[-2] - self.local_size - 1
        totals = gram[..., :s, :].sum(1)
        c = gram[..., -1, -1] / 2
        cost = c.sum(-1) if robust is None else robust
        U, g = totals[..., :s], totals[..., -1]
        if self.prior is not None:
            off = shared - self.prior.mean
            pull = _times(self.prior.precision, off)
            cost, U, g = cost + (off * pull).sum(-1) / 2, U + self.prior.precision, g + pull
        return cost, Equations(U, gram[..., :s, s:-1], gram[..., s:-1, s:-1], g, gram[..., s:-1, -1], c)


def _with_diagonal(matrix: Tensor, addition: Tensor) -> Tensor:
    sum_ = matrix.clone()
    sum_.diagonal(dim1=-2, dim2=-1).add_(addition)
    return sum_


def _positive(diagonal: Tensor) -> Tensor:
    """What damping scales with; 1 for an unknown that nothing depends on, whose step is then 0."""
    return torch.where(diagonal > 0, diagonal, 1.0)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _array(values: Tensor) -> np.ndarray:
    return values.detach().to("cpu", torch.float64).numpy().copy()


def chosen(mask: np.ndarray, new: Any, old: Any) -> Any:
    """Problem by problem, `new` where the mask is true; for a tensor or a tuple of such."""
    if mask.all():
        return new
    if not mask.any():
        return old
    if isinstance(new, Tensor):
        where = torch.from_numpy(mask).to(new.device).reshape(-1, *(1,) * (new.ndim - 1))
        return torch.where(where, new, old)
    parts = [chosen(mask, a, b) for a, b in zip(new, old, strict=True)]
    return type(new)(*parts) if hasattr(new, "_fields") else tuple(parts)
