"""Maps of how well a calibrated camera measures on a plane: over the image, or over a region of the plane.

Two figures for each place: the ground resolution, world units that one pixel covers along its worst direction, which is
geometry; and the predicted standard deviation of a point measured there, along its worst direction, which adds what the
calibration does not know. Places beyond the horizon or the lens's reach are not valid. `covered` tells the part of the
image that the calibration's corners surround: outside of it, `extrapolated`, only the lens model tells the lens. The
standard deviation grows there with what a lens of that model may do, and is infinite where it may end before the pixel.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core import arguments
from diffproj._core.arguments import called, numbers, whole_number
from diffproj._core.shown import Shown, number
from diffproj.calibration.results.calibration import Calibration, as_calibration
from diffproj.calibration.results.region import in_region
from diffproj.geometry.back_projection import ground_resolution
from diffproj.geometry.camera import Camera
from diffproj.geometry.grid import pixel_grid
from diffproj.geometry.plane import Plane, as_plane
from diffproj.measurement.choices import chosen_view
from diffproj.measurement.default_plane import warn_if_far_from_landmarks
from diffproj.measurement.measure import measure
from diffproj.targets.views import view_number


@dataclass(frozen=True, eq=False, repr=False)
class AccuracyMap(Shown):
    """How well points of a plane are measured, on a grid of rows and columns.

    Attributes:
        pixels: where the places are in the image `(H, W, 2)`, in px.
        points: where they are on the plane `(H, W, 3)`, in world units; NaN where a pixel has none.
        valid: whether a pixel has a point on the plane, or a point a pixel in the image `(H, W)`.
        covered: whether the calibration's corners surround the pixel, by half a square more at most `(H, W)`; true
            everywhere where they are not known, as for a pose that was located with a camera alone.
        resolution: world units a pixel along the worst direction `(H, W)`; NaN where not valid.
        deviation: standard deviation of a measured point along its worst direction in world units `(H, W)`; NaN where
            not valid, infinite where the calibration does not determine it, be it that the lens may end there.
    """

    pixels: Float[Tensor, "h w 2"]
    points: Float[Tensor, "h w 3"]
    valid: Bool[Tensor, "h w"]
    covered: Bool[Tensor, "h w"]
    resolution: Float[Tensor, "h w"]
    deviation: Float[Tensor, "h w"]

    @property
    def extrapolated(self) -> Bool[Tensor, "h w"]:
        """Where a point is measured outside of the corners `(H, W)`: only its model tells the lens there."""
        return self.valid & ~self.covered

    def _facts(self) -> list[str]:
        def ranged(values: Tensor) -> str:
            known = values[values.isfinite()]
            return number(known, ".3g") if known.numel() else "not known"

        rows, columns = self.valid.shape
        return [
            f"{rows} x {columns} places",
            f"{100 * float(self.valid.double().mean()):.0f} % on the plane",
            f"{100 * float(self.covered.double().mean()):.0f} % covered",
            f"deviation {ranged(self.deviation)}",
            f"resolution {ranged(self.resolution)} a pixel",
        ]

    @classmethod
    def over_image(
        cls,
        calibration: Calibration | Camera,
        plane: Plane | None = None,
        view: int | str | None = None,
        step: float = 8.0,
        pixel_sigma: float | Literal["detector"] = "detector",
    ) -> "AccuracyMap":
        """The map over the whole image.

        Args:
            calibration: of one camera, with its covariance; or a camera at its pose, which counts as exact, with a
                number for `pixel_sigma`.
            plane: in the frame of the board that the view saw; the board's own, z = 0, if left out.
            view: the number or the name of the view whose pose holds; may be left out where there is one only.
            step: about how far apart the places are in px; the first and the last row and column lie on the image's
                edge.
            pixel_sigma: standard deviation of each coordinate of a measured pixel in px; that of the calibration's
                corners, `"detector"`, if left out.

        Raises:
            TypeError: it is no calibration, or another argument is of the wrong kind.
            ValueError: many cameras or planes, no size, no such view, or a step that is not positive.

        Example:
            >>> import diffproj as dp
            >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
            >>> accuracy = dp.AccuracyMap.over_image(calibration, view=0, step=40)
            >>> accuracy.deviation.shape, bool(accuracy.covered[6, 8])
            (torch.Size([13, 17]), True)
        """
        camera = _one_camera(calibration, view)
        size = camera.size
        if size is None:
            raise ValueError("calibration: want one camera of known size; index the views, or give them a size")
        step = arguments.number("step", step, "a positive distance in px", above=0)
        if (size[0] / step) * (size[1] / step) > MOST_PLACES:
            raise ValueError(f"step: want a positive distance in px that gives at most 10^8 places, got {step:g}")
        columns, rows = (math.ceil((side - 1) / step) + 1 for side in size)
        pixels = _grid(rows, columns, (0.0, 0.0, size[0] - 1.0, size[1] - 1.0), camera.K)
        return _mapped(pixels, calibration, camera, _single(plane, camera.K, calibration, view), view, pixel_sigma)

    @classmethod
    def over_plane(
        cls,
        calibration: Calibration | Camera,
        extent: Sequence[float],
        plane: Plane | None = None,
        view: int | str | None = None,
        shape: Sequence[int] = (60, 80),
        pixel_sigma: float | Literal["detector"] = "detector",
    ) -> "AccuracyMap":
        """The map over a rectangle of the board's x and y, on a plane that is a height over them.

        Args:
            calibration: of one camera, with its covariance; or a camera at its pose, which counts as exact, with a
                number for `pixel_sigma`.
            extent: `(x_min, y_min, x_max, y_max)` in world units of the board's frame.
            plane: in that frame, not at right angles to the board; the board's own, z = 0, if left out.
            view: the number or the name of the view whose pose holds; may be left out where there is one only.
            shape: rows, along y, and columns, along x.
            pixel_sigma: standard deviation of each coordinate of a measured pixel in px; that of the calibration's
                corners, `"detector"`, if left out.

        Raises:
            TypeError: it is no calibration, or another argument is of the wrong kind.
            ValueError: many cameras or planes, no such view, an empty extent or shape, or an upright plane.

        Example:
            >>> import diffproj as dp
            >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
            >>> accuracy = dp.AccuracyMap.over_plane(calibration, (0, 0, 200, 125), view=0, shape=(6, 9))
            >>> bool(accuracy.valid.all()), bool((accuracy.deviation < 0.2).all())  # millimetres
            (True, True)
        """
        camera = _one_camera(calibration, view)
        want = "finite (x_min, y_min, x_max, y_max) with room between"
        x_min, y_min, x_max, y_max = numbers("extent", extent, want, 4)
        if not (x_max > x_min and y_max > y_min):
            raise ValueError(f"extent: want {want}, got {tuple(extent)}")
        plane = _single(plane, camera.K, calibration, view)
        if abs(float(plane.unit_normal[2])) < UPRIGHT:
            raise ValueError("plane: want one that is a height over the board's x and y, got an upright one")
        rows, columns = _checked_shape(shape)
        xy = _grid(rows, columns, (x_min, y_min, x_max, y_max), camera.K)
        z = (plane.offset - (plane.normal[:2] * xy).sum(-1)) / plane.normal[2]
        points = torch.cat([xy, z.unsqueeze(-1)], dim=-1)
        pixels, seen = camera.project(points.flatten(0, 1))
        if camera.size is not None:
            seen = seen & camera.in_image(pixels)
        pixels = torch.where(seen.unsqueeze(-1), pixels, torch.nan).reshape(*points.shape[:2], 2)
        return replace(_mapped(pixels, calibration, camera, plane, view, pixel_sigma), points=points)


UPRIGHT = 1e-9
"""The z of a unit normal below which a plane is at right angles to the board."""
MOST_PLACES = 10**8
"""Of a map: more would not fit into memory, and are a step in the wrong unit."""


def _checked_shape(shape: Sequence[int]) -> tuple[int, int]:
    want = "(rows, columns), whole numbers of at least 1"
    if not isinstance(shape, list | tuple) or len(shape) != 2:
        raise TypeError(f"shape: want {want}, got {called(shape)}")
    rows, columns = (whole_number("shape", side, want, least=1) for side in shape)
    if rows * columns > MOST_PLACES:
        raise ValueError(f"shape: want at most 10^8 places, got {rows} x {columns}")
    return rows, columns


def _one_camera(calibration: Calibration | Camera, view: int | str | None) -> Camera:
    """The camera at the pose of a view, in float64."""
    if isinstance(calibration, Camera):
        camera = calibration
    else:
        known = as_calibration(calibration)
        if known.views.batch_shape:
            got = tuple(known.views.batch_shape)
            raise ValueError(f"calibration: want one camera, got batch shape {got}; index it")
        camera = known.cameras[view_number(chosen_view(known, view), known.views.names)]
    if camera.batch_shape:
        raise ValueError(f"calibration: want one camera, got batch shape {tuple(camera.batch_shape)}; index it")
    if camera.K.is_meta:
        raise ValueError("calibration: want a camera with values, got one on the device meta")
    return camera.to(torch.float64)


def _single(plane: Plane | None, points: Tensor, calibration: Calibration | Camera, view: int | str | None) -> Plane:
    """One plane in float64; the board's, where its points are, if none was given."""
    if plane is None and isinstance(calibration, Calibration):
        warn_if_far_from_landmarks(calibration, view_number(chosen_view(calibration, view), calibration.views.names))
    plane = (Plane.z(0.0) if plane is None else as_plane(plane)).like(points).to(torch.float64)
    if plane.normal.is_meta:
        raise ValueError("plane: want one with values, got one on the device meta")
    if plane.batch_shape:
        raise ValueError(f"plane: want one plane, got batch shape {tuple(plane.batch_shape)}")
    return plane


