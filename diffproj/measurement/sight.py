"""Where points come to lie when pixels, camera and plane move by their errors: on the curve, not on its tangent.

A moved camera sees a point at another pixel, and to first order looking through it is looking at a shifted pixel with
the camera as it is. That is accurate up to the horizon, and the step from pixels to the plane, far from straight there,
is the exact one. It is not where the lens is extrapolated.
"""

from dataclasses import dataclass

from torch import Tensor

from diffproj.geometry.back_projection import back_project
from diffproj.geometry.camera import Camera
from diffproj.geometry.plane import Plane


@dataclass(frozen=True, eq=False)
class Sight:
    """Measured pixels, and what maps them to the plane.

    Attributes:
        pixels: `(*B, N, 2)`.
        noise: their errors by two independent ones of deviation 1 `(*B, N, 2, 2)`.
        camera: at its pose.
        plane: what they lie on.
        by_theta: the derivative of the points' pixels by camera and pose `(*B, N, 2, q)`.
        away: where else the points may lie, linear in d more unknowns `(*B, N, 3, d)`.
        rig: which rig the camera is of, if it is of one.
        landmarks: places of those that the pose was found by and that are uncertain themselves.
    """

    pixels: Tensor
    noise: Tensor
    camera: Camera
    plane: Plane
    by_theta: Tensor
    away: Tensor
    rig: str | None = None
    landmarks: frozenset[tuple[float, ...]] = frozenset()

    def points(self, index: Tensor, theta: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """The points after a step of camera, pose and plane, and of the pixels.

        Args:
            index: numbers of the k pixels of each of M quantities `(M, k)`.
            theta: the step of camera, pose, plane where it is uncertain, and of the d unknowns `(*B, M, Q)`.
            noise: the pixels' step in standard deviations `(*B, M, k, 2)`.

        Returns:
            The points `(*B, M, k, 3)`, and which are on the plane `(*B, M, k)`.
        """
        M, k = index.shape
        q = self.by_theta.shape[-1]
        seen_from = (self.by_theta[..., index, :, :] @ theta[..., :q, None].unsqueeze(-3)).squeeze(-1)
        shaken = (self.noise[..., index, :, :] @ noise.unsqueeze(-1)).squeeze(-1)
        moved = self.pixels[..., index, :] + shaken - seen_from
        last = theta.shape[-1] - self.away.shape[-1]
        points, valid = back_project(moved.flatten(-3, -2), self.camera, self._plane(index, theta[..., q:last]))
        beside = (self.away[..., index, :, :] @ theta[..., last:, None].unsqueeze(-3)).squeeze(-1)
        return points.unflatten(-2, (M, k)) + beside, valid.unflatten(-1, (M, k))

    def _plane(self, index: Tensor, step: Tensor) -> Plane:
        if self.plane.is_per_point:
            shape, chosen = self.plane.batch_shape, index.flatten()
            normal, offset = self.plane.normal.expand(*shape, 3), self.plane.offset.expand(shape)
            return Plane.unchecked(normal[..., chosen, :], offset[..., chosen], is_per_point=True)
        if step.shape[-1] == 0:
            return self.plane
        normal, offset = self.plane.normal.unsqueeze(-2) + step[..., :3], self.plane.offset.unsqueeze(-1) + step[..., 3]
        k = index.shape[-1]
        return Plane.unchecked(
            normal.repeat_interleave(k, dim=-2), offset.repeat_interleave(k, dim=-1), is_per_point=True
        )


@dataclass(frozen=True, eq=False)
class Straight:
    """Joined points, which no single camera sees: a step of their errors moves them along a line.

    Attributes:
        at: the points `(*B, N, 3)`.
        valid: which of them somebody measured `(*B, N)`.
        by_theta: their derivative by their q errors `(*B, N, 3, q)`.
        plane: what they lie on.
    """

    at: Tensor
    valid: Tensor
    by_theta: Tensor
    plane: Plane

    def points(self, index: Tensor, theta: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """As `Sight.points` gives them; there are no pixels with a noise of their own."""
        step = (self.by_theta[..., index, :, :] @ theta[..., None].unsqueeze(-3)).squeeze(-1)
        return self.at[..., index, :] + step + 0 * noise.sum(-1, keepdim=True), self.valid[..., index].expand(
            step.shape[:-1]
        )
