"""`Ellipses`: where measured points may lie on their plane, as areas that hold the truth with a given probability."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import whole_number
from diffproj._core.copying import Copied
from diffproj._core.shown import Shown, counted, number
from diffproj.geometry.rectification import plane_axes
from diffproj.measurement.folded import longest_first
from diffproj.measurement.propagation import Noise, Propagated


@dataclass(frozen=True, eq=False, repr=False)
class Ellipses(Copied, Shown):
    """An ellipse on the plane around each measured point; NaN where a point is not valid.

    Attributes:
        center: the points `(*B, N, 3)`.
        half_axes: the larger one first `(*B, N, 2)`, in world units; infinite where a direction is not determined.
        directions: unit vectors along them `(*B, N, 2, 3)` in the world.
        angle: from the plane's first axis to the larger one in radians `(*B, N)`, from -pi/2 to pi/2: on a plane
            z = const from x towards y. See `plane_axes`.
        level: the probability with which the truth lies inside.
    """

    center: Float[Tensor, "*batch n 3"]
    half_axes: Float[Tensor, "*batch n 2"]
    directions: Float[Tensor, "*batch n 2 3"]
    angle: Float[Tensor, "*batch n"]
    level: float

    def outline(self, count: int = 64) -> Float[Tensor, "*batch n count 3"]:
        """Points around each ellipse `(*B, N, count, 3)` in the world, for a map.

        Raises:
            TypeError: count is no whole number.
            ValueError: it is below 3.
        """
        count = whole_number("count", count, "a whole number from 3 to 10,000", least=3, most=10_000)
        turn = torch.arange(count, dtype=self.center.dtype, device=self.center.device) * (2 * math.pi / count)
        around = torch.stack([turn.cos(), turn.sin()], dim=-1)
        return self.center.unsqueeze(-2) + (around * self.half_axes.unsqueeze(-2)) @ self.directions

    def to_dict(self) -> dict[str, list[Any]]:
        """The ellipses as columns of Python's own numbers: `pandas.DataFrame` takes it."""
        columns = (*self.center.unbind(-1), *self.half_axes.unbind(-1), self.angle)
        names = "x", "y", "z", "half_major", "half_minor", "angle"
        return {name: part.detach().flatten().tolist() for name, part in zip(names, columns, strict=True)}

    def _facts(self) -> list[str]:
        known = self.half_axes[self.half_axes.isfinite()]
        return [counted(self.angle.shape, "ellipse"), f"half axes {number(known, '.3g')}", f"level {self.level:g}"]

    def _columns(self) -> dict[str, list[Any]]:
        return self.to_dict()


def plane_ellipses(noise: Noise, points: Tensor, covariance: Tensor, level: float) -> Ellipses:
    """Ellipses of points `(*B, N, 3)` with these covariances `(*B, N, 3, 3)` on the plane that they were measured on.

    Two coordinates whose scale was estimated with n degrees of freedom are, squared and over it, twice Fisher's F with
    2 and n of them, whose quantile is `n / 2 ((1 - level)^(-2 / n) - 1)`; with a known scale it is `-ln(1 - level)`.

    Args:
        noise: of the points.
        points: the centres.
        covariance: NaN where not valid, infinite on the diagonal where not determined.
        level: the probability.
    """
    plane = noise.sight.plane
    _, *axes = plane_axes(plane)
    tangents = torch.stack(axes, dim=-1)
    tangents = (tangents if plane.is_per_point else tangents.unsqueeze(-3)).expand(*points.shape, 2)
    index = torch.arange(points.shape[-2], device=points.device).unsqueeze(-1)
    every = torch.eye(3, dtype=points.dtype, device=points.device).unsqueeze(-2).expand(*points.shape, 1, 3)
    spread = Propagated.of(noise, index, every)
    freedom = spread.degrees_of_freedom(longest_first(spread.covariance.detach())[1])
    lost = covariance.isinf().any(-1).any(-1)
    gone = covariance.isnan().any(-1).any(-1)
    C = torch.where((lost | gone)[..., None, None], 0.0, covariance)
    sizes, turn = torch.linalg.eigh(tangents.mT @ C @ tangents)
    sizes, turn = sizes.flip(-1).clamp(min=0), turn.flip(-1)
    few = -math.log1p(-level)
    n = freedom.clamp(max=1e12)
    reach = torch.where(n > 0, n * torch.expm1(2 * few / n.clamp(min=1e-300)), torch.inf).sqrt()
    unit = torch.where(sizes > 0, torch.where(sizes > 0, sizes, 1.0).sqrt(), 0.0)
    half = torch.where(lost.unsqueeze(-1), torch.inf, unit * reach.unsqueeze(-1))
    half = torch.where(gone.unsqueeze(-1), torch.nan, half)
    along = turn[..., 0]
    along = torch.where(((along[..., :1] < 0) | ((along[..., :1] == 0) & (along[..., 1:] < 0))), -along, along)
    angle = torch.where(gone, torch.nan, torch.atan2(along[..., 1], along[..., 0]))
    across = torch.stack([-along[..., 1], along[..., 0]], dim=-1)
    directions = torch.stack([along, across], dim=-2) @ tangents.mT
    nowhere = gone[..., None]
    return Ellipses(torch.where(nowhere, torch.nan, points), half, directions, angle, level)
