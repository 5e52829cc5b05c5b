"""What else a `PlaneMap` tells: by how much rays miss the plane, its homography, and some of a batch of maps."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, listing
from diffproj._core.batched import check_index, index_batch
from diffproj._core.numerics import (
    broadcast_batches,
    check_same_kind,
    check_tensor,
    has_values,
    in_blocks,
    in_float64,
    rounding,
    transform,
)
from diffproj.geometry.camera import Camera
from diffproj.geometry.intrinsics import pixel_to_normalized
from diffproj.geometry.plane_kernel import intersection


class MapViews:
    """The part of `PlaneMap` that is not about points."""

    __slots__ = ()

    matrix: Tensor
    camera: Camera
    is_per_point: bool

    if TYPE_CHECKING:  # what `PlaneMap` has

        @classmethod
        def unchecked(cls, matrix: Any, camera: Any, is_per_point: bool) -> Any:
            """See `PlaneMap`."""
            ...

        def _checked(self, pixels: Tensor | Array) -> Tensor: ...

        def _sight(self, pixels: Tensor) -> tuple[Tensor, Tensor | None]: ...

    def miss(self, pixels: Float[Tensor, "*#batch n 2"] | Array) -> Float[Tensor, "*#batch n"]:
        """The angle in radians by which each pixel's ray misses the plane `(*B, N)`; 0 where it meets it.

        That is the angle between the ray and the plane where the ray leads away from it, 0 at the horizon and growing
        from there, with a gradient that leads back. A pixel that the lens does not see has no ray; its angle is that
        from the optical axis of the ray that a pinhole would have. It is 0, without a gradient, of a pixel that is
        not finite, and of a camera that lies in the plane.

        Args:
            pixels: `(*B, N, 2)`.

        Raises:
            TypeError: as `back_project`.
            ValueError: as `back_project`.

        Example:
            >>> import diffproj as dp
            >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
            >>> floor = dp.PlaneMap(dp.Camera(K), dp.Plane([0.0, 1.0, 0.0], 1.5))  # the camera looks level
            >>> floor.miss(torch.tensor([[320.0, 300.0], [320.0, 190.0]])).rad2deg()
            tensor([0.0000, 5.7106])
        """

        def miss(pixels: Tensor) -> tuple[Tensor]:
            return (self._miss(pixels),)

        (found,) = in_blocks(miss, self._checked(pixels), self.matrix, *self.camera.tensors())
        return found.squeeze(-1) if self.is_per_point else found

    def _miss(self, pixels: Tensor) -> Tensor:
        p, seen = self._sight(pixels)
        meets = intersection(p.detach(), self.matrix.detach(), seen)[3]
        finite = (pixels.abs() < torch.finfo(pixels.dtype).max ** 0.25).all(-1)
        off_plane = (self.matrix[..., 3, :] != 0).any(-1, keepdim=True)
        seen = finite if seen is None else finite & seen
        # The ray in the camera frame, and the normal, turned to where rays that meet the plane lead.
        offset = torch.where(finite.unsqueeze(-1), pixels, 0.0) - self.camera.K[..., None, :2, 2]
        xy = transform(pixel_to_normalized(self.camera.K), offset)
        pinhole = torch.nn.functional.pad(xy, (0, 1), value=1.0)
        normal = self.matrix[..., 3, :]
        if self.camera.distortion is None:
            ray = pinhole
            F = self.camera.K[..., :2, :2]
            normal = torch.cat([(F * normal[..., :2, None]).sum(-2), normal[..., 2:]], dim=-1)
        else:
            ray = p if p.shape[-1] == 3 else torch.nn.functional.pad(p, (0, 1), value=1.0)
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=ray.dtype, device=ray.device)
        normal = torch.where(off_plane, normal, axis).unsqueeze(-2)
        away = -_angle(torch.where(seen.unsqueeze(-1), ray, axis), normal)
        outside = math.pi / 2 - _angle(pinhole, axis)
        found = torch.where(seen, torch.where(off_plane, away.clamp_min(0.0), 0.0), outside)
        return torch.where(meets | ~finite, 0.0, found)

    def homography(self, axes: tuple[Tensor, Tensor, Tensor] | None = None) -> Float[Tensor, "*batch 3 3"]:
        """The matrix from pixels `(u, v, 1)` to the plane's own coordinates `(s, t, 1)`, up to a positive factor.

        The third number is positive where the pixel sees the plane. Its inverse leads back to pixels: with a matrix
        from the plane's coordinates to a top view's pixels in front, it is what `cv2.warpPerspective` and Kornia's
        `warp_perspective` take.

        The factor follows camera and plane, and gradients leave out how it changes: those of the entries as they are
        mean as little as their size. A loss on entries normalises them first: `H / H[..., 2:, 2:]` has the right
        gradients, as has all that the factor cancels from. (Its divisor is positive where pixel (0, 0) sees the plane.)

        Args:
            axes: `(origin, axis_s, axis_t)` of the plane, each `(*B, 3)`, as `plane_axes(plane)` gives them; the
                world's x and y if left out, for a plane of constant z.

        Raises:
            TypeError: axes that are no three vectors.
            ValueError: a camera behind a lens, whose map is no matrix; one plane for each point; axes of other shapes;
                or none for a plane that is not level.

        Example:
            >>> import diffproj as dp
            >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
            >>> H = dp.PlaneMap(dp.Camera(K, t=torch.tensor([0.0, 0, 1000])), dp.Plane.z(0.0)).homography()
            >>> s, t, w = (H @ torch.tensor([370.0, 240.0, 1.0])).tolist()
            >>> round(s / w, 4), round(t / w, 4), w > 0
            (100.0, 0.0, True)
        """
        if self.camera.distortion is not None:
            raise ValueError(
                "homography: want a pinhole, got a camera behind a lens; undistort first, or use dp.rectify"
            )
        if self.is_per_point:
            raise ValueError("homography: want one plane, got one for each point (Plane.per_point)")
        M = in_float64(self.matrix)
        A, b = M[..., :3, :], M[..., 3, :]
        if axes is None:
            if has_values(M):
                with torch.no_grad():
                    K, R = in_float64(self.camera.K), in_float64(self.camera.R)
                    in_camera = torch.cat([(K[..., :2, :2] * b[..., :2, None]).sum(-2), b[..., 2:]], dim=-1)
                    # By the inverse of R, times its determinant: R is a rotation to the rounding of float32 at best.
                    first, second, third = R.unbind(-2)
                    across = [torch.linalg.cross(a, b) for a, b in ((second, third), (third, first), (first, second))]
                    normal = (torch.stack(across, dim=-2) * in_camera.unsqueeze(-1)).sum(-2)
                    aside = normal[..., :2].abs().amax(-1) > 1e3 * rounding(self.matrix.dtype) * normal[..., 2].abs()
                if bool(aside.any()):
                    raise ValueError("axes: want those of plane_axes(plane) for a plane that is not level, got None")
            rows = torch.stack([A[..., 0, :], A[..., 1, :], b], dim=-2)
        else:
            three = listing("axes", axes, "(origin, axis_s, axis_t), as plane_axes gives them")
            if len(three) != 3:
                raise ValueError(f"axes: want (origin, axis_s, axis_t), as plane_axes gives them, got {len(three)}")
            given = [check_tensor("axes", axis, 3, like=self.matrix) for axis in three]
            for axis in given:
                check_same_kind(map=self.matrix, axes=axis)
            batch = broadcast_batches(
                map=self.matrix.shape[:-2], **{f"axes[{i}]": x.shape[:-1] for i, x in enumerate(given)}
            )
            origin, *along = (in_float64(axis).expand(*batch, 3) for axis in given)
            rows = torch.stack(
                [(axis.unsqueeze(-1) * (A - origin.unsqueeze(-1) * b.unsqueeze(-2))).sum(-2) for axis in along]
                + [b.expand(*batch, 3)],
                dim=-2,
            )
        center = in_float64(self.camera.K[..., None, :2, 2])
        last = rows[..., 2:] - (rows[..., :2] * center).sum(-1, keepdim=True)
        return torch.cat([rows[..., :2], last], dim=-1).to(self.matrix.dtype)

    def __getitem__(self, index: Any) -> Any:
        """Maps of the batch, chosen as one indexes a tensor of shape `*B`.

        Raises:
            TypeError: the index is not one that tensors take.
            IndexError: there is no such map, or there is one plane for each point.
        """
        if self.is_per_point:
            raise IndexError("map: want a batch of maps to index, got planes per point")
        check_index(index)
        batch = broadcast_batches(map=self.matrix.shape[:-2], camera=self.camera.batch_shape)
        matrix, camera = self.matrix.expand(*batch, *self.matrix.shape[-2:]), self.camera
        camera = camera if camera.batch_shape == batch else camera.expand(*batch)
        return type(self).unchecked(index_batch(matrix, index, 2), camera[index], False)

    def __iter__(self) -> Iterator[Any]:
        """The maps of the first batch axis, one after the other.

        Raises:
            TypeError: there is no batch axis, or there is one plane for each point.
        """
        if self.is_per_point:
            raise TypeError("map: want a batch of maps to go through, got planes per point")
        batch = broadcast_batches(map=self.matrix.shape[:-2], camera=self.camera.batch_shape)
        if not batch:
            raise TypeError("map: want a batch of maps to go through, got a single one")
        return (self[number] for number in range(batch[0]))


def _angle(ray: Tensor, normal: Tensor) -> Tensor:
    """The angle between rays `(*B, N, 3)` and the plane of a normal, from -pi/2 to pi/2, positive along the normal."""
    ray = ray / ray.detach().abs().amax(-1, keepdim=True)
    normal = normal / normal.detach().abs().amax(-1, keepdim=True)
    across = torch.linalg.cross(ray, normal.expand_as(ray), dim=-1).square().sum(-1)
    some = across > 0  # the root's slope at 0 is infinite
    return torch.atan2((ray * normal).sum(-1), torch.where(some, torch.where(some, across, 1.0).sqrt(), 0.0))
