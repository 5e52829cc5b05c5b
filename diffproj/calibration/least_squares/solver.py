"""Batched Levenberg-Marquardt with a Schur complement, for few shared and many small local unknowns.

The solver is independent of cameras. For each problem of a batch of P it minimises, over the shared unknowns x (s
numbers) and V local blocks z_v (l tangent coordinates each),

    F(x, z) = 1/2 sum_vn w_vn rho(|e_vn(x, z_v)|^2) + 1/2 (x - m)^T Q (x - m)

where `e_vn` are residuals of k components, `w` weights, `rho` a robust loss (M-estimator) and the last term a prior.
Let A_v, B_v be the Jacobians of block v's residuals by x and z_v, with each residual's rows scaled by `sqrt(w rho')`
(iteratively reweighted least squares). The damped normal equations are

    U = Q + sum A_v^T A_v     E_v = A_v^T B_v     W_v = B_v^T B_v     g = Q (x - m) + sum A_v^T e_v     h_v = B_v^T e_v

    [ U + lambda diag(U)     E_1 ... E_V          ] [ dx   ]     [ g   ]
    [ E_v^T            W_v + lambda diag(W_v)     ] [ dz_v ] = - [ h_v ]

and the local unknowns are eliminated by the Schur complement S: with the Cholesky factors
`L_v L_v^T = W_v + lambda diag(W_v)`,

    Y_v = L_v^-1 E_v^T     y_v = L_v^-1 h_v     S = U + lambda diag(U) - sum Y_v^T Y_v
    S dx = -(g - sum Y_v^T y_v)                 dz_v = -L_v^-T (Y_v dx + y_v)

so that run time is linear in V, not cubic. Where x is restricted to a basis T (fixed or tied unknowns), `dx = T dq` and
the same equations hold with `A_v T` in place of A_v.

Computed per trial: L_v, Y_v, S, the panel `[A_v B_v e_v]^T` at the new point and, by one batched product, its Gram
matrix, which contains U, E_v, W_v, g, h_v and the cost.

Damping, acceptance and stopping are per problem, and no operation mixes problems: a result is the same to the bit
whether or not another problem of the batch diverges. A step is accepted if the cost does not increase. The exception is
the final step: its predicted reduction is below 10^-8 of the cost, and it is applied without evaluating the cost. How a
problem ended is reported as a `Status`, never as an exception.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffproj.calibration.least_squares.damping import FINAL_STEP_REDUCTION, HEAVY_DAMPING, DampingControl, Status
from diffproj.calibration.least_squares.everyone import Everyone, for_each, pays_to_part, rows
from diffproj.calibration.least_squares.losses import Loss
from diffproj.calibration.least_squares.normal_equations import Equations, damped_step, decoupled_reduction, times

__all__ = ["Status"]  # which comes with the solver wherever it is needed

LocalState = tuple[Tensor, ...]
"""Tensors `(P, V, ...)` with the state of the local blocks, which only the problem interprets."""


@runtime_checkable
class Problem(Protocol):
    """Interface of a batch of P problems."""

    def linearise(self, shared: Tensor, local: LocalState) -> Tensor:
        """The panel `(P, V, s + l + 1, k, N)`, whose rows are derivatives by x, derivatives by z_v, and residuals.

        Not finite where a residual is undefined. The tensor may be overwritten by the next call.
        """
        ...

    def retract(self, local: LocalState, step: Tensor) -> LocalState:
        """Move the local blocks by tangent vectors `(P, V, l)`."""
        ...


@runtime_checkable
class Parted(Protocol):
    """A batch that can go on with some of its problems, where most have come to their end."""

    def part(self, which: Tensor) -> Any:
        """Some of the problems `(n,)`, as a problem of the same kind."""
        ...


@runtime_checkable
class Bordered(Problem, Protocol):
    """A problem with many more shared unknowns, behind the others, each of which few residuals depend on.

    The panel has no rows for them.
    """

    def bordered(
        self, panel: Tensor, local: LocalState, U: Tensor, E: Tensor, g: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """U, E and g with those unknowns, from the weighted panel that the others' blocks are of."""
        ...


@runtime_checkable
class Summed(Protocol):
    """A problem that adds up its normal equations itself, where most of the panel would be zeros.

    Its residuals' weights are its own.
    """

    def equations(self, shared: Tensor, local: LocalState, loss: Loss | None) -> "tuple[Tensor, Equations]":
        """The cost `(P,)` and the undamped normal equations, without a prior; not finite where a residual is not."""
        ...

    def retract(self, local: LocalState, step: Tensor) -> LocalState:
        """Move the local blocks by tangent vectors `(P, V, l)`."""
        ...


