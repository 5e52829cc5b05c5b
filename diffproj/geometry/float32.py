"""Where float32 does not suffice: scenes far from the world's origin, whose coordinates it rounds to visible steps."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.linalg import vector_norm

from diffproj._core.numerics import dot, has_values, rounding
from diffproj._core.warn import warn_caller

VISIBLE = 1e-4
"""Rounding, as a part of the camera's distance from the plane, from which on it is warned of: a tenth of a pixel seen
from straight above at a focal length of 1000 px."""
STEP = torch.finfo(torch.float32).eps
SOME = 8
"""About how many points are looked at."""


def looks_at_rounding(t: Tensor) -> bool:
    """Whether to look: in float32, where values can be read, and without waiting for another device."""
    return t.dtype == torch.float32 and t.device.type == "cpu" and has_values(t)


def warn_of_rounding(reach: Any, height: Any) -> None:
    """Warn where float32 rounds places visibly: tensors, or arrays.

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
        share = 10.0 ** math.floor(math.log10(STEP * float((reach / height)[doubtful].max())))
        warn_caller(
            "float32: the scene is so far from the world's origin that rounding moves places on the plane by "
            f"{share:g} of the camera's distance from it, or more; use float64 for camera and pixels, from the start, "
            "or an origin near the scene"
        )


@torch.no_grad()
def warn_of_rounded_pixels(K: Tensor, R: Tensor, t: Tensor, points: Tensor) -> None:
    """Warn where float32 rounds pixels visibly, by a look at a few of the points.

    Args:
        K: intrinsics `(*B, 3, 3)`.
        R: rotation world to camera `(*B, 3, 3)`.
        t: translation world to camera `(*B, 3)`.
        points: in the world `(*B, N, 3)`.
    """
    some = points[..., :: max(1, points.shape[-2] // SOME), :]
    away = (dot(R.unsqueeze(-3), some.unsqueeze(-2)) + t.unsqueeze(-2)).square().sum(-1).sqrt()
    share = STEP * vector_norm(t, dim=-1).unsqueeze(-1) / away
    if not bool((share > VISIBLE).any()):  # the usual case ends here
        return
    usual = share.nanmedian(-1, keepdim=True).values  # one point close to the camera tells nothing
    doubtful = (usual > VISIBLE) & usual.isfinite()
    if bool(doubtful.any()):
        off = float(torch.where(doubtful, usual * K[..., :1, 0].abs(), 0.0).amax())
        warn_caller(
            "float32: the scene is so far from the world's origin that rounding moves pixels by "
            f"{10.0 ** math.floor(math.log10(off)):g} px or more; use float64 for camera and points, from the start, "
            "or an origin near the scene"
        )