def _grid(rows: int, columns: int, extent: tuple[float, float, float, float], like: Tensor) -> Tensor:
    """Places `(rows, columns, 2)` at equal distances, from the first corner of the extent to the last."""
    low, high = like.new_tensor(extent[:2]), like.new_tensor(extent[2:])
    steps = like.new_tensor([columns - 1, rows - 1]).clamp(min=1)
    return low + pixel_grid(rows, columns, like) / steps * (high - low)


def _mapped(
    pixels: Tensor,
    calibration: Calibration | Camera,
    camera: Camera,
    plane: Plane,
    view: int | str | None,
    pixel_sigma: float | Literal["detector"],
) -> AccuracyMap:
    """The map at pixels `(H, W, 2)`; NaN stands for a place without a pixel."""
    shape = pixels.shape[:2]
    flat = pixels.flatten(0, 1)
    measured = measure(flat, calibration, plane, view, pixel_sigma)
    resolution, valid = ground_resolution(flat, camera, plane)

    def shown(values: Tensor) -> Tensor:
        return torch.where(valid, values, torch.nan).reshape(shape)

    return AccuracyMap(
        pixels,
        torch.where(valid.unsqueeze(-1), measured.points, torch.nan).reshape(*shape, 3),
        valid.reshape(shape),
        _covered(flat, calibration).reshape(shape),
        shown(resolution),
        shown(_largest_deviation(measured.covariance)),
    )


def _covered(pixels: Tensor, calibration: Calibration | Camera) -> Tensor:
    """Which pixels `(N, 2)` the calibration's corners surround; all where the corners are not known."""
    region = calibration.region if isinstance(calibration, Calibration) else None
    return torch.ones_like(pixels[:, 0], dtype=torch.bool) if region is None else in_region(pixels, region)


def _largest_deviation(covariance: Tensor) -> Tensor:
    """The standard deviation along the worst direction `(N,)`; infinite where a coordinate is not determined."""
    infinite = covariance.isinf().any(-1).any(-1)
    finite = covariance.isfinite().all(-1).all(-1)
    largest = torch.linalg.eigvalsh(torch.where(finite[:, None, None], covariance, 0.0))[:, -1].clamp(min=0).sqrt()
    return torch.where(finite, largest, torch.where(infinite, torch.inf, torch.nan))
