"""The other valley of a tilted sensor: with a tilt to the other side, the rest of the lens does nearly the same.

To second order in the distance from the axis a tilt of the sensor by `tau_x`, `tau_y` moves the point `x` by

    -(b . x) x                      with b = (tau_y, -tau_x),

decentring by `p1`, `p2` and a prism by `s1`, `s3` move it by

    2 (q . x) x + q r^2             with q = (p2, p1)
    s r^2                           with s = (s1, s3).

So `b -> b + d`, `q -> q + d / 2`, `s -> s - d / 2` changes nothing to that order. What tells the tilt is of higher
order, where two tilts of different sign are much alike: there are two valleys, and either may be the lower one.

Most cameras have but one: then a few steps lead back across the saddle. Only what stays on the other side, and is not
far above, or what is lower by then goes on.
"""

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.second_look import lower_fit
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.nested.compared import costs
from diffproj.calibration.trust.reach import reach_of

OPPOSITE = -2.0
"""How many times its tilt the sensor is tilted at the start that leads to the other valley: beyond the other minimum.
From the same tilt to the other side some went back over the saddle between them."""
FEW_STEPS, NEAR = (3, 2, 5), (math.inf, 20.0, 3.0)
"""Steps after which it is seen who goes on; and residuals' worth of noise by which one may be above by then on the
other side. Of 374 fits 133 were back after three steps and 167 after five, of which 7 and 8 would have come to a lower
minimum had they gone on; of the 60 that were above 20 after five, 14."""
LOWER = 0.1
"""Residuals' worth of noise by which one goes on that is lower, on either side."""
ALIKE = 1e-9
"""Part of the cost up to which two minima are as low: then the one is taken where the solver came to its end."""
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
    spare = found.degrees_of_freedom().clamp(min=1)
    given = replace(task, used=task.used | found.rejected)
    limits: dict[str, Any] = {"reject": reject, "tolerance": tolerance}
    rows = torch.arange(len(solution.shared), device=solution.shared.device)
    begin, poses = twin(solution.shared, terms), solution.local
    for few, above in zip(FEW_STEPS, NEAR, strict=True):
        near = fit(given.part(rows), begin, poses, max_iterations=min(max_iterations, few), **limits)
        across = (solution.shared[rows][:, terms[:2]] * near.solution.shared[:, terms[:2]]).sum(-1) < 0
        before, now = costs(found, near, rows, reject)
        worth = before / spare[rows]
        goes_on = (now < before - LOWER * worth) | (across & (now < before + above * worth))
        goes_on = (goes_on | (solution.status[rows] != Status.CONVERGED)).nonzero().flatten()
        if len(goes_on) == 0:
            return found
        rows, near = rows[goes_on], near.part(goes_on)
        begin, poses = near.solution.shared, near.solution.local
    other = fit(given.part(rows), begin, poses, max_iterations=max_iterations, **limits)
    before, now = costs(found, other, rows, reject)
    low = (now <= before * (1 + ALIKE)).nonzero().flatten()
    if len(low) == 0:
        return found
    rows, other = rows[low], other.part(low)
    there = reach_of(other, size)
    kept = ((there >= reach_of(found.part(rows), size)) & (there >= 0)).nonzero().flatten()
    return lower_fit(found, other.part(kept), rows[kept], reject)


def twin(shared: Tensor, terms: list[int]) -> Tensor:
    """The shared parameters `(P, s)` with the opposite tilt, and the same to second order."""
    tau_x, tau_y, p1, p2, s1, s3 = terms
    x, y = ((OPPOSITE - 1) * shared[:, i] for i in (tau_x, tau_y))
    twin = shared.clone()
    for i, change in ((tau_x, x), (tau_y, y), (p1, -x / 2), (p2, y / 2), (s1, -y / 2), (s3, x / 2)):
        twin[:, i] += change
    return twin
