"""Focal lengths that came out negative are made positive: the image of a flat target stays the same.

On its way the solver may lead a focal length through zero, where pixels are far from square or the noise is large. With
the camera's axis x or y mirrored in all poses a flat target gives the same image, so that it stays there, and boards
count as mirrored. The lens follows: p1, s3, s4, tau_x and the skew change their sign with y; p2, s1, s2 and tau_y with
x.
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.two_poses import replaced
from diffproj.calibration.problem.parametrisation import BOW, SKEW, Parametrisation, Pose

WITH_X, WITH_Y = ("f_x", "p2", "s1", "s2", "tau_y"), ("f_y", "p1", "s3", "s4", "tau_x", SKEW)
"""Parameters that change their sign where an axis is mirrored; the bow does with either."""


def with_positive_focal_lengths(found: Fit, *, max_iterations: int, tolerance: float) -> Fit:
    """The fit with negative focal lengths made positive, and all that goes with them; others stay to the bit."""
    negative = found.solution.shared[:, :2] < 0
    if found.task.solid or not bool(negative.any()):
        return found
    which = negative.any(-1).nonzero().flatten()
    part = found.part(which)
    signs = torch.where(negative[which], -1.0, 1.0).to(part.solution.shared)
    start = mirrored(part.task.parameters, part.solution.shared, part.solution.local, signs)
    again = fit(part.task, *start, max_iterations=max_iterations, tolerance=tolerance)
    solution = replaced(found.solution, which, again.solution, torch.ones_like(which, dtype=torch.bool))
    return replace(found, solution=solution)


def mirrored(parameters: Parametrisation, shared: Tensor, poses: Pose, signs: Tensor) -> tuple[Tensor, Pose]:
    """Shared parameters `(P, s)` and poses that see a flat target alike, with axes x, y times signs `(P, 2)`."""
    one = torch.ones_like(signs[:, 0])
    each = dict.fromkeys(WITH_X, signs[:, 0]) | dict.fromkeys(WITH_Y, signs[:, 1])
    each |= {name: signs.prod(-1) for name in BOW}
    shared = shared * torch.stack([each.get(name, one) for name in parameters.few_names], dim=-1)
    R, t = poses
    axes = torch.nn.functional.pad(signs, (0, 1), value=1.0).unsqueeze(1)
    # Two columns are mirrored, and the third follows, for a rotation is none after that.
    R = axes.unsqueeze(-1) * R * torch.stack([one, one, signs.prod(-1)], dim=-1)[:, None, None]
    return shared, (R, axes * t)
