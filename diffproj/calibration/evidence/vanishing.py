"""`VanishingPoints`: where the lines of the world that run along known directions meet in the picture."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, called
from diffproj.calibration.evidence.observation import (
    Deviation,
    Observed,
    batched,
    check_apart,
    check_broadcast,
    checked_deviation,
    checked_pixels,
    valued,
    with_spread,
)
from diffproj.calibration.least_squares.losses import Loss
from diffproj.geometry.camera import Camera

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class VanishingPoints(Observed):
    """Where parallel lines of known directions meet in the picture, or such lines themselves.

    Attributes:
        directions: of the lines in the world `(M, 3)`.
        pixels: where they meet `(*B, M, 2)`, or `None`.
        segments: two pixels of each line `(*B, M, 2, 2)`, or `None`.

    Example:
        >>> import diffproj as dp
        >>> dp.VanishingPoints(["y", "x"], pixels=[[1137.0, 209.4], [-1842.9, 174.9]], pixel_sigma=5.0)
        VanishingPoints(2 seen)
        >>> dp.VanishingPoints(["y"], segments=[[[400.0, 700.0], [600.0, 300.0]]])
        VanishingPoints(1 seen)
    """

    __slots__ = ("directions", "pixel_sigma", "pixels", "segments")

    def __init__(
        self,
        directions: Sequence[str] | Float[Tensor, "m 3"] | Array,
        pixels: Float[Tensor, "*batch m 2"] | Array | None = None,
        segments: Float[Tensor, "*batch m 2 2"] | Array | None = None,
        pixel_sigma: Deviation = 1.0,
        loss: Loss | None = None,
    ) -> None:
        """Copy what was seen, and check it.

        Args:
            directions: of the lines in the world `(M, 3)`, of any length and either sense; `"x"`, `"y"`, `"z"` stand
                for the axes.
            pixels: vanishing points `(*B, M, 2)`; or
            segments: two pixels on each line `(*B, M, 2, 2)`, far apart, which is better where lines are nearly
                parallel in the picture too.
            pixel_sigma: standard deviation of a pixel's coordinate in px: a number, `(M,)` or `(*B, M)`.
            loss: a robust loss, its scale in deviations.

        Raises:
            TypeError: not directions, pixels or numbers.
            ValueError: neither or both of pixels and segments, or shapes that do not fit.
        """
        super().__init__(loss)
        self.directions = _directions(directions)
        if (pixels is None) == (segments is None):
            raise ValueError(f"pixels: want pixels or segments, got {'neither' if pixels is None else 'both'}")
        M = len(self.directions)
        self.pixels = None if pixels is None else checked_pixels("pixels", pixels, "M", 2)
        self.segments = None if segments is None else checked_pixels("segments", segments, "M", 2, 2)
        if self.segments is not None:
            first, second = self.segments.unbind(-2)
            check_apart("segments", second, "the first of each line", first, "take two far apart")
        seen = self.pixels if self.segments is None else self.segments[..., 0, :]
        if seen.shape[-2] != M:  # type: ignore[union-attr]
            what = "segments" if pixels is None else "pixels"
            raise ValueError(f"directions: want one for each of {seen.shape[-2]} {what}, got {M}")  # type: ignore[union-attr]
        self.pixel_sigma = checked_deviation("pixel_sigma", pixel_sigma, "a deviation in px")
        check_broadcast("pixel_sigma", self.pixel_sigma, "the lines", seen.shape[:-1])  # type: ignore[union-attr]

    def __len__(self) -> int:
        """The number of directions, M."""
        return len(self.directions)

    def _residuals(self, camera: Camera) -> Float[Tensor, "*batch m k"]:
        """Of points, predicted minus seen; of segments, the distance of the vanishing point from the line."""
        towards = (camera.R.unsqueeze(-3) @ self.directions.to(camera.device).unsqueeze(-1)).squeeze(-1)
        if self.pixels is not None:
            ahead = torch.where(towards[..., 2:] < 0, -towards, towards)
            predicted, valid = camera.without_pose().project(ahead)
            off = (predicted - self.pixels.to(predicted)) / self.pixel_sigma.to(predicted).unsqueeze(-1)
            return torch.where(valid.unsqueeze(-1), off, torch.nan)

        def beside(one: Tensor, other: Tensor) -> Tensor:
            (first, seen), (second, also) = camera.directions(one), camera.directions(other)
            return torch.where(seen & also, (torch.linalg.cross(first, second) * towards).sum(-1), torch.nan)

        ends = [batched(end, camera) for end in self.segments.unbind(-2)]  # type: ignore[union-attr]
        found, variance = with_spread(beside, ends, self.pixel_sigma.to(ends[0]))
        return (found / variance.sqrt()).unsqueeze(-1)


def _directions(given: Any) -> Tensor:
    if isinstance(given, str):
        raise TypeError(f"directions: want one for each line, as in [{given!r}], got a string")
    if isinstance(given, list | tuple) and any(isinstance(one, str) for one in given):
        unknown = [one for one in given if not (isinstance(one, str) and one in AXES)]
        if unknown:
            raise ValueError(f"directions: want 'x', 'y', 'z' or vectors (M, 3), got {called(unknown[0])}")
        given = [AXES[one] for one in given]
    directions = valued("directions", given, "M", 3)
    length = directions.detach().norm(dim=-1, keepdim=True)
    if directions.ndim != 2 or not bool(((length > 0) & length.isfinite()).all()):
        raise ValueError(f"directions: want vectors (M, 3) other than 0, got shape {tuple(directions.shape)}")
    return directions / directions.norm(dim=-1, keepdim=True)
