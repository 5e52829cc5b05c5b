"""How much more uncertain points are than to first order, where the lens is extrapolated.

Inside the region that the corners covered, a point follows small errors of the lens in proportion. Outside of it, high
powers of the radius make small errors large, and a lens of nearly the same coefficients may end before the pixel. So
the calibration is moved by three standard deviations to both sides along each of its independent errors, and the pixels
are projected anew, exactly. The mean square of what the points move, over nine, is their variance, and that to first
order where they move in proportion (a cubature rule). Where a moved lens does not reach the pixel, it is infinite.
"""

import torch
from torch import Tensor

from diffproj.calibration.problem.parametrisation import POSE, Parametrisation, moved
from diffproj.geometry.back_projection import PlaneMap
from diffproj.geometry.camera import Camera
from diffproj.geometry.plane import Plane
from diffproj.measurement.propagation import root

STEP = 3.0
"""By how many standard deviations the calibration is moved."""
TOGETHER = 2**18
"""About how many points are projected anew at a time."""


@torch.no_grad()
def stretch(
    which: Tensor,
    pixels: Tensor,
    points: Tensor,
    camera: Camera,
    parameters: Parametrisation,
    plane: Plane,
    known: Tensor,
    middle: Tensor | None,
    by_theta: Tensor,
) -> Tensor:
    """How many times as uncertain points are as to first order `(*B, N)`, at least 1; infinite where the lens may end.

    Args:
        which: the points that are to be looked at `(*B, N)`; it is 1 for the others.
        pixels: `(*B, N, 2)`.
        points: where they were measured `(*B, N, 3)`.
        camera: at its pose.
        parameters: of the camera.
        plane: of the points.
        known: the covariance of camera and pose `(*B, q, q)`.
        middle: where the pose turns about in it `(3,)`; the world's origin if `None`.
        by_theta: the derivative of the points by these `(*B, N, 3, q)`.
    """
    found = torch.ones_like(points[..., 0])
    some = which.reshape(which.shape[:-1].numel(), which.shape[-1]).any(0)
    if not bool(some.any()):
        return found
    pixels, points, along = pixels[..., some, :], points[..., some, :], by_theta[..., some, :, :]
    if plane.is_per_point:
        normal, offset = plane.normal.expand(*plane.batch_shape, 3), plane.offset.expand(plane.batch_shape)
        plane = Plane.unchecked(normal[..., some, :], offset[..., some], is_per_point=True)
    batch, L = points.shape[:-2], root(known)
    L = L.expand(*batch, *L.shape[-2:])
    s, shared = parameters.size, parameters.pack(camera).expand(*batch, parameters.size)
    R = camera.R.expand(*batch, 3, 3)
    arm = torch.zeros_like(camera.t) if middle is None else middle
    t_0 = camera.t.expand(*batch, 3) + (R @ arm.unsqueeze(-1)).squeeze(-1)
    moves = along @ L.unsqueeze(-3)  # (*B, N, 3, q), by one standard deviation
    straight = STEP**2 * moves.square().sum(-2).movedim(-1, 0).repeat(2, *[1] * (points.ndim - 1))  # (2 q, *B, N)
    steps = STEP * torch.cat([L, -L], dim=-1).movedim(-1, 0)  # (2 q, *B, q)
    total = torch.zeros_like(points[..., 0])
    together = max(1, TOGETHER // max(1, total.numel()))
    for step, linear in zip(steps.split(together), straight.split(together), strict=True):
        turned, t = moved((R.expand(len(step), *R.shape), t_0), step[..., -POSE:])
        t = t - (turned @ arm.unsqueeze(-1)).squeeze(-1)
        there = parameters.unpack(shared + step[..., :s], (turned, t))
        again, valid, seen = PlaneMap(there, plane).with_reach(pixels)
        change = torch.where(valid, (again - points).square().sum(-1), linear)  # where the horizon is in the way
        total = total + torch.where(seen, change, torch.inf).sum(0)
    first = moves.square().sum((-2, -1))
    squared = total / (2 * STEP**2) / torch.where(first > 0, first, torch.inf)
    found[..., some] = torch.where(which[..., some], squared.nan_to_num(1.0, torch.inf).clamp(min=1).sqrt(), 1.0)
    return found
