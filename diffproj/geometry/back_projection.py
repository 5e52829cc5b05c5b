"""Pixels to points of a plane: one 4x3 matrix for each camera and plane.

Write `p = (u - c_x, v - c_y, 1)` for a pinhole's pixel, or the viewing direction in the camera frame that the lens
gives, and `r = G p` for the ray in the world, where `G = R^T diag(1/f_x, 1/f_y, 1)`, or `R^T` behind a lens. The ray
from the centre `C` meets the plane `n . X = d` at

    X = C + s r,    s = (d - n . C) / (n . r).

Both parts of the fraction are linear in `p`, so one matrix holds camera and plane together:

    b = G^T n        A = C b^T + (d - n . C) G        M = [A; b] (4, 3)        X = A p / (b . p).

`s` is the depth along the optical axis (behind a fisheye lens, the distance along the ray), so the point lies in front
of the camera where `s > 0`. The sign of `M` is free and is chosen so that `d - n . C >= 0`: then one comparison,
`b . p > s . |p|`, says that the ray neither runs parallel to the plane nor meets it behind the camera: s holds the
size of b, times some units in the last place. Pixels are centred before they meet `M`, which keeps float32 accurate;
`M` itself is built in float64.
"""

import enum
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.linalg import vector_norm

from diffproj._core.arguments import Array, tensor_of
from diffproj._core.batched import register_pytree
from diffproj._core.copying import Copied
from diffproj._core.numerics import (
    broadcast_batches,
    check_same_kind,
    dot,
    entries,
    has_values,
    in_blocks,
    linear,
)
from diffproj._core.shown import Shown
from diffproj._core.torch_private import in_forward_mode
from diffproj._core.warn import warn_caller
from diffproj.geometry import description
from diffproj.geometry.camera import Camera, as_camera, meeting_camera
from diffproj.geometry.float32 import looks_at_rounding, warn_of_rounding
from diffproj.geometry.intrinsics import normalised, pixel_to_normalized
from diffproj.geometry.map_views import MapViews
from diffproj.geometry.plane import Plane, as_plane
from diffproj.geometry.plane_kernel import components, denominator_and_threshold, direct, intersection, recorded
from diffproj.geometry.plane_matrix import plane_matrix
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.slopes import by_direction


class Reason(enum.IntEnum):
    """Why a pixel has no point on the plane, as `explain` reports it."""

    VALID = 0
    """It has one."""
    NOT_FINITE = 1
    """The pixel is NaN or infinite."""
    OUTSIDE_LENS = 2
    """The lens has no inverse there: no viewing ray reaches this pixel."""
    CAMERA_ON_PLANE = 3
    """The centre of projection lies in the plane."""
    PARALLEL = 4
    """The ray is parallel to the plane, to within rounding."""
    BEHIND = 5
    """The ray meets the plane behind the camera."""


