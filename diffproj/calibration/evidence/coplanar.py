"""`Coplanar`: points of a map that lie on one level, whose height nobody knows."""

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, number
from diffproj.calibration.evidence.observation import (
    Deviation,
    Observed,
    check_broadcast,
    checked_deviation,
    checked_pixels,
    valued,
)
from diffproj.calibration.least_squares.losses import Loss
from diffproj.geometry.camera import Camera
from diffproj.lens.slopes import by_direction

STEPS = 6
"""Steps of Gauss and Newton to the level that fits best; each squares what is left, or nearly."""


class Coplanar(Observed):
    """Points that a map tells by x and y, and that lie on one level: a waterline, a floor, a roof edge.

    The level itself is not known: the one that fits best is taken for each camera, and what the points tell of it is
    not counted twice. Three of them and more tell something.

    Attributes:
        places: x and y `(M, 2)` in world units.
        pixels: `(*B, M, 2)`.

    Example:
        >>> import diffproj as dp
        >>> shore = [[-20.0, 60.0], [0.0, 55.0], [25.0, 70.0]]
        >>> dp.Coplanar(shore, [[120.0, 310.0], [640.0, 330.0], [1190.0, 280.0]], pixel_sigma=2.0)
        Coplanar(3 seen)
    """

    __slots__ = ("level", "pixel_sigma", "pixels", "places")
    own_unknowns = 1  # the level

    def __init__(
        self,
        places: Float[Tensor, "m 2"] | Array,
        pixels: Float[Tensor, "*batch m 2"] | Array,
        pixel_sigma: Deviation = 1.0,
        level: float = 0.0,
        loss: Loss | None = None,
    ) -> None:
        """Copy what was seen, and check it.

        Args:
            places: x and y of the points `(M, 2)`.
            pixels: that show them `(*B, M, 2)`.
            pixel_sigma: standard deviation of a pixel's coordinate in px: a number, `(M,)` or `(*B, M)`.
            level: about where the level is, to start from.
            loss: a robust loss, its scale in deviations.

        Raises:
            TypeError: not places, pixels or numbers.
            ValueError: shapes do not fit, fewer than three points, or a value that cannot be.
        """
        super().__init__(loss)
        self.places = valued("places", places, "M", 2)
        if self.places.ndim != 2 or len(self.places) < 3 or not bool(self.places.detach().isfinite().all()):
            raise ValueError(f"places: want x and y of at least 3 points (M, 2), got {tuple(self.places.shape)}")
        try:
            self.pixels = checked_pixels("pixels", pixels, len(self.places), 2)
        except ValueError as error:
            raise ValueError(f"{error}; one for each of places") from None
        self.pixel_sigma = checked_deviation("pixel_sigma", pixel_sigma, "a deviation in px")
        check_broadcast("pixel_sigma", self.pixel_sigma, "the pixels", self.pixels.shape[:-1])
        self.level = number("level", level, "a height in world units")

    def __len__(self) -> int:
        """The number of points, M."""
        return len(self.places)

    def _residuals(self, camera: Camera) -> Float[Tensor, "*batch m 2"]:
        """Projected minus seen at the level that fits best, over the deviation."""
        places, up = self.places.to(camera.K), camera.R[..., None, :, 2]
        sigma = self.pixel_sigma.to(places).unsqueeze(-1)
        batch = torch.broadcast_shapes(camera.batch_shape, self.pixels.shape[:-2])
        level = torch.full((*batch, 1), self.level, dtype=places.dtype, device=places.device)
        for step in range(STEPS + 1):
            height = level.unsqueeze(-1).expand(*batch, len(places), 1)
            points = torch.cat([places.expand(*batch, -1, -1), height], dim=-1)
            projected, valid = camera.project(points)
            off = torch.where(valid.unsqueeze(-1), (projected - self.pixels.to(projected)) / sigma, torch.nan)
            if step == STEPS:
                return off
            direction = (camera.R.unsqueeze(-3) @ (points - camera.center.unsqueeze(-2)).unsqueeze(-1)).squeeze(-1)
            axis = torch.tensor([0.0, 0, 1], dtype=off.dtype, device=off.device)
            direction = torch.where(valid.unsqueeze(-1), direction, axis)
            slope = (by_direction(camera.distortion, direction) @ up.unsqueeze(-1)).squeeze(-1)
            slope = (camera.K[..., None, :2, :2] @ slope.unsqueeze(-1)).squeeze(-1) / sigma
            square = slope.square().sum((-2, -1)).unsqueeze(-1)
            level = level - (slope * off).sum((-2, -1)).unsqueeze(-1) / torch.where(square > 0, square, 1.0)
        raise AssertionError  # the last step returns
