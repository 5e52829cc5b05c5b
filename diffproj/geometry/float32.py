"""Where float32 does not suffice: scenes far from the world's origin, whose coordinates it rounds to visible steps."""

import math

import torch
from torch import Tensor
from torch.linalg import vector_norm

from diffproj._core.numerics import dot, has_values, rounding
from diffproj._core.warn import warn_caller
from diffproj.geometry.camera import Camera
from diffproj.geometry.plane import Plane

VISIBLE = 1e-4
"""Rounding, as a part of the camera's distance from the plane, from which on it is warned of: a tenth of a pixel seen
from straight above at a focal length of 1000 px."""
STEP = torch.finfo(torch.float32).eps


def looks_at_rounding(t: Tensor) -> bool:
    """Whether to look: in float32, where values can be read, and without waiting for another device."""
    return t.dtype == torch.float32 and t.device.type == "cpu" and has_values(t)


def warn_of_rounding(reach: Tensor, height: Tensor) -> None:
    """Warn where float32 rounds places visibly.

    Args:
        reach: how far camera and plane are from the world's origin `(*B,)`.
        height: how far the camera is from the plane, in the same unit. Nothing is said where it rests on the plane to
            within rounding, which makes its points invalid.
    """
    doubtful = reach * (STEP / VISIBLE) > height
    if not bool(doubtful.any()):  # the usual case ends here
        return
    doubtful = doubtful & (height > rounding(torch.float32) * reach)
    if bool(doubtful.any()):
        share = 10.0 ** math.floor(math.log10(STEP * float((reach / height)[doubtful].amax())))
        warn_caller(
            "float32: the scene is so far from the world's origin that rounding moves places on the plane by "
            f"{share:g} of the camera's distance from it, or more; use float64 for camera and pixels, from the start, "
            "or an origin near the scene"
        )


def warn_if_rounded(camera: Camera, plane: Plane) -> None:
    """The same for a camera and a plane."""
    if looks_at_rounding(camera.t):
        with torch.no_grad():
            plane = plane.like(camera.K)
            length = plane.length
            height = (dot(plane.normal, camera.center) - plane.offset).abs()
            warn_of_rounding(plane.offset.abs() + length * vector_norm(camera.t, dim=-1), height)