class Prior(NamedTuple):
    """`1/2 (x - mean)^T precision (x - mean)`: mean `(P, s)`, precision `(P, s, s)`.

    `known (P, s, s)` is the part of the precision that stands for a measurement; all of it if left out. The rest only
    keeps the minimum where it makes sense: the solver makes no difference, the covariance does.

    `root (P, s, k)` adds `root root^T` to the precision: of a stiff term that is 0 at the minimum, a sum of squares is
    so to rounding, and a quadratic form is not.
    """

    mean: Tensor
    precision: Tensor
    known: Tensor | None = None
    root: Tensor | None = None

    @property
    def whole(self) -> Tensor:
        """All of the precision `(P, s, s)`."""
        return self.precision if self.root is None else self.precision + self.root @ self.root.mT

    def part(self, where: slice | Tensor) -> "Prior":
        """That of some of the problems."""
        known, root = (None if part is None else part[where] for part in (self.known, self.root))
        return Prior(self.mean[where], self.precision[where], known, root)

    def among(self, unknowns: list[int]) -> "Prior":
        """That of some of the unknowns, on which alone it says something."""
        square = (slice(None), torch.tensor(unknowns).unsqueeze(-1), unknowns)
        known = None if self.known is None else self.known[square]
        root = None if self.root is None else self.root[:, unknowns]
        return Prior(self.mean[:, unknowns], self.precision[square], known, root)


class Solution(NamedTuple):
    """The solutions of P problems.

    Attributes:
        shared: x `(P, s)`.
        local: the local blocks.
        cost: F `(P,)` at the last accepted point, before the final step.
        status: `Status` codes `(P,)`.
        iterations: steps evaluated `(P,)`.
        equations: the normal equations, with their robust weights, at that same point.
    """

    shared: Float[Tensor, "p s"]
    local: LocalState
    cost: Float[Tensor, " p"]
    status: Int[Tensor, " p"]
    iterations: Int[Tensor, " p"]
    equations: Equations


def equations_at(
    problem: Problem,
    shared: Float[Tensor, "p s"],
    local: LocalState,
    local_size: int,
    weights: Float[Tensor, "p v n"] | None = None,
    loss: Loss | None = None,
) -> Equations:
    """The normal equations at a point, for all unknowns whether they may move or not."""
    return _Terms(problem, local_size, weights, loss, None).at(shared, local)[1]


@np.errstate(all="ignore")  # infinite and NaN reductions are handled without warnings
def solve(
    problem: Problem | Summed,
    shared: Float[Tensor, "p s"],
    local: LocalState,
    *,
    local_size: int,
    weights: Float[Tensor, "p v n"] | None = None,
    loss: Loss | None = None,
    prior: Prior | None = None,
    basis: Float[Tensor, "p s q"] | None = None,
    max_iterations: int | Int[Tensor, " p"] = 50,
    tolerance: float = 3e-14,
    negligible: float | Float[Tensor, " p"] = 0.0,
    progress: Callable[[int, Tensor], None] | None = None,
) -> Solution:
    """Minimise the cost of every problem.

    Args:
        problem: residuals, Jacobians and retraction.
        shared: initial x `(P, s)`; s may be 0.
        local: initial local blocks.
        local_size: l.
        weights: of the residuals `(P, V, N)`, not negative; 1 if left out.
        loss: a robust loss; least squares if left out.
        prior: on the shared unknowns.
        basis: spans the directions in which x may move; all if left out.
        max_iterations: maximum number of steps; one for all problems, or for each.
        tolerance: of convergence: the relative reduction of the cost that the step after the current one would bring,
            extrapolated from the ratio of the last two predicted reductions.
        negligible: a cost, in the cost's unit, that counts as zero; one for all problems, or for each.
        progress: called after each step with its number, from 1, and the costs `(P,)`.

    Returns:
        The solution, with a `Status` for each problem.
    """
    every = basis is None or basis.shape[-1] > 0  # where no shared unknown moves, those of the panel are enough
    terms = _Terms(problem, local_size, weights, loss, prior, every)
    cost, equations = terms.at(shared, local)
    state = _State(shared, local, cost, equations)
    negligible = negligible if isinstance(negligible, Tensor) else torch.full_like(cost, negligible)
    limits = for_each(max_iterations, cost).numpy(force=True)
    control = DampingControl(_array(cost), _array(negligible), limits)
    everyone = Everyone(state, control)
    parts = isinstance(problem, Parted)
    for iteration in range(1, int(limits.max(initial=0)) + 1):
        dx, dz, reduction = damped_step(state.equations, torch.from_numpy(control.damping).to(cost), basis)
        predicted = _array(reduction)
        trial: tuple[Tensor, LocalState] = (state.shared + dx, problem.retract(state.local, dz))
        # Heavy damping makes every predicted reduction small: convergence is then judged by the gradient.
        heavy, expected = control.damping > HEAVY_DAMPING, predicted
        if heavy.any():
            expected = np.where(heavy, _array(decoupled_reduction(state.equations, basis)), predicted)
        done = control.stop(expected, tolerance)
        if done.any():
            # The final step still improves the unknowns, but its reduction is negligible: apply without evaluating it.
            last = done & (predicted <= FINAL_STEP_REDUCTION * control.cost)
            x, z = select(last, trial, (state.shared, state.local))
            state = state._replace(shared=x, local=z)
        if not control.active.any():
            break
        if parts and pays_to_part(control):
            which = torch.from_numpy(np.flatnonzero(control.active)).to(cost.device)
            everyone.keep(state, control, which)
            state, trial = rows(state, which), rows(trial, which)
            problem, basis = problem.part(which), None if basis is None else basis[which]  # type: ignore[union-attr]
            weights, prior = None if weights is None else weights[which], None if prior is None else prior.part(which)
            predicted, control = predicted[control.active], control.part(control.active)
            terms = _Terms(problem, local_size, weights, loss, prior, every)
        trial_cost, trial_equations = terms.at(*trial)
        better = control.accept(_array(trial_cost), predicted)
        state = select(better, _State(*trial, trial_cost, trial_equations), state)
        if progress is not None:
            progress(iteration, everyone.whole(everyone.state.cost, state.cost))
    state, status, iterations = everyone.ends(state, control)
    status, iterations = (torch.from_numpy(end).to(cost.device) for end in (status.astype(np.int64), iterations))
    return Solution(state.shared, state.local, state.cost, status, iterations, state.equations)


