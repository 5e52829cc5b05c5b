"""`Camera`: intrinsics, lens and pose of one camera or of a batch of them.

A world point reaches its pixel in three steps, and a pixel goes back by the same steps reversed:

    X_cam = R X_world + t              pose: world to camera frame (x right, y down, z forward)
    xy    = lens(X_cam)                lens: direction to distorted point on the normalised plane; x / z, y / z if none
    uv    = F xy + c                   intrinsics: K = [[F, c], [0, 0, 1]], F usually diag(f_x, f_y)

`F` may be any invertible 2x2 matrix: skew, or an image that an augmentation has turned, stays exact.
"""

import os
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.utils._pytree import tree_leaves

from diffproj._core.arguments import Array, instance, meeting
from diffproj._core.batched import Batched
from diffproj._core.numerics import (
    broadcast_batches,
    check_same_kind,
    check_tensor,
    dot,
    entries,
    has_values,
    in_blocks,
    interleaved,
    linear,
    transform,
    wants_derivative,
)
from diffproj.geometry import description
from diffproj.geometry.changed_images import ChangedImages
from diffproj.geometry.exchange import Exchange
from diffproj.geometry.float32 import looks_at_rounding, warn_of_rounded_pixels
from diffproj.geometry.grid import checked_size, inside
from diffproj.geometry.image_sides import warn_of_exchanged
from diffproj.geometry.intrinsics import check_intrinsics, normalised, through_pinhole
from diffproj.geometry.placement import Placed
from diffproj.geometry.rotations import check_pose
from diffproj.lens.protocol import Lens


