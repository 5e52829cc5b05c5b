"""What other libraries give and take of a camera: the part of `Camera` that is about OpenCV and Kornia."""

from typing import TypeVar

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera

from diffproj._core.arguments import flag, instance
from diffproj._core.numerics import dot, has_values
from diffproj.geometry import interop
from diffproj.geometry.camera_parts import CameraParts
from diffproj.geometry.interop import ArrayLike
from diffproj.geometry.intrinsics import upright
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.kannala_brandt import KannalaBrandt

C = TypeVar("C", bound="Exchange")


class Exchange(CameraParts):
    """From and to OpenCV's arrays and Kornia's `PinholeCamera`, whose conventions are those of `Camera`."""

    __slots__ = ()

    @classmethod
    def from_opencv(
        cls: type[C],
        K: ArrayLike,
        dist: ArrayLike | None = None,
        rvec: ArrayLike | None = None,
        tvec: ArrayLike | None = None,
        size: tuple[int, int] | None = None,
        fisheye: bool = False,
    ) -> C:
        """A camera from what OpenCV's calibration returns.

        Args:
            K: camera matrix `(*B, 3, 3)`. Arrays are copied to float64 tensors, or to such as K where that is a tensor;
                a tensor keeps its dtype, device and graph.
            dist: 4, 5, 8, 12 or 14 coefficients in OpenCV's order (fisheye: 4), as `(*B, k)` or as OpenCV's row or
                column; `None` or an empty array for a pinhole.
            rvec: rotation vector world to camera `(*B, 3)` in radians, or OpenCV's `(3, 1)` column.
            tvec: translation world to camera `(*B, 3)` in world units, or OpenCV's `(3, 1)` column.
            size: image size `(width, height)` in pixels.
            fisheye: whether `dist` belongs to OpenCV's fisheye model.

        Raises:
            TypeError: an argument is none of these, or tensors of mixed dtypes.
            ValueError: wrong shapes or values, as the constructor says.

        Example:
            >>> K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
            >>> import diffproj as dp
            >>> dp.Camera.from_opencv(K, [-0.2, 0.1, 0, 0, 0], np.zeros(3), [0, 0, 800], size=(640, 480))
            Camera(f 500.0, 500.0 px, c 320.0, 240.0 px, BrownConrady, 640 x 480 px, torch.float64)
        """
        fisheye = flag("fisheye", fisheye)
        K, coefficients, R, t = interop.tensors_from_opencv(K, dist, rvec, tvec)
        lens = KannalaBrandt if fisheye else BrownConrady
        if coefficients is not None and coefficients.shape[-1] not in lens.counts:
            counts = ", ".join(map(str, lens.counts))
            raise ValueError(f"dist: want {counts} coefficients, got {coefficients.shape[-1]}")
        return cls(K, R, t, None if coefficients is None else lens(coefficients), size)  # type: ignore[call-arg]

    def upright(self: C) -> C:
        """The camera that sees the same with K upper triangular: turned about its axis, instead of its image.

        The focal lengths are positive unless the image is mirrored. Where the image is not turned, the same numbers.

        Raises:
            TypeError: a lens of another package.
            ValueError: a tilted sensor's image that is turned by other than half turns, or
                quarter turns where it is tilted about one axis only: no coefficients describe it.

        Example:
            >>> import torch, diffproj as dp
            >>> camera = dp.Camera(torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]), size=(640, 480))
            >>> quarter = torch.tensor([[0.0, -1, 479], [1, 0, 0], [0, 0, 1]])  # clockwise: (u, v) to (479 - v, u)
            >>> turned = camera.warped(quarter, size=(480, 640))
            >>> turned.K.tolist(), turned.upright().K.tolist()[:2]
            ([[0.0, -510.0, 239.0], [500.0, 0.0, 320.0], [0.0, 0.0, 1.0]], [[510.0, 0.0, 239.0], [0.0, 500.0, 320.0]])
        """
        K, cosine, sine = upright(self.K)
        lens = self.distortion
        if lens is not None:
            if not isinstance(lens, CoefficientLens):
                raise TypeError(f"distortion: want a lens of diffproj to turn, got {type(lens).__name__}")
            lens, exact = lens.turned(cosine, sine)
            if has_values(exact) and not bool(exact.all()):
                raise ValueError(
                    "K: want an image that is not turned against the tilted sensor (tau_x, tau_y) of the lens, got a "
                    "turned one, which no coefficients describe; turn it back with warped()"
                )
        zero, one = torch.zeros_like(sine), torch.ones_like(sine)
        rows = [cosine, -sine, zero, sine, cosine, zero, zero, zero, one]
        q = torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
        R, t = (q.unsqueeze(-1) * self.R.unsqueeze(-3)).sum(-2), dot(q, self.t.unsqueeze(-2))
        return self._with(K=K, R=R, t=t, distortion=lens)

    def to_opencv(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """`(K, dist, rvec, tvec)` as float64 arrays for OpenCV's functions, batch axes in front.

        `dist` is empty for a pinhole. Whether the coefficients are the fisheye model's is for the caller to remember.
        A camera whose image is turned is given as the one that is turned itself (`upright`), which sees the same.

        Raises:
            ValueError: the camera has skew, which OpenCV would ignore, another library's lens, or a turned image that
                no lens describes (see `upright`).
        """
        if self.distortion is not None and not isinstance(self.distortion, CoefficientLens):
            raise ValueError(f"distortion: want a lens that OpenCV has, got {type(self.distortion).__name__}")
        camera = self.upright()
        coefficients = None if camera.distortion is None else camera.distortion.coefficients  # type: ignore[union-attr]
        return interop.arrays_for_opencv(camera.K, coefficients, camera.R, camera.t)

    @classmethod
    def from_kornia(cls: type[C], pinhole: PinholeCamera) -> C:
        """A camera of batch shape `(B,)` from Kornia's `PinholeCamera`, whose conventions are the same.

        Raises:
            TypeError: it is no `PinholeCamera`.
            ValueError: the cameras of the batch have images of different sizes, or values are not a camera's.
        """
        instance("pinhole", pinhole, PinholeCamera, "kornia's PinholeCamera")
        K, R, t, size = interop.tensors_from_kornia(pinhole)
        return cls(K, R, t, size=size)  # type: ignore[call-arg]

    def to_kornia(self) -> PinholeCamera:
        """Kornia's `PinholeCamera` of batch size `B`; a single camera becomes a batch of one.

        A camera whose image is turned is given as the one that is turned itself (`upright`), which sees the same.

        Raises:
            ValueError: what `PinholeCamera` cannot hold: a lens, no size, or more than one batch axis.
        """
        if self.distortion is not None:
            raise ValueError("distortion: want None, for PinholeCamera holds no lens; undistort first")
        if self.size is None:
            raise ValueError("size: want (width, height), got None, and PinholeCamera needs it")
        camera = self.upright()
        return interop.pinhole_from_tensors(camera.K, camera.R, camera.t, self.size)
