"""A measurement as it is linearised elsewhere: where all cameras together say that the points are.

Close to the horizon a pixel's error grows with the distance that it is measured at, so that a camera that errs towards
itself claims to be surer than one that errs away from itself. Seen from one place X all claims compare:
with `D = dX / d uv` there, the camera measured

    y = X + D (uv - project(X))        with the covariance D (S + P Sigma P^T) D^T

where S is the pixels' covariance and P their derivative by the camera, as they were. A step or two lead to the minimum
of the squares in the image, as Gauss and Newton do.
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj._core.numerics import inverse2
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.camera import Camera
from diffproj.lens.slopes import by_direction
from diffproj.measurement.measurement import Measurement

ROUNDING = 1e-6
"""Part of the longest step by which another may be off, as one of no length is."""


def relinearised(one: Measurement, at: Tensor) -> Measurement:
    """The measurement as seen from points near its own; where the camera does not see these, as it was.

    Args:
        one: of N points on a plane without an error.
        at: `(*B, N, 3)` on that plane, without gradient.
    """
    sight, noise = one._sight, one._noise
    projected, there = sight.camera.project(at)
    tangents = sight.plane.tangents()
    T = (tangents if sight.plane.is_per_point else tangents.unsqueeze(-3)).expand(*at.shape, 2)
    D = T @ inverse2(_by_point(sight.camera, at, there) @ T)
    there = there & one.valid & (D.detach().abs().sum((-2, -1)) > 0)
    off = torch.where(there.unsqueeze(-1), sight.pixels - projected, 0.0)
    points = torch.where(there.unsqueeze(-1), at + (D @ off.unsqueeze(-1)).squeeze(-1), one.points)
    q = sight.by_theta.shape[-1]
    moved = torch.cat([-D @ sight.by_theta, noise.common[..., q:].expand(*at.shape, -1)], dim=-1)
    here = there[..., None, None]
    common, own = torch.where(here, moved, noise.common), torch.where(here, D @ sight.noise, noise.own)
    valid = one.valid.expand(there.shape)
    return replace(one, points=points, valid=valid, _noise=replace(noise, common=common, own=own))


def bent(one: Measurement, at: Tensor, steps: Tensor, limit: float) -> Tensor:
    """Where a step is another on the curve of the camera than on its tangent, `(*B, N)`.

    Args:
        one: the measurement of that camera.
        at: points `(*B, N, 3)` on the plane.
        steps: from there `(*B, N, 3, k)`.
        limit: how much of a step they may differ.
    """
    sight = one._sight
    pixels, there = sight.camera.project(at)
    image = _by_point(sight.camera, at, there) @ steps
    found, size = torch.zeros_like(there), steps.norm(dim=-2).amax(-1)
    for step, shift in zip(steps.unbind(-1), image.unbind(-1), strict=True):
        reached, valid = back_project(pixels + shift, sight.camera, sight.plane)
        off = (reached - at - step).norm(dim=-1)
        found = found | ~valid | (off > limit * step.norm(dim=-1) + ROUNDING * size)
    return found & there & one.valid


def _by_point(camera: Camera, points: Tensor, there: Tensor) -> Tensor:
    """The derivative of the pixels by the points `(*B, N, 2, 3)`; of some other points where these are not seen."""
    R = camera.R.unsqueeze(-3)
    direction = (R @ points.unsqueeze(-1)).squeeze(-1) + camera.t.unsqueeze(-2)
    axis = torch.tensor([0.0, 0, 1], dtype=points.dtype, device=points.device)
    direction = torch.where(there.unsqueeze(-1), direction, axis)
    return camera.K[..., None, :2, :2] @ by_direction(camera.distortion, direction) @ R
