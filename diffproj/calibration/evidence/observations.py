"""What cameras see besides targets: surveyed points, the horizon, upright objects, lengths.

Each is a residual with a deviation. Where what was seen is a pixel, its noise is carried into what is compared by the
derivative at the camera in question, so that far and foreshortened things weigh as little as they tell.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, first_of, number, tensor_of
from diffproj._core.numerics import broadcast_batches, in_float64
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
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.camera import Camera
from diffproj.geometry.plane import Plane, as_plane
from diffproj.lens.slopes import by_direction
from diffproj.targets.landmarks import refuse_degrees
from diffproj.targets.target import Target


class Seen(Observed):
    """Surveyed points and the pixels that show them.

    Attributes:
        points: `(N, 3)` in the world.
        pixels: `(*B, N, 2)`.

    Example:
        >>> import diffproj as dp
        >>> Seen([[0.0, 20.0, 0.0], [5.0, 30.0, 1.2]], [[320.0, 300.0], [360.0, 250.0]], pixel_sigma=0.5)
        Seen(2 seen)
    """

    __slots__ = ("covariances", "pixel_sigma", "pixels", "points", "visible")

    def __init__(
        self,
        landmarks: Target | Float[Tensor, "n d"] | Array,
        pixels: Float[Tensor, "*batch n 2"] | Array,
        pixel_sigma: Deviation = 1.0,
        sigma: Float[Tensor, "..."] | Array | float | None = None,
        loss: Loss | None = None,
    ) -> None:
        """Copy what was seen, and check it.

        Args:
            landmarks: `dp.Landmarks`, another target, or points `(N, 3)`, `(N, 2)` on z = 0.
            pixels: `(*B, N, 2)`, NaN where a point is not seen.
            pixel_sigma: standard deviation of a pixel's coordinate in px: a number, `(N,)` or `(*B, N)`.
            sigma: how far off the points may be: the deviation of each coordinate in world units, a number, or `(N, 3)`
                or `(3,)` for x, y, z; that of the landmarks, where they have one, if left out.
            loss: a robust loss, its scale in deviations.

        Raises:
            TypeError: not points, pixels or numbers.
            ValueError: shapes do not fit, latitude and longitude, or a deviation that cannot be.
        """
        super().__init__(loss)
        given = landmarks.points if isinstance(landmarks, Target) else tensor_of("landmarks", landmarks)
        if given.ndim != 2 or given.shape[-1] not in (2, 3):
            raise ValueError(f"landmarks: want points (N, 3), or (N, 2) on z = 0, got shape {tuple(given.shape)}")
        if len(given) == 0:
            raise ValueError("landmarks: want some, got none")
        points = valued("landmarks", given)
        points = torch.nn.functional.pad(points, (0, 3 - points.shape[-1]))
        lost = ~points.detach().isfinite().all(-1)
        if bool(lost.any()):
            raise ValueError(f"landmarks: want finite coordinates, got {first_of(points, lost)}")
        if not isinstance(landmarks, Target):
            refuse_degrees("landmarks", points.detach())
        pixels = valued("pixels", pixels, "N", 2)
        if pixels.shape[-2] != len(points):
            raise ValueError(f"pixels: want one for each of {len(points)} landmarks, got {pixels.shape[-2]}")
        self.visible = pixels.detach().isfinite().all(-1)
        self.points, self.pixels = points, torch.where(self.visible.unsqueeze(-1), pixels, 0.0)
        self.pixel_sigma = checked_deviation("pixel_sigma", pixel_sigma, "a deviation in px")
        check_broadcast("pixel_sigma", self.pixel_sigma, "the pixels", pixels.shape[:-1])
        self.covariances: Tensor | None = None
        if sigma is not None:
            spread = checked_deviation("sigma", sigma, "a deviation in world units", zero=True)
            try:
                spread = spread.expand(len(points), 3)
            except RuntimeError:
                want = f"a number, (3,) or ({len(points)}, 3)"
                raise ValueError(f"sigma: want {want}, got shape {tuple(spread.shape)}") from None
            self.covariances = torch.diag_embed(spread.square())
        elif isinstance(covariances := getattr(landmarks, "covariances", None), Tensor):
            self.covariances = in_float64(covariances)

    def __len__(self) -> int:
        """The number of points, N."""
        return len(self.points)

    def uncertain_places(self) -> frozenset[tuple[float, ...]]:
        """Where those points are that are seen and that came with an error of their own."""
        if self.covariances is None:
            return frozenset()
        unsure = self.covariances.detach().diagonal(dim1=-2, dim2=-1).sum(-1) > 0
        seen = self.visible.reshape(-1, len(self)).any(0)
        return frozenset(map(tuple, self.points.detach()[unsure & seen].tolist()))

    def _residuals(self, camera: Camera) -> Float[Tensor, "*batch m 2"]:
        """Projected minus seen, over the deviation that pixels and points have together."""
        points = self.points.to(camera.device)
        projected, valid = camera.project(points)
        off = projected - self.pixels.to(projected)
        variance = self.pixel_sigma.to(projected).square().expand(off.shape[:-1])
        if self.covariances is None:
            found = off / variance.sqrt().unsqueeze(-1)
        else:
            direction = (camera.R.unsqueeze(-3) @ (points - camera.center.unsqueeze(-2)).unsqueeze(-1)).squeeze(-1)
            axis = torch.tensor([0.0, 0, 1], dtype=off.dtype, device=off.device)
            direction = torch.where(valid.unsqueeze(-1), direction, axis)
            J = camera.K[..., None, :2, :2] @ by_direction(camera.distortion, direction) @ camera.R.unsqueeze(-3)
            C = J @ self.covariances.to(off) @ J.mT
            a, b, d = C[..., 0, 0] + variance, C[..., 0, 1], C[..., 1, 1] + variance
            # The inverse of the lower Cholesky factor of ((a, b), (b, d)).
            first = off[..., 0] / a.sqrt()
            second = (off[..., 1] - b / a * off[..., 0]) / (d - b * b / a).sqrt()
            found = torch.stack([first, second], dim=-1)
        visible = self.visible.to(off.device).unsqueeze(-1)
        return torch.where(visible, torch.where(valid.unsqueeze(-1), found, torch.nan), 0.0)


class Horizon(Observed):
    """Pixels on the horizon: it lies level with the camera, or below it by its dip.

    Attributes:
        pixels: `(*B, M, 2)`.

    Example:
        >>> import diffproj as dp
        >>> dp.Horizon([[12.0, 301.0], [2950.0, 280.0]], pixel_sigma=3.0)
        Horizon(2 seen)
    """

    __slots__ = ("dip", "pixel_sigma", "pixels")

    def __init__(
        self,
        pixels: Float[Tensor, "*batch m 2"] | Array,
        pixel_sigma: Deviation = 1.0,
        dip_deg: float = 0.0,
        loss: Loss | None = None,
    ) -> None:
        """Copy what was seen, and check it.

        Args:
            pixels: `(*B, M, 2)`.
            pixel_sigma: standard deviation across the horizon in px: a number, `(M,)` or `(*B, M)`.
            dip_deg: how far it lies below the level, in degrees. At sea 0.032 times the root of the camera's height in
                metres, less a twelfth for the air's refraction.
            loss: a robust loss, its scale in deviations.

        Raises:
            TypeError: not pixels or numbers.
            ValueError: shapes do not fit, or a value that cannot be.
        """
        super().__init__(loss)
        self.pixels = checked_pixels("pixels", pixels, "M", 2)
        self.pixel_sigma = checked_deviation("pixel_sigma", pixel_sigma, "a deviation in px")
        check_broadcast("pixel_sigma", self.pixel_sigma, "the pixels", self.pixels.shape[:-1])
        self.dip = torch.tensor(number("dip_deg", dip_deg, "degrees"), dtype=torch.float64, device="cpu").deg2rad()

    def __len__(self) -> int:
        """The number of pixels, M."""
        return self.pixels.shape[-2]

    def _residuals(self, camera: Camera) -> Float[Tensor, "*batch m 1"]:
        """The distance from the horizon, over its deviation; positive above it."""

        def above(pixels: Tensor) -> Tensor:
            rays, valid = camera.directions(pixels)
            rise = (rays * camera.R[..., None, :, 2]).sum(-1)
            rise = rise + self.dip.to(rise).sin() * rays.norm(dim=-1)
            return torch.where(valid, rise, torch.nan)

        pixels = batched(self.pixels, camera)
        rise, variance = with_spread(above, [pixels], self.pixel_sigma.to(pixels))
        return (rise / variance.sqrt()).unsqueeze(-1)


class Heights(Observed):
    """Upright objects on the ground z = 0 whose height is known: people, animals, cars, posts.

    Attributes:
        feet: pixels where they stand `(*B, M, 2)`.
        tops: pixels of their tops `(*B, M, 2)`.

    Example:
        >>> import diffproj as dp
        >>> dp.Heights(feet=[[812.0, 640.0]], tops=[[815.0, 512.0]], height=1.75, deviation=0.07)
        Heights(1 seen)
    """

    __slots__ = ("deviation", "feet", "height", "pixel_sigma", "tops")

    def __init__(
        self,
        feet: Float[Tensor, "*batch m 2"] | Array,
        tops: Float[Tensor, "*batch m 2"] | Array,
        height: Float[Tensor, "..."] | Array | float,
        deviation: Deviation,
        pixel_sigma: Deviation = 0.0,
        loss: Loss | None = None,
    ) -> None:
        """Copy what was seen, and check it.

        Args:
            feet: pixels where the objects touch the ground `(*B, M, 2)`.
            tops: pixels of their tops `(*B, M, 2)`.
            height: in world units: a number, `(M,)` or `(*B, M)`.
            deviation: standard deviation of a height in world units.
            pixel_sigma: standard deviation of a pixel's coordinate in px; 0 if left out, where the deviation holds it.
            loss: a robust loss, its scale in deviations.

        Raises:
            TypeError: not pixels or numbers.
            ValueError: shapes do not fit, or a value that cannot be.
        """
        super().__init__(loss)
        self.feet, self.tops = checked_pixels("feet", feet, "M", 2), checked_pixels("tops", tops, "M", 2)
        if self.feet.shape[-2] != self.tops.shape[-2]:
            raise ValueError(f"tops: want one for each of {self.feet.shape[-2]} feet, got {self.tops.shape[-2]}")
        shape = broadcast_batches(feet=self.feet.shape[:-1], tops=self.tops.shape[:-1])
        check_apart("tops", self.tops, "the feet", self.feet, "leave such objects out")
        self.height = checked_deviation("height", height, "a height in world units")
        self.deviation = checked_deviation("deviation", deviation, "a deviation in world units")
        self.pixel_sigma = checked_deviation("pixel_sigma", pixel_sigma, "a deviation in px", zero=True)
        for name in ("height", "deviation", "pixel_sigma"):
            check_broadcast(name, getattr(self, name), "the objects", shape)

    def __len__(self) -> int:
        """The number of objects, M."""
        return self.feet.shape[-2]

    def _residuals(self, camera: Camera) -> Float[Tensor, "*batch m 1"]:
        """The height at which a top is seen over its foot, minus that of the object, over the deviation."""

        def height(feet: Tensor, tops: Tensor) -> Tensor:
            (down, seen), (up, also) = camera.directions(feet), camera.directions(tops)
            R, above = camera.R.unsqueeze(-3), camera.center[..., None, 2]
            down, up = ((R * rays.unsqueeze(-1)).sum(-2) for rays in (down, up))  # R^T ray, in the world
            below = seen & also & (down[..., 2] < 0) & (above > 0)
            foot = down[..., :2] * (above / torch.where(below, -down[..., 2], 1.0)).unsqueeze(-1)
            # Where the ray of the top passes nearest to the vertical over the foot.
            square = up[..., :2].square().sum(-1)
            steep = square <= 0
            reach = (foot * up[..., :2]).sum(-1) / torch.where(steep, 1.0, square)
            return torch.where(below & ~steep & (reach > 0), above + up[..., 2] * reach, torch.nan)

        feet, tops = batched(self.feet, camera), batched(self.tops, camera)
        found, variance = with_spread(height, [feet, tops], self.pixel_sigma.to(feet))
        spread = (variance + self.deviation.to(feet).square()).sqrt()
        return ((found - self.height.to(feet)) / spread).unsqueeze(-1)


class Lengths(Observed):
    """Known distances between pixels on a plane, the ground if none is said: lane marks, the sides of a pitch.

    Attributes:
        starts: pixels of one end `(*B, M, 2)`.
        ends: pixels of the other `(*B, M, 2)`.

    Example:
        >>> import diffproj as dp
        >>> dp.Lengths([[500.0, 500.0]], [[700.0, 500.0]], length=3.5, deviation=0.02, pixel_sigma=0.5)
        Lengths(1 seen)
    """

    __slots__ = ("deviation", "ends", "length", "pixel_sigma", "plane", "starts")

    def __init__(
        self,
        starts: Float[Tensor, "*batch m 2"] | Array,
        ends: Float[Tensor, "*batch m 2"] | Array,
        length: Float[Tensor, "..."] | Array | float,
        deviation: Deviation,
        pixel_sigma: Deviation = 0.0,
        plane: Plane | None = None,
        loss: Loss | None = None,
    ) -> None:
        """Copy what was seen, and check it.

        Args:
            starts: pixels of one end `(*B, M, 2)`.
            ends: pixels of the other end `(*B, M, 2)`.
            length: in world units: a number, `(M,)` or `(*B, M)`.
            deviation: standard deviation of a length in world units.
            pixel_sigma: standard deviation of a pixel's coordinate in px; 0 if left out, where the deviation holds it.
            plane: that both ends lie on; z = 0 if left out.
            loss: a robust loss, its scale in deviations.

        Raises:
            TypeError: not pixels, numbers or a plane.
            ValueError: shapes do not fit, or a value that cannot be.
        """
        super().__init__(loss)
        self.starts, self.ends = checked_pixels("starts", starts, "M", 2), checked_pixels("ends", ends, "M", 2)
        if self.starts.shape[-2] != self.ends.shape[-2]:
            raise ValueError(f"ends: want one for each of {self.starts.shape[-2]} starts, got {self.ends.shape[-2]}")
        shape = broadcast_batches(starts=self.starts.shape[:-1], ends=self.ends.shape[:-1])
        check_apart("ends", self.ends, "the starts", self.starts, "leave such lengths out")
        self.length = checked_deviation("length", length, "a length in world units")
        self.deviation = checked_deviation("deviation", deviation, "a deviation in world units")
        self.pixel_sigma = checked_deviation("pixel_sigma", pixel_sigma, "a deviation in px", zero=True)
        for name in ("length", "deviation", "pixel_sigma"):
            check_broadcast(name, getattr(self, name), "the lengths", shape)
        self.plane = (Plane.z(0.0) if plane is None else as_plane(plane)).to(torch.float64)

    def __len__(self) -> int:
        """The number of lengths, M."""
        return self.starts.shape[-2]

    def _residuals(self, camera: Camera) -> Float[Tensor, "*batch m 1"]:
        """The length on the plane minus the one that is known, over the deviation."""
        plane = self.plane.to(camera.device)

        def length(starts: Tensor, ends: Tensor) -> Tensor:
            (one, seen), (other, also) = (back_project(pixels, camera, plane) for pixels in (starts, ends))
            square = (other - one).square().sum(-1)
            apart = seen & also & (square > 0)
            return torch.where(apart, torch.where(apart, square, 1.0).sqrt(), torch.nan)

        starts, ends = batched(self.starts, camera), batched(self.ends, camera)
        found, variance = with_spread(length, [starts, ends], self.pixel_sigma.to(starts))
        spread = (variance + self.deviation.to(starts).square()).sqrt()
        return ((found - self.length.to(starts)) / spread).unsqueeze(-1)