class _State(NamedTuple):
    """Where problems are, what that costs, and the equations there."""

    shared: Tensor
    local: LocalState
    cost: Tensor
    equations: Equations


class _Terms:
    """Evaluates the cost and the normal equations at a point."""

    def __init__(
        self,
        problem: Problem | Summed,
        local_size: int,
        weights: Tensor | None,
        loss: Loss | None,
        prior: Prior | None,
        every: bool = True,
    ) -> None:
        self.problem, self.local_size, self.weights, self.loss, self.prior = problem, local_size, weights, loss, prior
        self.border = problem.bordered if every and isinstance(problem, Bordered) else None
        self.linearise = problem.linearise if isinstance(problem, Problem) else None

    def at(self, shared: Tensor, local: LocalState) -> tuple[Tensor, Equations]:
        if self.linearise is not None:
            cost, equations = self._products(self.linearise(shared, local), local)
        else:
            cost, equations = self.problem.equations(shared, local, self.loss)  # type: ignore[union-attr]
        if self.prior is not None:
            off = shared - self.prior.mean
            pull = times(self.prior.precision, off)
            cost = cost + (off * pull).sum(-1) / 2
            if self.prior.root is not None:
                along = times(self.prior.root.mT, off)
                cost, pull = cost + along.square().sum(-1) / 2, pull + times(self.prior.root, along)
            equations = equations._replace(U=equations.U + self.prior.whole, g=equations.g + pull)
        return cost, equations

    def _products(self, panel: Tensor, local: LocalState) -> tuple[Tensor, Equations]:
        robust = None
        if self.weights is not None or self.loss is not None:
            squared = panel[..., -1, :, :].square().sum(-2)
            weights = torch.ones_like(squared) if self.weights is None else self.weights
            if self.loss is not None:
                robust = (weights * self.loss.value(squared)).sum((-2, -1)) / 2
                weights = weights * self.loss.weight(squared)
            panel = panel * weights.sqrt()[:, :, None, None]
        rows = panel.flatten(0, 1).flatten(-2)
        gram = rows.bmm(rows.mT).unflatten(0, panel.shape[:2])
        s = rows.shape[-2] - self.local_size - 1
        totals = gram[..., :s, :].sum(1)
        c = gram[..., -1, -1] / 2
        U, E, g = totals[..., :s], gram[..., :s, s:-1], totals[..., -1]
        if self.border is not None:
            U, E, g = self.border(panel, local, U, E, g)
        cost = c.sum(-1) if robust is None else robust
        return cost, Equations(U, E, gram[..., s:-1, s:-1], g, gram[..., s:-1, -1], c)


def _array(values: Tensor) -> np.ndarray:
    return values.numpy(force=True).astype(np.float64)


def select(mask: np.ndarray, new: Any, old: Any) -> Any:
    """Per problem, `new` where the mask is true, else `old`; for tensors and tuples of tensors."""
    if mask.all():
        return new
    if not mask.any():
        return old
    first = new
    while not isinstance(first, Tensor):
        first = first[0]
    return _chosen(torch.from_numpy(mask).to(first.device), new, old)


def _chosen(mask: Tensor, new: Any, old: Any) -> Any:
    if isinstance(new, Tensor):
        return torch.where(mask.view(-1, *(1,) * (new.ndim - 1)), new, old)
    parts = [_chosen(mask, a, b) for a, b in zip(new, old, strict=True)]
    return type(new)(*parts) if hasattr(new, "_fields") else tuple(parts)
