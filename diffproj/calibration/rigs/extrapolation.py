"""How much more uncertain triangulated points are than to first order, where a camera's lens is extrapolated.

As `measure` does it on planes: the rig is moved by three standard deviations to both sides along each of its
independent errors, and the pixels' rays are found anew, exactly. What they are off at the point's distance, in pixels
of the camera as it is, moves the point as errors of these pixels do. The mean square of that over nine is the variance;
where a moved lens has no ray for the pixel, it is infinite.
"""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.problem.parametrisation import moved
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.region import in_region
from diffproj.geometry.camera import Camera

STEP = 3.0
"""By how many standard deviations the rig is moved."""
TOGETHER = 2**18
"""About how many rays are found anew at a time."""


class Rig(NamedTuple):
    """What triangulation asks of a rig: `columns` is where a camera's own stand in the covariance, by name."""

    cameras: dict[str, Camera]
    calibrations: dict[str, Calibration]
    covariance: Covariance
    columns: dict[str, list[int]]


def beyond_corners(rig: Rig, pixels: Mapping[str, Tensor], seen: Mapping[str, Tensor]) -> Tensor:
    """Points that a camera sees outside of the region that its corners covered `(N,)`."""
    found = torch.zeros_like(next(iter(seen.values())))
    for name, uv in pixels.items():
        if (region := rig.calibrations[name].region) is not None:
            found |= seen[name] & ~in_region(uv, region)
    return found


@torch.no_grad()
def stretch(
    rig: Rig,
    which: Tensor,
    X: Tensor,
    weights: Mapping[str, Tensor],
    slopes: Tensor,
    inverse: Tensor,
    root: Tensor,
    by_rig: Tensor,
) -> Tensor:
    """How many times as uncertain points are as to first order `(N,)`, at least 1; infinite where a lens may end.

    Args:
        rig: the cameras at their places.
        which: the points that are to be looked at `(N,)`; it is 1 for the others.
        X: the points `(N, 3)`.
        weights: one over the deviation of a pixel by camera, 0 where it is not seen `(N, 1, 1)`.
        slopes: derivatives of all pixels by the point, in deviations `(N, 2 c, 3)`.
        inverse: of `slopes^T slopes` `(N, 3, 3)`.
        root: of the rig's covariance `(s, q)`.
        by_rig: the derivative of the points by that root `(N, 3, q)`.
    """
    found = torch.ones_like(X[:, 0])
    if not bool(which.any()):
        return found
    X, first = X[which], by_rig[which].square().sum((-2, -1))
    to_point = inverse[which] @ slopes[which].mT  # (n, 3, 2 c)
    steps = STEP * torch.cat([root, -root], dim=-1).mT  # (2 q, s)
    total = torch.zeros_like(first)
    for some in steps.split(max(1, TOGETHER // len(X))):
        off, sound = [], torch.ones_like(some[:, :1], dtype=torch.bool)
        for name, weight in weights.items():
            shift, seen = _moved_pixels(rig, name, some[:, rig.columns[name]], X)
            counts = weight[which, 0, 0] > 0
            off.append(torch.where((counts & seen).unsqueeze(-1), shift * weight[which, 0], 0.0))
            sound = sound & (seen | ~counts)
        moves = (to_point @ torch.cat(off, dim=-1).unsqueeze(-1)).squeeze(-1)  # (2 q, n, 3)
        total = total + torch.where(sound, moves.square().sum(-1), torch.inf).sum(0)
    squared = total / (2 * STEP**2) / torch.where(first > 0, first, torch.inf)
    found[which] = squared.nan_to_num(1.0, torch.inf).clamp(min=1).sqrt()
    return found


def _moved_pixels(rig: Rig, name: str, steps: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """How far off these a camera sees what its moved self sees at the points' pixels `(m, n, 2)`, and whether it does.

    Args:
        rig: the cameras at their places.
        name: of the camera.
        steps: by which its intrinsics move, and its place, where it has one `(m, own)`.
        X: the points `(n, 3)`.
    """
    camera, parameters = rig.cameras[name], rig.calibrations[name].parameters.of_camera
    s, m = parameters.size, len(steps)
    R, t = camera.R.expand(m, 3, 3), camera.t.expand(m, 3)
    if steps.shape[-1] > s:  # the first camera is the rig's frame
        R, t = moved((R, t), steps[:, s:])
    there = parameters.unpack(parameters.pack(camera) + steps[:, :s], (R, t))
    at, _ = camera.project(X)
    origin, direction, seen = there.rays(at.expand(m, *at.shape))
    reached = origin + direction * (X - origin).norm(dim=-1, keepdim=True)
    again, valid = camera.project(torch.where(seen.unsqueeze(-1), reached, X))
    return again - at, seen & valid
