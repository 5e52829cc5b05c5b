"""What each corner says at a minimum: its derivatives, its residual, its weight, and under a robust loss its score.

With the residual e of a corner, its derivatives J and the loss rho, the score is `rho' J^T e`, and the derivative of
that by the parameters

    rho' J^T J + 2 rho'' (J^T e) (J^T e)^T      rho' across the residual, rho' + 2 rho'' e^2 along it.
"""

from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.least_squares.losses import slope_and_bend

LEAST_SLOPE = 1e-3
"""Mean derivative of the score below which a loss holds all corners for wrong."""


class Moments(NamedTuple):
    """Means over the corners of a camera `(P,)`.

    Attributes:
        slope: a, the mean derivative of the score by the residual.
        noise: `q / a^2`, q the sum of the squared scores over the degrees of freedom: the variance of noise
            of the same effect; NaN without degrees of freedom.
        variance: the same for the parameters, `k^2 q / a^2`, larger since a is of few (Huber 1981, section 7.6).
    """

    slope: Tensor
    noise: Tensor
    variance: Tensor


class CornerScores:
    """Of the corners of P cameras.

    Attributes:
        residual: `(P, V, 2, N)`.
        weight: `(P, V, N)`.
        squared: `e^2 (P, V, N)`, without weights, as the loss sees it.
        counted: how much each corner counts `(P, V, N)`: those of views that are alike, as one.
    """

    def __init__(self, found: Fit) -> None:
        task, self._found = found.task, found
        self._panel = task.problem.linearise(*state_of(found))
        self.residual = self._panel[:, :, -1]
        self.squared = self.residual.square().sum(2)
        self.weight = torch.ones_like(self.squared) if task.weights is None else task.weights
        used = task.used.to(self.squared)
        self.counted = used if task.shares is None else used * task.shares.unsqueeze(-1)
        self.slope, self.bend = slope_and_bend(task.loss, self.squared)

    @cached_property
    def rows(self) -> Tensor:
        """J, by the shared parameters and the pose `(P, V, s + 6, 2, N)`."""
        return self._found.task.problem.every_row(self._panel, state_of(self._found)[1])[:, :, :-1]

    @cached_property
    def pulls(self) -> Tensor:
        """`J^T e (P, V, s + 6, N)`."""
        return (self.rows * self.residual.unsqueeze(2)).sum(3)

    def moments(self, counted: Tensor, spare: Tensor) -> Moments:
        """Means over corners that count that much `(P, V, N)`, with so many degrees of freedom `(P,)`."""
        n = counted.sum((-2, -1)).clamp(min=1)

        def mean(values: Tensor) -> Tensor:
            return (values * counted).sum((-2, -1)) / n

        along = self.bend * self.squared
        a = mean(self.slope + along).clamp(min=LEAST_SLOPE)
        a_squared = mean(self.slope.square() + 2 * self.slope * along + 2 * along.square())
        k = 1 + (1 - spare / (2 * n)) * (a_squared / a.square() - 1).clamp(min=0)
        squares = (self.weight * self.slope.square() * self.squared * counted).sum((-2, -1))
        noise = torch.where(spare > 0, squares / spare, torch.nan) / a.square()
        return Moments(a, noise, k.square() * noise)


def state_of(found: Fit) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Shared parameters and poses at the minimum, without graph."""
    return found.solution.shared.detach(), tuple(z.detach() for z in found.solution.local)
