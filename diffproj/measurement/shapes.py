"""Lengths, angles and areas as the lengths of vectors that are smooth where the numbers themselves have a kink.

A length is that of the difference of two points; an area that of the outline's area vector; an angle that of the turn
from one arm to the other, or, above a right angle, what it lacks to 180 degrees. At zero the vector has a derivative,
and so a covariance, where its length has none.
"""

import torch
from torch import Tensor

from diffproj._core.warn import warn_caller

MOST_CORNERS = 1000
"""Whose sides are compared with each other."""
SURE = 3.0
"""Deviations by which a corner must lie off a side."""


def coordinate(axis: int, points: Tensor) -> Tensor:
    """One coordinate of the only point `(1, 3)`."""
    return points[0, axis]


def difference(points: Tensor) -> tuple[Tensor, Tensor]:
    """From the first of two points `(2, 3)` to the second; and false."""
    return points[1] - points[0], torch.zeros_like(points[0, 0], dtype=torch.bool)


def area_vector(points: Tensor) -> tuple[Tensor, Tensor]:
    """At right angles to the outline of points `(k, 3)`, as long as its area; and false."""
    around = torch.linalg.cross(points - points[:1], points.roll(-1, 0) - points[:1]).sum(0)
    return around / 2, torch.zeros_like(points[0, 0], dtype=torch.bool)


def crosses_itself(points: Tensor, sure: Tensor | None = None) -> Tensor:
    """Whether the outline of points `(..., k, 3)` on a plane crosses itself `(...)`, its corners being no crossings.

    `sure (..., k)` is how far a corner must lie off another side for that, 0 if left out: those of points on a line are
    on either side of it by chance.
    """
    points = points.detach()
    normal = torch.linalg.cross(points - points[..., :1, :], points.roll(-1, -2) - points[..., :1, :])
    largest = normal.square().sum(-1).argmax(-1)  # any two arms that are not on a line tell the plane
    normal = normal.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 3))
    normal = (normal / length(normal).clamp(min=torch.finfo(normal.dtype).tiny).unsqueeze(-1)).unsqueeze(-3)
    a, b = points.unsqueeze(-2), points.roll(-1, -2).unsqueeze(-2)  # (..., k, 1, 3): the sides' ends
    least = torch.zeros_like(points[..., 0]) if sure is None else sure.detach()

    def side(of: Tensor, least: Tensor) -> Tensor:
        """On which side of each side's line points `(..., 1, k, 3)` lie, `(..., k, k)`; 0 within `(..., k)` of it."""
        off = (torch.linalg.cross(b - a, of - a) * normal).sum(-1)
        return torch.where(off.abs() > least.unsqueeze(-2) * length(b - a), off.sign(), 0.0)

    parted = side(a.transpose(-3, -2), least) * side(b.transpose(-3, -2), least.roll(-1, -1)) < 0
    return (parted & parted.mT).flatten(-2).any(-1)


def warn_of_crossings(points: Tensor, deviations: Tensor, valid: Tensor) -> None:
    """Warn of outlines `(..., k, 3)` that surely cross themselves, where all of their corners `(..., k)` are valid."""
    if not 3 < points.shape[-2] <= MOST_CORNERS:
        return
    sure = SURE * length(deviations).nan_to_num(0.0)
    if bool((valid.all(-1) & crosses_itself(points, sure)).any()):
        warn_caller(
            "area: the outline crosses itself, and what lies on its two sides cancels: give its corners in their order "
            "around, or the areas one by one"
        )


def turn(points: Tensor) -> tuple[Tensor, Tensor]:
    """At right angles to both arms at the second of three points `(3, 3)`, as long as the angle or its supplement.

    Returns:
        The vector `(3,)` in radians, zero where an arm has no length; and whether its length is the supplement.
    """
    a, b = points[0] - points[1], points[2] - points[1]
    cross, dot = torch.linalg.cross(a, b), (a * b).sum()
    obtuse = dot < 0
    dot = torch.where(obtuse, -dot, dot)  # at a right angle its absolute value has no slope
    squared = cross.square().sum()
    turned = squared > 0
    sine = torch.where(turned, squared, 1.0).sqrt()
    sound = dot > 0
    straight = torch.where(sound, torch.where(sound, dot, 1.0).reciprocal(), 0.0)
    return cross * torch.where(turned, torch.atan2(sine, dot) / sine, straight), obtuse


def length(vector: Tensor) -> Tensor:
    """The lengths `(...)` of vectors `(..., 3)`, with zero gradient at zero."""
    squared = vector.square().sum(-1)
    apart = squared > 0
    return torch.where(apart, torch.where(apart, squared, 1.0).sqrt(), 0.0)
