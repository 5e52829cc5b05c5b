"""`diffproj rectify`: a metric top view of a plane in a photograph, and where it is on the map."""

import argparse
import math
import textwrap
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from diffproj._core.atomic import write_whole
from diffproj._core.shown import plain
from diffproj.cli.inputs import check_not_the_same, check_writable, writing
from diffproj.cli.measure_plane import described, height_above_face, plane_of
from diffproj.cli.photographs import one_photograph
from diffproj.cli.scene import Scene, check_size, new_photograph, stored_view
from diffproj.cli.terminal import as_json, in_words, progress_bars, result
from diffproj.cli.units import Length, in_unit, is_extent
from diffproj.geometry.back_projection import back_project, ground_resolution
from diffproj.geometry.plane import Plane
from diffproj.geometry.rectification import plane_axes, rectify

MOST_PIXELS = 10**8
"""Of a top view: more is a resolution in the wrong unit."""

RAYS = 33
"""Along each side of the photograph that are tried before it is said not to show a plane."""

STRIP = 2**20
"""Pixels that are made at a time: the memory for them is bounded, and the progress shows."""

AROUND = 0.5
"""How much is shown around the board by itself, as a part of its size."""

WORLD_FILES = {".png": ".pgw", ".tif": ".tfw", ".tiff": ".tfw"}


class View(NamedTuple):
    """What is shown of the plane: whole pixels.

    Attributes:
        extent: x and y of the first corner and of the last, in world units along the plane's axes.
        resolution: side of a pixel, in world units.
        columns: of pixels.
        rows: of pixels.
        north_up: whether y grows upwards.
    """

    extent: tuple[float, float, float, float]
    resolution: float
    columns: int
    rows: int
    north_up: bool

    def strip(self, start: int, end: int) -> tuple[float, float, float, float]:
        """The extent of some rows, counted from the top."""
        x0, y0, x1, y1 = self.extent
        if self.north_up:
            return x0, y1 - end * self.resolution, x1, y1 - start * self.resolution
        return x0, y0 + start * self.resolution, x1, y0 + end * self.resolution

    @property
    def world_file(self) -> str:
        """Six lines: the pixel's side, two rotations, its side downwards, and x and y of the first pixel's middle."""
        x0, y0, _, y1 = self.extent
        half, down = self.resolution / 2, -self.resolution if self.north_up else self.resolution
        numbers = (self.resolution, 0.0, 0.0, down, x0 + half, y1 - half if self.north_up else y0 + half)
        return "".join(f"{number!r}\n" for number in numbers)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    world_file = options.output.with_suffix(WORLD_FILES[options.output.suffix.lower()])
    check_writable("--output", options.output)
    check_not_the_same("--output", options.output, [options.photograph])
    if options.world_file:
        check_writable("--world-file", world_file)
    photograph = one_photograph(options.photograph, options.orientation, colour=True)
    if options.view is None:
        scene = new_photograph(options, photograph)
    else:
        scene = stored_view(options)
        height, width = photograph.source.shape[:2]  # type: ignore[union-attr]
        check_size(scene.camera, (width, height), options)
    plane = plane_of(scene, options)
    origin, along_x, along_y = plane_axes(plane)
    if options.world_file and not _is_level(plane):
        raise ValueError("--world-file: want a plane z = const, whose x and y are the map's, got another; leave it out")
    _check_in_view(options, np.asarray(photograph.source), scene, plane)
    view = _view(options, scene, plane)
    top, shown = _top_view(np.asarray(photograph.source), scene, plane, view)
    if not shown:
        raise ValueError(
            f"--extent: want a part of the plane that the photograph shows, got {_in_words(view.extent, plane)}, of "
            "which it shows nothing"
        )
    with writing("--output", options.output):
        write_whole(options.output, cv2.imencode(options.output.suffix.lower(), top)[1].tobytes())
    if options.world_file:
        with writing("--world-file", world_file):
            write_whole(world_file, view.world_file)
    told = {
        "camera": str(options.camera),
        "photograph": photograph.label,
        "view": scene.calibration.views.names[scene.view],
        "output": str(options.output),
        "world_file": str(world_file) if options.world_file else None,
        "unit": scene.square.unit,
        "plane": [*plane.normal.tolist(), float(plane.offset)],
        "extent": list(view.extent),
        "origin": origin.tolist(),
        "axes": [along_x.tolist(), along_y.tolist()],
        "resolution": view.resolution,
        "size": [view.columns, view.rows],
        "north_up": view.north_up,
        "shown": shown,
        "doubts": _doubts(scene),
        "warnings": options.warned,
    }
    if options.json:
        as_json(told)
    else:
        _say(told, scene, plane)
    return 0


