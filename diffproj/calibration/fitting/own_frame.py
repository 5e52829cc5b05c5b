"""The frame that is solved in: about the middle of a target's points, along their own axes.

Poses turn about the points' middle, so that it does not matter how far away the world's origin is: earth-centred
coordinates have seven digits before the point, and a turn about their origin is a shift by thousands of kilometres.
Points that lie on a plane lie on z = 0 of their own frame, wherever that plane is in the world.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

FLAT = 1e-9
"""Depth of points, relative to their extent, up to which they lie on a plane."""
ROUNDED = 8.0
"""The same in rounding errors of their coordinates."""


class OwnFrame(NamedTuple):
    """A target's own frame.

    Attributes:
        middle: the centroid of the points `(3,)` in the world.
        axes: the world's axes to its own `(3, 3)`, a rotation; `None` where they are the same, as for points on z = 0.
    """

    middle: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"] | None

    def own(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """World points in the own frame."""
        centred = points - self.middle
        return centred if self.axes is None else centred @ self.axes.mT

    def turned(self, moves: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch n 3"]:
        """Displacements of points along the own axes, of those along the world's."""
        return moves if self.axes is None else moves @ self.axes.mT

    def turned_back(self, moves: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch n 3"]:
        """Displacements along the world's axes, of those along the own."""
        return moves if self.axes is None else moves @ self.axes

    def pose(self, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Poses `(*, 3, 3)` and `(*, 3)` of the own frame, of those of the world."""
        t = t + R @ self.middle
        return (R if self.axes is None else R @ self.axes.mT), t

    def world_pose(self, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Poses of the world, of those of the own frame."""
        R = R if self.axes is None else R @ self.axes
        return R, t - R @ self.middle


def own_frame(points: Float[Tensor, "n 3"]) -> OwnFrame:
    """The own frame of points `(N, 3)`: along the world's axes if they are on z = 0, else along their principal axes.

    Example:
        >>> wall = torch.tensor([[7.0, 0, 0], [7, 4, 0], [7, 4, 2], [7, 0, 2]], dtype=torch.float64)
        >>> own_frame(wall).own(wall)[:, 2].abs().amax() < 1e-12
        tensor(True)
    """
    middle = points.mean(0)
    if bool((points[:, 2] == 0).all()):
        return OwnFrame(middle, None)
    axes = torch.linalg.svd(points - middle, full_matrices=len(points) < 3).Vh
    return OwnFrame(middle, torch.cat([axes[:2], torch.linalg.cross(axes[0], axes[1]).unsqueeze(0)]))


def are_solid(points: Float[Tensor, "n 3"]) -> bool:
    """Whether points `(N, 3)` of their own frame do not lie on a plane."""
    return bool(points[:, 2].abs().amax() > FLAT * points.abs().amax())


def flattened(own: Float[Tensor, "n 3"], world: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points of their own frame, on z = 0 exactly where their depth is no more than the world coordinates' rounding."""
    depth, rounding = own[:, 2].abs().amax(), torch.finfo(own.dtype).eps * world.abs().amax()
    if bool(depth > (FLAT * own.abs().amax()).maximum(ROUNDED * rounding)):
        return own
    return torch.nn.functional.pad(own[:, :2], (0, 1))
