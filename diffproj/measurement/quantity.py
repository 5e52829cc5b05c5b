"""`Quantity`: measured values, their standard deviations, and the intervals in which the truth lies."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.copying import Copied
from diffproj._core.shown import Shown, decimals, rounded
from diffproj.measurement.student import check_level, normal_reach, student_reach

SIGNIFICANT = 0.9973
"""The level of the interval that has to leave out 0 for a value to be told from it: three standard deviations'."""

BENT = 0.1
"""By how much of its half width an interval has to differ from `value -+ reach * deviation` to be called nonlinear."""

FEW = 4
"""Values that one line shows."""

Bounds = Callable[[float, Tensor], tuple[Tensor, Tensor]]
"""From a level and the number of deviations that it takes to lower and upper bounds."""


@dataclass(frozen=True, eq=False, repr=False)
class Quantity(Copied, Shown):
    """Measured values with their standard deviations.

    Attributes:
        value: `(*B, M)`; NaN where a point that it needs is not valid.
        deviation: standard deviation `(*B, M)` in the unit of the value: its root mean square error to first order, and
            at values where that is 0 by symmetry, as of a length of 0 or an angle of 180 degrees, that of the noise
            itself. Infinite where the calibration does not determine it, NaN where the value is.
        degrees_of_freedom: how many residuals tell the deviation `(*B, M)`; infinite where it is known. All infinite
            if left out.
    """

    value: Float[Tensor, "*shape"]
    deviation: Float[Tensor, "*shape"]
    degrees_of_freedom: Float[Tensor, "*shape"] | None = None
    _bounds: Bounds | None = field(default=None, repr=False)

    def interval(self, level: float = 0.95) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
        """Lower and upper bounds between which the truth lies with that probability, for Gaussian noise.

        They reach further where the deviation was estimated from few residuals (Student's t). They follow the curve
        from the pixels to the plane: near the horizon the upper bound of a length lies further off than the lower one,
        and is infinite where the noise reaches the horizon. No length or area has a negative bound, no angle one beyond
        180 degrees; a length that noise may have made has the lower bound 0. Those of a function of your own that has a
        kink within the noise, as the longer of two lengths and the difference of two sides without its sign, reach as
        far as it may go there. Bounds carry no gradients.

        Raises:
            ValueError: the level is not between 0 and 1.
        """
        level = check_level(level)
        value, deviation, reach = self.value.detach(), self.deviation.detach(), self._reach(level)
        if self._bounds is None:
            return value - reach * deviation, value + reach * deviation
        low, high = self._bounds(level, reach)
        return torch.where(value.isnan(), torch.nan, low), torch.where(value.isnan(), torch.nan, high)

    @property
    def significant(self) -> Bool[Tensor, "*shape"]:
        """Whether the value is told from 0: at least three standard deviations away, or as much as makes it as sure.

        It takes more where the deviation was estimated from few residuals, and for the length between two points, which
        noise alone makes longer than 0. False where value and deviation are both 0.
        """
        low, high = self.interval(SIGNIFICANT)
        return (low > 0) | (high < 0)

    @property
    def nonlinear(self) -> Bool[Tensor, "*shape"]:
        """Where the deviation alone misleads, and `interval` is to be taken: near the horizon, and near zero.

        There the 95 % interval differs from `value -+ reach * deviation` by more than a tenth of its half width.
        """
        low, high = self.interval()
        value, half = self.value.detach(), self._reach(0.95) * self.deviation.detach()
        off = torch.maximum((low - value + half).abs(), (high - value - half).abs())
        return off > BENT * half + 1e-9 * value.abs()

    def to_dict(self) -> dict[str, list[float]]:
        """Values, deviations and 95 % intervals as columns of Python's own numbers: `pandas.DataFrame` takes it.

        Example:
            >>> Quantity(torch.tensor([200.0]), torch.tensor([0.5])).to_dict()
            {'value': [200.0], 'deviation': [0.5], 'low_95': [199.02001953125], 'high_95': [200.97998046875]}
        """
        columns = self.value, self.deviation, *self.interval()
        names = "value", "deviation", "low_95", "high_95"
        return {name: part.detach().flatten().tolist() for name, part in zip(names, columns, strict=True)}

    def _facts(self) -> list[str]:
        values = zip(self.value.detach().flatten().tolist(), self.deviation.detach().flatten().tolist(), strict=True)
        texts = [" ± ".join(filter(None, rounded(*pair))) or "NaN" for pair in values]
        return [*texts[:FEW], f"{len(texts) - FEW} more" if len(texts) > FEW else ""]

    def _columns(self) -> dict[str, list[float]]:
        return self.to_dict()

    def _reach(self, level: float) -> Tensor:
        """How many deviations an interval of that level takes."""
        if self.degrees_of_freedom is None:
            return torch.full_like(self.value, normal_reach(level))
        return student_reach(level, self.degrees_of_freedom)


def described(found: Quantity, lie: str) -> list[str]:
    """Lengths with their deviations, and with their intervals where the deviations mislead.

    `lie` is what the points of one that is NaN do not do both, as "on the plane".
    """
    columns = (found.value, found.deviation, *found.interval(), found.nonlinear, found.significant)
    digits = decimals(found.deviation.flatten().tolist(), 3)
    lines = []
    for value, deviation, low, high, bent, significant in zip(*(column.tolist() for column in columns), strict=True):
        if math.isnan(value):
            lines.append(f"not both points are {lie}")
            continue
        note = f"  nonlinear, 95 %: {low:.{digits}f} to {high:.{digits}f}" * bent
        note += "" if significant else "  less than three deviations from 0"
        lines.append(f"{value:10.{digits}f} ± {deviation:.{digits}f}{note}")
    return lines
