"""Triangulated points whose deviations mislead: rays so nearly parallel that the way from pixels to point is no line.

With the parallax p of a point that is far away its distance is b / p: an error of p that brings it nearer by a third
puts it, to the other side, at twice the distance, and a larger one at infinity. So each point is moved to both ends of
the 95 % intervals along the axes of its covariance, and looked at anew: with e the pixels' moves, in deviations, and J
their derivative,

    |e(X +- step) - J step| > BENT |J step|

says that it is bent. (Of two pinholes the left side over the right one is the step over the distance.)
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from diffproj.geometry.camera import Camera

REACH = 1.96
"""Deviations to the ends of a 95 % interval."""
BENT = 0.1
"""By how much of itself a move of the pixels may be another than to first order: as `Quantity.nonlinear` has it."""


@torch.no_grad()
def curved(
    cameras: Mapping[str, Camera], X: Tensor, weights: Mapping[str, Tensor], slopes: Tensor, covariance: Tensor
) -> Tensor:
    """Where deviations mislead `(N,)`; nowhere where the covariance is not finite, which says so itself.

    Args:
        cameras: at their places.
        X: the points `(N, 3)`.
        weights: one over the deviation of a pixel by camera, 0 where it is not seen `(N, 1, 1)`.
        slopes: derivatives of all pixels by the point, in deviations `(N, 2 c, 3)`.
        covariance: of the points `(N, 3, 3)`.
    """
    known = covariance.isfinite().all(-1).all(-1)
    values, axes = torch.linalg.eigh(torch.where(known[:, None, None], covariance, 0.0))
    steps = REACH * values.clamp(min=0).sqrt().unsqueeze(-2) * axes  # (N, 3, 3): a column for each axis
    found = torch.zeros_like(known)
    for step in (*steps.unbind(-1), *(-steps).unbind(-1)):
        moves, lost = [], torch.zeros_like(known)
        for name, weight in weights.items():
            counts, (before, _) = weight[:, 0, 0] > 0, cameras[name].project(X)
            after, valid = cameras[name].project(X + step)
            moves.append(torch.where((counts & valid).unsqueeze(-1), (after - before) * weight[:, 0], 0.0))
            lost = lost | (counts & ~valid)
        straight = (slopes @ step.unsqueeze(-1)).squeeze(-1)
        off = (torch.cat(moves, dim=-1) - straight).norm(dim=-1)
        found = found | lost | (off > BENT * straight.norm(dim=-1))
    return found & known