def _check_in_view(options: argparse.Namespace, image: Shaped[np.ndarray, "..."], scene: Scene, plane: Plane) -> None:
    """Check that the photograph shows some of the plane, whatever part of it is asked for.

    Raises:
        ValueError: it does not.
    """
    height, width = image.shape[:2]
    u, v = (torch.linspace(0.0, side - 1.0, RAYS, dtype=torch.float64, device="cpu") for side in (width, height))
    if not bool(back_project(torch.cartesian_prod(u, v), scene.camera, plane)[1].any()):
        words = described(plane, None if scene.has_landmarks else height_above_face(scene, plane), scene.square.unit)
        option = "--height" if options.plane is None else "--plane"
        raise ValueError(
            f"{option}: want a plane that the photograph shows, got {words}, "
            "which no ray of it meets: it lies behind the camera; check the height, its sign and its unit"
        )


def _view(options: argparse.Namespace, scene: Scene, plane: Plane) -> View:
    """What is shown, in whole pixels.

    Raises:
        ValueError: the resolution has another unit, or there would be too many pixels.
    """
    origin, along_x, along_y = plane_axes(plane)
    known = scene.calibration.points[scene.calibration.used[scene.view]] - origin
    places = torch.stack([known @ along_x, known @ along_y], dim=-1)
    low, high = places.amin(0), places.amax(0)
    around = AROUND * (high - low).max()
    extent = _extent(options.extent, scene) or (*(low - around).tolist(), *(high + around).tolist())
    resolution = _resolution(options.resolution, scene, plane, origin, along_x, along_y, extent)
    x0, y0, x1, y1 = extent
    columns, rows = (max(1, math.ceil(side / resolution - 1e-6)) for side in (x1 - x0, y1 - y0))
    if columns * rows > MOST_PIXELS:
        raise ValueError(
            f"--resolution: want a top view of at most {MOST_PIXELS:.0e} pixels, got {columns} x {rows} of them at "
            f"{resolution:g}; take a coarser one, or a smaller --extent"
        )
    # Seen from the camera's side of the plane: x cross y is its normal, turned to positive z.
    normal = torch.linalg.cross(along_x, along_y)
    above = float(normal @ (scene.camera.center - origin)) > 0
    whole = (x0, y0, x0 + columns * resolution, y0 + rows * resolution)
    return View(whole, resolution, columns, rows, options.north_up or above)


def _extent(given: tuple[Length, ...] | None, scene: Scene) -> tuple[float, ...] | None:
    """What of the plane is asked for, in world units.

    Raises:
        ValueError: a unit that the world's cannot be compared with, or no rectangle.
    """
    if given is None:
        return None
    values = [in_unit(each, scene.square.unit) for each in given]
    read = [value for value in values if value is not None]
    words = ",".join(str(each).replace(" ", "") for each in given)
    if len(read) != len(given):
        raise ValueError(f"--extent: want it in {scene.unit_in_words}, got {words}; leave the units out")
    if not is_extent(read):
        raise ValueError(f"--extent: want x1 above x0 and y1 above y0, got {words}")
    return tuple(read)


