"""A second start for a rational lens: a factor that stands both above and below its line.

Such a factor changes nothing of the lens, and leads away from the poles and folds of its neighbourhood. So the poorer
lens with a factor is another place to start from, and some minima are found from there alone. Where a factor helps it
does so at once: after a few steps it is lower than the end of the other way. Those few steps are taken side by side
with the first ones of that, which hardly takes longer; where the first minimum makes sense, only what is lower then
goes on.
"""

import math

import torch
from torch import Tensor

from diffproj.calibration.fitting.task import Task
from diffproj.lens.models import DENOMINATOR

FACTORS = ((30.0, 225.0), (3.0, 2.25))
"""Terms in r^2 and r^4, with r in half diagonals of the image, of factors above and below the line: squares of positive
ones, so that they have no pole. Where the first minimum makes sense, all that the second finds the first does, too."""
RADIAL = ("k1", "k2", "k3", *DENOMINATOR)
"""The terms above and below the line."""
FEW_STEPS = 15
"""Steps after which it is seen whether such a start leads lower."""


def with_factor(task: Task, shared: Tensor, size: tuple[int, int], factor: tuple[float, float]) -> Tensor | None:
    """The shared parameters `(P, s)` with a factor of `FACTORS`; `None` where not all terms of both sides are free."""
    terms = [task.names.index(name) for name in RADIAL]
    if task.basis is not None and not bool((task.basis[:, terms] != 0).any(-1).all()):
        return None
    squared = (shared[:, :2].mean(-1) / (0.5 * math.hypot(*size))).square()
    a, b = factor[0] * squared, factor[1] * squared.square()
    multiplied = shared.clone()
    for side in (terms[:3], terms[3:]):
        one, two, three = shared[:, side].unbind(-1)
        multiplied[:, side] = torch.stack([one + a, two + a * one + b, three + a * two + b * one], dim=-1)
    return multiplied
