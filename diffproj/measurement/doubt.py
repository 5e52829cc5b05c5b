"""What it adds to the error bars of points that the pose they were measured from may be the wrong one of two.

The two poses are too far apart for a linear step. The points are measured from the other one as well, and the mean
square of their error gains `p Delta Delta^T`, with p the other's probability and Delta the difference of all points
together.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.plane import Plane

NEGLIGIBLE = 1e-12
"""Probability of a view's other pose up to which it adds nothing."""


class Doubt(NamedTuple):
    """Errors that the points share: `columns (*B, N, 3, q)` times unknowns with this `covariance (*B, q, q)`."""

    columns: Tensor
    covariance: Tensor


def of_the_pose(
    pixels: Tensor, calibration: Calibration, view: int, plane: Plane, points: Tensor, valid: Tensor
) -> Doubt:
    """The doubt between the two poses of a view, for points `(*B, N, 3)` measured from the one that was kept.

    Its first column is how far away the other pose puts the points; the second is of those that have no place there,
    which are not determined where the view is ambiguous.
    """
    probability, ambiguous = calibration.other_poses.probability[..., view], calibration.ambiguous[..., view]
    if not bool((probability > NEGLIGIBLE).any()):
        batch = points.shape[:-2]
        return Doubt(points.new_zeros(*points.shape, 0), points.new_zeros(*batch, 0, 0))
    with torch.no_grad():
        there, seen = back_project(pixels, calibration.alternatives[..., view], plane)
        away = torch.where((valid & seen).unsqueeze(-1), there - points, 0.0)
        lost = (valid & ~seen & ambiguous.unsqueeze(-1)).unsqueeze(-1) * _incommensurable(points)
    infinite = torch.where(ambiguous, torch.inf, 0.0).to(probability)
    return Doubt(torch.stack([away, lost], dim=-1), torch.diag_embed(torch.stack([probability, infinite], dim=-1)))


def _incommensurable(points: Tensor) -> Tensor:
    """Numbers `(N, 3)` that do not cancel in a length or an angle: what depends on a lost point is not determined."""
    count = 3 * points.shape[-2]
    return (torch.arange(count, dtype=points.dtype, device=points.device).sin() + 2).reshape(-1, 3)
