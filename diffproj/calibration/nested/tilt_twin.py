"""The other valley of a tilted sensor: with a tilt to the other side, the rest of the lens does nearly the same.

To second order in the distance from the axis a tilt of the sensor by `tau_x`, `tau_y` moves the point `x` by

    -(b . x) x                      with b = (tau_y, -tau_x),

decentring by `p1`, `p2` and a prism by `s1`, `s3` move it by

    2 (q . x) x + q r^2             with q = (p2, p1)
    s r^2                           with s = (s1, s3).

So `b -> b + d`, `q -> q + d / 2`, `s -> s - d / 2` changes nothing to that order. What tells the tilt is of higher
order, where two tilts of different sign are much alike: there are two valleys, and either may be the lower one.
"""

from dataclasses import replace
from typing import Any

from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.second_look import lower_fit
from diffproj.calibration.trust.reach import reach_of

OPPOSITE = -2.0
"""How many times its tilt the sensor is tilted at the start that leads to the other valley: beyond the other minimum.
From the same tilt to the other side some went back over the saddle between them."""
TERMS = ("tau_x", "tau_y", "p1", "p2", "s1", "s3")
"""What must be free for there to be two valleys."""


def lower_valley(
    found: Fit, size: tuple[int, int], *, reject: float | None, max_iterations: int, tolerance: float
) -> Fit:
    """The fit, or of those cameras whose other valley is lower, its minimum; where that folds, it is not taken.

    Args:
        found: minima with a tilted sensor.
        size: of the image.
        reject: robust standard deviations beyond which a corner is an outlier.
        max_iterations: of the solver.
        tolerance: of the solver.
    """
    task, solution = found.task, found.solution
    terms = [task.names.index(name) for name in TERMS]
    if task.basis is not None and not bool((task.basis[:, terms] != 0).any(-1).all()):
        return found
    given = replace(task, used=task.used | found.rejected)
    limits: dict[str, Any] = {"reject": reject, "max_iterations": max_iterations, "tolerance": tolerance}
    other = fit(given, twin(solution.shared, terms), solution.local, **limits)
    there = reach_of(other, size)
    which = ((there >= reach_of(found, size)) & (there >= 0)).nonzero().flatten()
    return lower_fit(found, other.part(which), which, reject)


def twin(shared: Tensor, terms: list[int]) -> Tensor:
    """The shared parameters `(P, s)` with the opposite tilt, and the same to second order."""
    tau_x, tau_y, p1, p2, s1, s3 = terms
    x, y = ((OPPOSITE - 1) * shared[:, i] for i in (tau_x, tau_y))
    twin = shared.clone()
    for i, change in ((tau_x, x), (tau_y, y), (p1, -x / 2), (p2, y / 2), (s1, -y / 2), (s3, x / 2)):
        twin[:, i] += change
    return twin
