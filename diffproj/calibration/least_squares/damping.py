"""Damping, acceptance and stopping of the solver, for each problem of a batch by itself; and how a problem may end."""

from enum import IntEnum

import numpy as np

INITIAL_DAMPING = 1e-6
"""Small, so that from a good start the first steps are nearly Gauss-Newton steps."""
DAMPING_INCREASE, DAMPING_DECREASE = 2.0, 3.0
"""Factors of the damping after the first failure, and (at most) after the first success, in a row."""
FIRST_INCREASE = 10.0
"""Factor after the very first failure, before any success, while the order of magnitude is unknown."""
HEAVY_DAMPING = 1e-3
"""Damping above which the predicted reduction of a step is no measure of the distance from the minimum."""
FINAL_STEP_REDUCTION = 1e-8
"""Predicted reduction, relative to the cost, up to which a step may be the final one, applied without evaluation."""
BEST_CONTRACTION = 0.02
"""Least ratio of successive predicted reductions assumed in extrapolation; convergence near the minimum is linear."""
ROUNDING = 1e-12
"""Rounding error of the cost, a sum of many squares, relative to it."""
RESIDUAL_ROUNDING = 0.1
"""Rounding error of a residual, relative to one that is negligible: small residuals are differences of large numbers,
so that theirs do not shrink with them. Exact corners in a national grid end above what is negligible."""
MIN_DAMPING = 1e-15
MAX_DAMPING = 1e14
"""Beyond this damping, a problem without an acceptable step has diverged."""


class Status(IntEnum):
    """Why the solver stopped."""

    CONVERGED = 0
    """The predicted reduction of the cost is below the tolerance."""
    MAX_ITERATIONS = 1
    """The maximum number of iterations was reached before convergence."""
    DIVERGED = 2
    """No step lowers the cost although its gradient is not zero, or the residuals are not finite at the start."""
    DEGENERATE = 3
    """The data do not determine all unknowns. (Set by the caller, not by the solver.)"""


class DampingControl:
    """Damping, acceptance and stopping per problem, in NumPy, which is faster than PyTorch for a few numbers."""

    def __init__(self, cost: np.ndarray, negligible: np.ndarray, limit: np.ndarray) -> None:
        self.cost, self.negligible, self.limit = cost, negligible, limit
        self.damping = np.full_like(cost, INITIAL_DAMPING)
        self.increase, self.decrease = np.full_like(cost, FIRST_INCREASE), np.full_like(cost, DAMPING_DECREASE)
        self.active = np.isfinite(cost)
        self.status = np.where(self.active, Status.MAX_ITERATIONS, Status.DIVERGED)
        self.iterations = np.zeros(cost.shape, dtype=np.int64)
        self.previous = np.full_like(cost, np.inf)
        self.failed = np.zeros(cost.shape, dtype=bool)

    def part(self, which: np.ndarray) -> "DampingControl":
        """That of some of the problems `(P,)`."""
        other = object.__new__(DampingControl)
        other.__dict__.update({name: of_each[which] for name, of_each in self.__dict__.items()})
        return other

    def stop(self, expected: np.ndarray, tolerance: float) -> np.ndarray:
        """Stop problems that have converged, which are returned; and those with too many steps, or too much damping."""
        self.active &= self.iterations < self.limit
        # The current step will still be applied: the criterion is the reduction of the step after it, extrapolated.
        after = expected * np.minimum(np.maximum(expected / self.previous, BEST_CONTRACTION), 1)
        self.previous = expected
        done = (after <= tolerance * self.cost) & (expected <= max(FINAL_STEP_REDUCTION, tolerance) * self.cost)
        # Where the reduction is below the cost's rounding error, acceptance is random: the first failure ends it.
        rounding = ROUNDING * self.cost + RESIDUAL_ROUNDING * np.sqrt(self.negligible * self.cost)
        done |= (expected <= np.where(self.failed, rounding, 1e-3 * ROUNDING * self.cost)) | (
            self.cost <= self.negligible
        )
        done &= self.active
        stuck = self.active & (self.damping > MAX_DAMPING) & ~done
        self.status[done], self.status[stuck] = Status.CONVERGED, Status.DIVERGED
        self.active &= ~(done | stuck)
        self.iterations += self.active
        return done

    def accept(self, cost: np.ndarray, reduction: np.ndarray) -> np.ndarray:
        """Accept trials that do not increase the cost, and update the damping from the gain ratio (Nielsen 1999).

        The gain ratio is the actual over the predicted reduction: near 1 the damping decreases, well below it stays or
        increases. Successes or failures in a row enlarge the changes; where they alternate, as in a curved valley, the
        changes stay small.
        """
        better = self.active & (cost <= self.cost) & np.isfinite(reduction)  # false where the trial is NaN
        worse = self.failed = self.active & ~better
        model = 1 - (2 * (self.cost - cost) / reduction - 1) ** 3
        factor = np.where(
            better, np.maximum(np.minimum(model, 2), 1 / self.decrease), np.where(worse, self.increase, 1)
        )
        self.damping = np.maximum(self.damping * factor, MIN_DAMPING)
        self.increase = np.where(better, DAMPING_INCREASE, np.where(worse, 2 * self.increase, self.increase))
        self.decrease = np.where(
            better, np.minimum(3 * self.decrease, 1e6), np.where(worse, DAMPING_DECREASE, self.decrease)
        )
        self.cost = np.where(better, cost, self.cost)
        return better