def _resolution(
    given: Length | None,
    scene: Scene,
    plane: Plane,
    origin: Tensor,
    along_x: Tensor,
    along_y: Tensor,
    extent: tuple[float, ...],
) -> float:
    """The side of a pixel in world units: as given, or 1, 2 or 5 times a power of ten near what the photograph has."""
    if given is not None:
        value = in_unit(given, scene.square.unit)
        if value is None:
            raise ValueError(f"--resolution: want it in {scene.unit_in_words}, got {given}; leave its unit out")
        return value
    x0, y0, x1, y1 = extent
    middle = origin + (x0 + x1) / 2 * along_x + (y0 + y1) / 2 * along_y
    pixels, seen = scene.camera.project(middle[None])
    covered, valid = ground_resolution(pixels, scene.camera, plane)
    if not bool(seen & valid):
        raise ValueError(
            f"--extent: want a part of the plane that the photograph shows, got {_in_words(extent, plane)}, whose "
            "middle it does not show; give another, or --resolution"
        )
    power = 10.0 ** math.floor(math.log10(float(covered)))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= float(covered) * (1 + 1e-9))


def _top_view(image: Shaped[np.ndarray, "..."], scene: Scene, plane: Plane, view: View) -> tuple[np.ndarray, float]:
    """The top view with its transparency `(rows, columns, 4)`, and the part of it that the photograph shows."""
    source = torch.from_numpy(np.ascontiguousarray(image)).movedim(-1, 0).to(torch.float32)
    most = np.iinfo(image.dtype).max
    top = np.zeros((view.rows, view.columns, 4), image.dtype)
    height = max(1, STRIP // view.columns)
    with progress_bars() as bars:
        for start in bars.track(range(0, view.rows, height), description="Rectifying"):
            end = min(view.rows, start + height)
            part, valid = rectify(
                source, scene.camera, plane, view.strip(start, end), view.resolution, north_up=view.north_up
            )
            top[start:end, :, :3] = part.round().clamp(0, most).movedim(0, -1).numpy().astype(image.dtype)
            top[start:end, :, 3] = valid.numpy() * most
    return top, float((top[..., 3] > 0).mean())


def _say(told: dict[str, Any], scene: Scene, plane: Plane) -> None:
    """Print what was made."""
    unit = f" {scene.square.unit}" if scene.square.unit else ""
    height = None if scene.has_landmarks else height_above_face(scene, plane)
    columns, rows = told["size"]
    result(f"{scene.title}\n")
    result(f"The plane {described(plane, height, scene.square.unit)}")
    result(f"{_in_words(told['extent'], plane, unit)}: {columns} x {rows} px of {told['resolution']:g}{unit}")
    if told["shown"] < 1:
        result(f"The photograph shows {100 * told['shown']:.0f} % of it; the rest is transparent")
    if told["doubts"]:
        result(textwrap.fill(f"DOUBTFUL: {told['doubts']}", 79))
    result(f"Written to {' and '.join(str(told[key]) for key in ('output', 'world_file') if told[key])}")


def _doubts(scene: Scene) -> str | None:
    """What makes the pose doubtful, where it is that of one photograph, and what is told is of no other."""
    alone = len(scene.calibration.views) == 1
    return (in_words(scene.calibration.doubts, scene.square.unit) or None) if alone else None


def _is_level(plane: Plane) -> bool:
    """Whether the plane's axes are the world's x and y."""
    _, along_x, along_y = plane_axes(plane)
    return along_x.tolist() == [1, 0, 0] and along_y.tolist() == [0, 1, 0]


def _in_words(extent: tuple[float, ...] | list[float], plane: Plane, unit: str = "") -> str:
    """The extent for people; of a plane that is not z = const along which axes, and from where."""
    x0, y0, x1, y1 = (f"{number:.10g}" for number in extent)
    if _is_level(plane):
        return f"x from {x0} to {x1} and y from {y0} to {y1}{unit}"
    places = (part.tolist() for part in plane_axes(plane))
    origin, *axes = (f"({', '.join(plain(round(z, 9)) for z in place)})" for place in places)
    return f"From {origin}, {x0} to {x1}{unit} along {axes[0]} and {y0} to {y1}{unit} along {axes[1]}"