class Camera(
    ChangedImages,
    Exchange,
    Placed,
    Batched,
    tensors={"K": 2, "R": 2, "t": 1},
    parts=("distortion",),
    constants=("size",),
    remedies={
        "distortion": "dp.ProjectorBank takes cameras with different lenses; a batch wants one lens model for all, a "
        "shorter one with 0 as its other coefficients",
        "size": "dp.ProjectorBank takes cameras of different sizes; a batch wants one for all, see resized()",
    },
):
    """A calibrated camera, or a batch of them with batch shape `*B`; the parts broadcast to it.

    The camera is immutable in spirit: methods return new cameras that share tensors, and gradients flow to whatever
    tensors it was built from. It is a PyTree: `vmap`, `torch.func`, `torch.compile` and `torch.export` carry it.

    Attributes:
        K: intrinsics `(*B, 3, 3)` in pixels, integer coordinates at pixel centres; the last row is (0, 0, 1).
        R: rotation world to camera `(*B, 3, 3)`.
        t: translation world to camera `(*B, 3)` in world units: `X_cam = R X_world + t`.
        distortion: the lens, or `None` for a pinhole.
        size: image size `(width, height)` in pixels, or `None`.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
        >>> camera = Camera(K, t=torch.tensor([0.0, 0, 1000], dtype=torch.float64), size=(640, 480))
        >>> pixels, valid = camera.project(torch.tensor([[100.0, 0, 0]], dtype=torch.float64))
        >>> pixels.tolist(), valid.tolist()  # 100 to the right at a distance of 1000: 50 px
        ([[370.0, 240.0]], [True])
    """

    __slots__ = ("K", "R", "distortion", "size", "t")

    K: Tensor
    R: Tensor
    t: Tensor
    distortion: Lens | None
    size: tuple[int, int] | None

    def __init__(
        self,
        K: Float[Tensor, "*#batch 3 3"] | Array,
        R: Float[Tensor, "*#batch 3 3"] | Array | None = None,
        t: Float[Tensor, "*#batch 3"] | Array | None = None,
        distortion: Lens | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        """Build a camera and check it.

        Args:
            K: intrinsics `(*B, 3, 3)`.
            R: rotation world to camera `(*B, 3, 3)`; the identity if left out.
            t: translation world to camera `(*B, 3)`; zero if left out.
            distortion: `BrownConrady(...)`, `KannalaBrandt(...)` or another `Lens`.
            size: image size `(width, height)` in pixels; a warning says so where it is portrait
                and the principal point that of a landscape image with these sides.

        Raises:
            TypeError: no floating-point tensors, or mixed dtypes.
            ValueError: wrong shapes or devices, a K without inverse, an R that is no rotation to 1e-5, or values
                that are not finite. Values are checked where they can be read, not while compiling or under `vmap`.
        """
        K = check_tensor("K", K, 3, 3, like=None if isinstance(K, Tensor) else meeting(R, t, distortion))
        R = torch.eye(3, dtype=K.dtype, device=K.device) if R is None else check_tensor("R", R, 3, 3, like=K)
        t = torch.zeros(3, dtype=K.dtype, device=K.device) if t is None else check_tensor("t", t, 3, like=K)
        if distortion is not None:
            check_lens(distortion)
        if has_values(K, R, t):
            check_intrinsics(K)
            check_pose(R, t)
        self._assign(K, R, t, distortion, checked_size(size))
        warn_of_exchanged(K, self.size)

    def _assign(self, K: Tensor, R: Tensor, t: Tensor, distortion: Lens | None, size: tuple[int, int] | None) -> None:
        check_same_kind(K=K, R=R, t=t, distortion=distortion)
        shapes = {"K": K.shape[:-2], "R": R.shape[:-2], "t": t.shape[:-1]}
        if distortion is not None:
            shapes["distortion"] = distortion.batch_shape
        batch = broadcast_batches(**shapes)
        self.K = K.expand(*batch, 3, 3)
        self.R = R.expand(*batch, 3, 3)
        self.t = t.expand(*batch, 3)
        # A lens that fits already stays the same object, with whatever it has computed about itself.
        if distortion is not None and distortion.batch_shape != batch:
            distortion = distortion.expand(*batch)
        self.distortion = distortion
        self.size = size

    @classmethod
    def unchecked(cls, K: Any, R: Any, t: Any, distortion: Any, size: tuple[int, int] | None) -> "Camera":
        """Build without looking at anything: for parts that come from a camera, or from inside a transformation."""
        camera = cls.__new__(cls)
        camera.K, camera.R, camera.t, camera.distortion, camera.size = K, R, t, distortion, size
        return camera

    def _with(self, **changes: Any) -> "Camera":
        camera = type(self).__new__(type(self))
        camera._assign(**({name: getattr(self, name) for name in self.__slots__} | changes))
        return camera

    def _facts(self) -> list[str]:
        return description.facts(self.K, self.R, self.t, self.distortion, self.size)

    def _columns(self) -> dict[str, list[Any]]:
        return description.columns(self.K, self.distortion)

    # ------------------------------------------------------------------------------------------------ other cameras

    @property
    def center(self) -> Float[Tensor, "*batch 3"]:
        """The centre of projection in the world, `C = -R^T t`, in world units."""
        return -dot(self.R.mT, self.t.unsqueeze(-2))

    def at(self, R: Float[Tensor, "*#batch 3 3"] | Array, t: Float[Tensor, "*#batch 3"] | Array) -> "Camera":
        """The same intrinsics and lens at another pose, or at many: the batch shapes broadcast.

        Args:
            R: rotation world to camera `(*B, 3, 3)`.
            t: translation world to camera `(*B, 3)`.

        Raises:
            TypeError: no floating-point tensors, or other dtypes than the camera's.
            ValueError: wrong shapes or devices, or an R that is no rotation.
        """
        R, t = check_tensor("R", R, 3, 3, like=self.K), check_tensor("t", t, 3, like=self.K)
        if has_values(R, t):
            check_pose(R, t)
        return self._with(R=R, t=t)

    def without_pose(self) -> "Camera":
        """The same intrinsics and lens with the world frame in the camera: what one saves of a calibration."""
        identity = torch.eye(3, dtype=self.dtype, device=self.device)
        return self._with(R=identity, t=torch.zeros_like(identity[0]))

    def shifted(self, offset: Float[Tensor, "*#batch 3"] | Array) -> "Camera":
        """The same camera in a world whose origin is at `offset`: points there are those of before minus the offset.

        UTM and earth-centred coordinates have more digits than float32 holds; about an origin near the scene it does.
        Shift in float64, then convert: `camera.shifted(origin).to(torch.float32)`.

        Args:
            offset: the new origin in the old world `(*B, 3)`.

        Raises:
            TypeError: no floating-point tensor, or another dtype than the camera's.
            ValueError: wrong shape or device.

        Example:
            >>> far = torch.tensor([[642734.0, 8304296.0, 12.0]], dtype=torch.float64)
            >>> camera = Camera(torch.eye(3, dtype=torch.float64), t=-far[0] + torch.tensor([0.0, 0, 8]))
            >>> near = camera.shifted(far[0])
            >>> near.t.tolist(), torch.equal(near.project(far - far[0])[0], camera.project(far)[0])
            ([0.0, 0.0, 8.0], True)
        """
        offset = check_tensor("offset", offset, 3, like=self.K)
        check_same_kind(camera=self.K, offset=offset)
        if has_values(offset) and not bool(offset.isfinite().all()):
            raise ValueError("offset: want finite values, got NaN or infinity")
        return self._with(t=self.t + dot(self.R, offset.unsqueeze(-2)))

    # ------------------------------------------------------------------------------------------- points and pixels

    def in_image(self, pixels: Float[Tensor, "*shape 2"] | Array) -> Bool[Tensor, "*shape"]:
        """Whether pixels lie on the image: from -0.5 to `width - 0.5` and `height - 0.5`; false where not finite.

        Args:
            pixels: `(*, 2)` in px.

        Raises:
            ValueError: the camera does not know its size.

        Example:
            >>> camera = Camera(torch.eye(3), size=(640, 480))
            >>> camera.in_image(torch.tensor([[0.0, 0.0], [639.4, 479.4], [639.6, 0.0]])).tolist()
            [True, True, False]
        """
        if self.size is None:
            raise ValueError("in_image: want a camera with a size, got None; give Camera(..., size=(width, height))")
        return inside(check_tensor("pixels", pixels, 2, like=self.K), self.size)

    def project(
        self, points: Float[Tensor, "*#batch n 3"] | Array
    ) -> tuple[Float[Tensor, "*#batch n 2"], Bool[Tensor, "*#batch n"]]:
        """Project world points to pixels.

        Args:
            points: world points `(*B, N, 3)`.

        Returns:
            Pixels `(*B, N, 2)` and `valid (*B, N)`: false where the point is not finite, not in front of a
            perspective camera, or outside the domain of the lens. Pixels are (0, 0) there, with zero gradient. A pixel
            may be valid and lie outside the image.

        Raises:
            TypeError: no floating-point tensor, or another dtype than the camera's.
            ValueError: wrong shape or device, or batch shapes that do not broadcast.
        """
        points = meeting_camera(self, "points", points, 3)
        if looks_at_rounding(self.t):
            warn_of_rounded_pixels(self.K, self.R, self.t, points)
        return self._project(points)

    def _project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """`project` of points that were checked, without a warning of rounding."""
        derivative = wants_derivative(points, *self.tensors())

        def project(points: Tensor) -> tuple[Tensor, Tensor]:
            x, y, z = points.detach().unbind(-1)
            finite = (x + y + z).isfinite()
            if derivative:
                points = points.nan_to_num(0.0, 0.0, 0.0)  # the slope by R is the point, and 0 times infinity is NaN
            rotated = linear(entries(self.R), points.unbind(-1))
            direction = [x + shift.unsqueeze(-1) for x, shift in zip(rotated, self.t.unbind(-1), strict=True)]
            uv, valid = self._pixels_along(direction)
            valid = valid & finite
            return interleaved([torch.where(valid, x, 0.0) for x in uv]), valid

        pixels, valid = in_blocks(project, points, *self.tensors())
        return pixels, valid

    def _pixels_along(self, direction: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
        """Pixels of directions in the camera frame, both by components `(*B, N)`, and which are valid.

        Elsewhere they are finite where a derivative is asked, and anything where none is.
        """
        if self.distortion is None:
            xy, valid = through_pinhole(direction, wants_derivative(*direction, *self.tensors()))
        else:
            xy_lens, valid = self.distortion.project_direction(torch.stack(list(direction), dim=-1))
            xy = list(xy_lens.unbind(-1))
        return linear(entries(self.K[..., :2, :]), [*xy, None]), valid

    def directions(
        self, pixels: Float[Tensor, "*#batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"]]:
        """Viewing directions in the camera frame, of any length: (x, y, 1) for a perspective camera.

        Args:
            pixels: `(*B, N, 2)`.

        Returns:
            Directions `(*B, N, 3)` and `valid (*B, N)`: false where a pixel is not finite or the lens has no inverse;
            the direction is (0, 0, 1) there, with zero gradient.

        Raises:
            TypeError: no floating-point tensor, or another dtype than the camera's.
            ValueError: wrong shape or device, or batch shapes that do not broadcast.
        """
        pixels = meeting_camera(self, "pixels", pixels, 2)
        xy, finite = normalised(pixels, self.K)
        if self.distortion is None:
            return torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1), finite
        direction, valid = self.distortion.unproject(xy)
        return direction, valid & finite

    def rays(
        self, pixels: Float[Tensor, "*#batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*#batch n 3"], Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"]]:
        """Viewing rays in the world frame.

        Args:
            pixels: `(*B, N, 2)`.

        Returns:
            `(origin, direction, valid)`: the centre of projection for each ray and its unit direction, both
            `(*B, N, 3)` in the world frame, and `valid (*B, N)` as `directions` gives it.

        Raises:
            TypeError: no floating-point tensor, or another dtype than the camera's.
            ValueError: wrong shape or device, or batch shapes that do not broadcast.
        """
        in_camera, valid = self.directions(pixels)
        direction = transform(self.R.mT, in_camera)
        direction = direction / direction.norm(dim=-1, keepdim=True)
        return self.center.unsqueeze(-2).expand_as(direction), direction, valid

    def tensors(self) -> list[Tensor]:
        """All tensors of the camera, the lens's included."""
        lens = [leaf for leaf in tree_leaves(self.distortion) if isinstance(leaf, Tensor)]
        return [self.K, self.R, self.t, *lens]


def as_camera(camera: Camera | PinholeCamera, name: str = "camera") -> Camera:
    """A `Camera` as it is, Kornia's `PinholeCamera` converted.

    Raises:
        TypeError: it is neither.
    """
    if isinstance(camera, Camera):
        return camera
    remedy = ""
    if isinstance(camera, str | os.PathLike):
        remedy = "load it with dp.load_camera(path)"
    elif not isinstance(camera, type) and isinstance(getattr(camera, "cameras", None), Camera):
        remedy = "give its .camera, or its .cameras for the poses"
    return Camera.from_kornia(instance(name, camera, PinholeCamera, "dp.Camera or kornia's PinholeCamera", remedy))


def meeting_camera(camera: Camera, name: str, value: object, length: int) -> Tensor:
    """Check points or pixels against a camera, lift half precision, expand to the common batch shape."""
    if not torch.compiler.is_compiling() and isinstance(value, Tensor) and _fits(camera, value, length):
        return value  # the usual case, and five times as fast
    tensor = check_tensor(name, value, "N", length, like=camera.K)
    if tensor is not value:  # lifted: any precision of the camera holds a half exactly
        tensor = tensor.to(camera.dtype)
    check_same_kind(**{"camera": camera.K, name: tensor})
    batch = broadcast_batches(**{"camera": camera.batch_shape, name: tensor.shape[:-2]})
    return tensor.expand(*batch, *tensor.shape[-2:])


def _fits(camera: Camera, tensor: Tensor, length: int) -> bool:
    """Whether a tensor of vectors is just as the camera needs it."""
    K = camera.K
    return (
        tensor.dtype is K.dtype
        and tensor.device == K.device
        and tensor.layout is torch.strided
        and not (tensor.is_nested or tensor.is_neg())
        and tensor.ndim >= 2
        and tensor.shape[-1] == length
        and tensor.shape[:-2] == K.shape[:-2]
    )


def check_lens(distortion: object) -> None:
    """Check that something is a lens, by the two maps that a camera needs, for `torch.compile` knows no protocols.

    Raises:
        TypeError: it is none.
    """
    maps = hasattr(distortion, "project_direction") and hasattr(distortion, "unproject")
    if isinstance(distortion, type) or not maps:
        instance("distortion", distortion, (), "a lens such as dp.BrownConrady(coefficients)")