class PlaneMap(MapViews, Copied, Shown):
    """The map from pixels to points of a plane, built once for a camera and a plane and then applied at will.

    `back_project` builds one for each call; keep one where camera and plane stay as they are. It is a PyTree.

    Attributes:
        matrix: `[A; b; s] (*B, 5, 3)` up to a positive factor, in the camera's dtype.
        camera: the camera, whose principal point and lens lead from pixels to `p`.
        is_per_point: whether the last batch axis runs over the points.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
        >>> camera = Camera(K, t=torch.tensor([0.0, 0, 1000], dtype=torch.float64))
        >>> to_board = PlaneMap(camera, Plane.z(0.0))
        >>> points, valid = to_board(torch.tensor([[370.0, 240.0]], dtype=torch.float64))
        >>> points.tolist()
        [[100.0, 0.0, 0.0]]
    """

    __slots__ = ("camera", "is_per_point", "matrix")

    matrix: Tensor
    camera: Camera
    is_per_point: bool

    def __init__(self, camera: Camera | PinholeCamera, plane: Plane) -> None:
        """Build the map.

        Raises:
            TypeError: not a camera and a plane, or of different dtypes.
            ValueError: different devices, or batch shapes that do not broadcast.
        """
        self._build(camera, plane, warn=True)

    @classmethod
    def quietly(cls, camera: Camera, plane: Plane) -> "PlaneMap":
        """The same without a warning of rounding: for who builds a map again and again, and has warned before."""
        plane_map = cls.__new__(cls)
        plane_map._build(camera, plane, warn=False)
        return plane_map

    def _build(self, camera: Camera | PinholeCamera, plane: Plane, warn: bool) -> None:
        camera, plane = as_camera(camera), as_plane(plane)
        plane = plane.like(camera.K)
        check_same_kind(camera=camera.K, plane=plane.normal)
        if plane.is_per_point:
            camera = camera[..., None]
        broadcast_batches(camera=camera.batch_shape, plane=plane.batch_shape)
        self.matrix = plane_matrix(camera, plane, warn)
        # Principal point and lens are read at each call: of a camera that was written to since they would not go with
        # the matrix.
        lens = camera.distortion
        if isinstance(lens, CoefficientLens) and has_values(lens.coefficients):
            lens = lens.planned(lens.coefficients.clone(), lens.plan())
        self.camera = Camera.unchecked(camera.K.clone(), camera.R, camera.t, lens, camera.size)
        self.is_per_point = plane.is_per_point

    @classmethod
    def unchecked(cls, matrix: Any, camera: Any, is_per_point: bool) -> "PlaneMap":
        """A map of these parts, without a look at them."""
        plane_map = cls.__new__(cls)
        plane_map.matrix, plane_map.camera, plane_map.is_per_point = matrix, camera, is_per_point
        return plane_map

    def __call__(
        self, pixels: Float[Tensor, "*#batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"]]:
        """Points `(*B, N, 3)` and `valid (*B, N)` of pixels `(*B, N, 2)`; see `back_project`."""
        pixels = self._checked(pixels)
        kernel = direct if has_values(pixels, self.matrix) and not in_forward_mode() else recorded

        def to_plane(pixels: Tensor) -> tuple[Tensor, Tensor]:
            p, seen = self._sight(pixels)
            return kernel(p, self.matrix, seen)

        points, valid = in_blocks(to_plane, pixels, self.matrix, *self.camera.tensors())
        return (points.squeeze(-2), valid.squeeze(-1)) if self.is_per_point else (points, valid)

    def with_reach(
        self, pixels: Float[Tensor, "*#batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"], Bool[Tensor, "*#batch n"]]:
        """Points and `valid` as calling the map gives them, and where the lens has an inverse `(*B, N)`."""

        def to_plane(pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            p, seen = self._sight(pixels)
            points, valid = recorded(p, self.matrix, seen)
            return points, valid, p.isfinite().all(-1) if seen is None else seen

        points, valid, seen = in_blocks(to_plane, self._checked(pixels), self.matrix, *self.camera.tensors())
        if self.is_per_point:
            return points.squeeze(-2), valid.squeeze(-1), seen.squeeze(-1)
        return points, valid, seen

    def resolution(
        self, pixels: Float[Tensor, "*#batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*#batch n"], Bool[Tensor, "*#batch n"]]:
        """World units that a pixel covers `(*B, N)`, and `valid (*B, N)`; see the function `ground_resolution`."""
        found, valid = in_blocks(self._resolution, self._checked(pixels), self.matrix, *self.camera.tensors())
        return (found.squeeze(-1), valid.squeeze(-1)) if self.is_per_point else (found, valid)

    def explain(self, pixels: Float[Tensor, "*#batch n 2"] | Array) -> Int[Tensor, "*#batch n"]:
        """`Reason` codes `(*B, N)` of pixels `(*B, N, 2)`; see the function `explain`."""
        (reasons,) = in_blocks(self._explain, self._checked(pixels), self.matrix, *self.camera.tensors())
        return reasons.squeeze(-1) if self.is_per_point else reasons

    def _facts(self) -> list[str]:
        planes = "a plane for each point" if self.is_per_point else ""
        return [repr(self.camera), planes]

    def _resolution(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """See `ground_resolution`."""
        p, seen = self._sight(pixels)
        sight, points, inverse, valid = intersection(p, self.matrix, seen)
        steps = self._sight_slopes(sight, valid)
        by_u, by_v = (
            torch.stack([(along - point * fall) * inverse for along, point in zip(step[:3], points, strict=True)], -1)
            for step in steps
            for fall in step[3:]
        )
        return _largest_singular_value(by_u, by_v), valid

    def _sight_slopes(self, sight: Sequence[Tensor | None], valid: Tensor) -> list[list[Tensor]]:
        """The derivatives of `M p` by u and by v: four components each, to within a multiple of `M p` itself."""
        *rows, _ = entries(self.matrix)
        if self.camera.distortion is None:  # p follows the pixel
            return [[row[axis] for row in rows] for axis in (0, 1)]
        one = torch.ones_like(valid, dtype=self.matrix.dtype)
        x, y, z = (one if component is None else component for component in sight)
        direction = torch.stack([x, y, torch.where(valid, z, 1.0)], dim=-1)
        # The distorted point does not change along p: any step does that moves it by what the pixel's step asks.
        g, h = by_direction(self.camera.distortion, direction).unbind(-2)
        toward, across = torch.linalg.cross(h, direction), torch.linalg.cross(direction, g)
        volume = dot(g, toward).unsqueeze(-1)
        F_inverse = pixel_to_normalized(self.camera.K).unsqueeze(-3)
        steps = ((F_inverse[..., :1, axis] * toward + F_inverse[..., 1:, axis] * across) / volume for axis in (0, 1))
        return [linear(rows, step.unbind(-1)) for step in steps]

    def _explain(self, pixels: Tensor) -> tuple[Tensor]:
        p, seen = self._sight(pixels)
        denominator, threshold = denominator_and_threshold(self.matrix, components(p))
        reasons = torch.where(denominator > threshold, Reason.VALID, Reason.PARALLEL)
        reasons = torch.where(denominator < -threshold, Reason.BEHIND, reasons)
        reasons = torch.where((self.matrix[..., 3, :] == 0).all(dim=-1, keepdim=True), Reason.CAMERA_ON_PLANE, reasons)
        if seen is not None:
            reasons = torch.where(seen, reasons, Reason.OUTSIDE_LENS)
        return (torch.where(pixels.isfinite().all(dim=-1), reasons, Reason.NOT_FINITE),)

    def _sight(self, pixels: Tensor) -> tuple[Tensor, Tensor | None]:
        """The p of a pinhole or behind a lens, and where the lens has an inverse (`None`: everywhere)."""
        lens = self.camera.distortion
        if lens is None:
            return pixels - self.camera.K.select(-1, 2).narrow(-1, 0, 2).unsqueeze(-2), None
        if isinstance(lens, BrownConrady) and type(lens) is BrownConrady:  # one derived from it may go back otherwise
            xy, finite = normalised(pixels, self.camera.K)
            xy, seen = lens.undistort_apart(xy)
            return xy, seen & finite
        return self.camera.directions(pixels)

    def _checked(self, pixels: Tensor | Array) -> Tensor:
        if self.is_per_point:
            pixels = tensor_of("pixels", pixels, self.camera.K)
            pixels = pixels.unsqueeze(-2) if pixels.ndim >= 2 else pixels
        pixels = meeting_camera(self.camera, "pixels", pixels, 2)
        batch, given = self.matrix.shape[:-2], pixels.shape[:-2]
        if batch == given:
            return pixels
        return pixels.expand(*broadcast_batches(map=batch, pixels=given), *pixels.shape[-2:])


def back_project(
    pixels: Float[Tensor, "*#batch n 2"] | Array, camera: Camera | PinholeCamera, plane: Plane
) -> tuple[Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"]]:
    """Intersect the viewing rays of pixels with a plane.

    Differentiable in the pixels and in every parameter of camera and plane, in reverse and forward mode and to any
    order; works under `vmap` and `torch.compile(fullgraph=True)`. Long inputs are handled in blocks when no derivative
    is asked.

    Args:
        pixels: `(*B, N, 2)`; half and bfloat16 are lifted to the camera's dtype.
        camera: a camera of batch shape `*B`, or Kornia's `PinholeCamera`.
        plane: a plane of batch shape `*B`, or one for each point (`Plane.per_point`) of batch shape `(*B, N)`.

    Returns:
        World points `(*B, N, 3)` in the dtype of the camera, and `valid (*B, N)`: false where the pixel is not finite,
        the lens has no inverse, the ray is parallel to the plane or within rounding of it, or meets it behind the
        camera. Points are (0, 0, 0) there, and their gradient is zero. A camera without a pose, whose world is its own
        frame, lies in planes through the origin: a warning says so.

    Raises:
        TypeError: not pixels, a camera and a plane in this order, or tensors of integers or of mixed dtypes.
        ValueError: wrong shapes, mixed devices, or batch shapes that do not broadcast.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64, requires_grad=True)
        >>> camera = Camera(K, t=torch.tensor([0.0, 0, 1000], dtype=torch.float64))
        >>> pixels = torch.tensor([[370.0, 240.0], [320.0, 250.0]], dtype=torch.float64)
        >>> points, valid = back_project(pixels, camera, Plane.z(0.0))
        >>> points.tolist(), valid.tolist()
        ([[100.0, 0.0, 0.0], [0.0, 20.0, 0.0]], [True, True])
        >>> points[0, 0].backward()
        >>> round(K.grad[0, 0].item(), 9)  # millimetres for one pixel more of focal length
        -0.2
    """
    to_plane = PlaneMap(camera, plane)
    if _lacks_pose(to_plane):
        warn_caller(
            "camera: want one with a pose, got one whose world is its own frame (R = I, t = 0) and lies in the plane, "
            "so that no pixel has a point; calibration.cameras[view] and dp.locate(...).cameras have poses"
        )
    return to_plane(pixels)


def explain(
    pixels: Float[Tensor, "*#batch n 2"] | Array, camera: Camera | PinholeCamera, plane: Plane
) -> Int[Tensor, "*#batch n"]:
    """Say for each pixel why it has no point on the plane, or that it has one.

    Args:
        pixels: `(*B, N, 2)`.
        camera: as for `back_project`.
        plane: as for `back_project`.

    Returns:
        Integers `(*B, N)`: the codes of `Reason`, 0 where the point is valid. Of several reasons the first in the
        order of the pixel's way counts: not finite, outside the lens, camera on the plane, parallel, behind.

    Raises:
        TypeError: as `back_project`.
        ValueError: as `back_project`.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
        >>> floor = Plane([0.0, 1.0, 0.0], 1.5)  # 1.5 below a camera that looks to the horizon
        >>> pixels = torch.tensor([[320.0, 300.0], [320.0, 240.0], [320.0, 100.0]], dtype=torch.float64)
        >>> [Reason(code).name for code in explain(pixels, Camera(K), floor).tolist()]
        ['VALID', 'PARALLEL', 'BEHIND']
    """
    return PlaneMap(camera, plane).explain(pixels)


def ground_resolution(
    pixels: Float[Tensor, "*#batch n 2"] | Array, camera: Camera | PinholeCamera, plane: Plane
) -> tuple[Float[Tensor, "*#batch n"], Bool[Tensor, "*#batch n"]]:
    """World units that a pixel covers on the plane along its worst direction.

    Args:
        pixels: `(*B, N, 2)`.
        camera: as for `back_project`.
        plane: as for `back_project`.

    Returns:
        `(*B, N)`, 0 where not valid; and `valid (*B, N)`.

    The gradient is that of the worst direction's; where all directions are alike, as straight above the plane, that of
    their mean.

    Raises:
        TypeError: as `back_project`.
        ValueError: as `back_project`.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> ground_resolution(torch.tensor([[320.0, 240.0]]), Camera(K, t=torch.tensor([0.0, 0, 1000])), Plane.z(0.0))
        (tensor([2.]), tensor([True]))
    """
    return PlaneMap(camera, plane).resolution(pixels)


def warn_if_rounded(camera: Camera, plane: Plane) -> None:
    """Warn where float32 rounds the places that a camera sees on a plane visibly; see `warn_of_rounding`."""
    if looks_at_rounding(camera.t):
        with torch.no_grad():
            plane = plane.like(camera.K)
            height = (dot(plane.normal, camera.center) - plane.offset).abs()
            warn_of_rounding(plane.offset.abs() + plane.length * vector_norm(camera.t, dim=-1), height)


def _lacks_pose(to_plane: PlaneMap) -> bool:
    """Whether all cameras are where the world's origin is, in the plane, and look along its axes; false if not told."""
    R, t = to_plane.camera.R, to_plane.camera.t
    if t.device.type != "cpu" or not has_values(t, to_plane.matrix) or t.numel() == 0:
        return False
    if t.numpy(force=True).any():  # in NumPy, for this is asked in each call
        return False
    return not bool(to_plane.matrix[..., 3, :].any()) and description.without_pose(R, t)


def _largest_singular_value(by_u: Tensor, by_v: Tensor) -> Tensor:
    """Of 3 x 2 matrices with these columns `(*B, n, 3)`, from their 2 x 2 Gram matrices; 0, with no slope, of zeros."""
    size = torch.maximum(by_u.detach().abs().amax(-1), by_v.detach().abs().amax(-1))
    size = torch.where(size > 0, size, 1.0)  # squares of 1e-25 are 0 in float32
    by_u, by_v = by_u / size.unsqueeze(-1), by_v / size.unsqueeze(-1)
    a, b, c = dot(by_u, by_u), dot(by_u, by_v), dot(by_v, by_v)
    apart = (a != c) | (b != 0)
    spread = torch.where(apart, torch.hypot(torch.where(apart, (a - c) / 2, 1.0), torch.where(apart, b, 0.0)), 0.0)
    squared = (a + c) / 2 + spread
    some = squared > 0
    return torch.where(some, torch.where(some, squared, 1.0).sqrt(), 0.0) * size


register_pytree(PlaneMap, children=("matrix", "camera"), constants=("is_per_point",))
