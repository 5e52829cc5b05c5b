"""What `diffproj measure` found, as one JSON document: points count from 1, and what is not known is `None`."""

import math
import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch

from diffproj.cli.measure_plane import described, height_above_face
from diffproj.cli.points_file import Pixel
from diffproj.cli.scene import Scene
from diffproj.cli.terminal import in_words, known
from diffproj.geometry.back_projection import Reason, explain
from diffproj.geometry.camera import Camera
from diffproj.geometry.plane import Plane
from diffproj.measurement.measurement import Measurement
from diffproj.measurement.quantity import Quantity
from diffproj.measurement.shapes import crosses_itself

REASONS = {
    Reason.NOT_FINITE: "the pixel is no number",
    Reason.OUTSIDE_LENS: "no ray comes through the lens to this pixel",
    Reason.CAMERA_ON_PLANE: "the camera itself lies in the plane",
    Reason.PARALLEL: "its ray runs parallel to the plane, as to the horizon",
    Reason.BEHIND: "its ray meets the plane only behind the camera, as above the horizon",
}


class PixelNoise(NamedTuple):
    """The standard deviation of a pixel's coordinates, and where it comes from: `hand`, `option` or `detector`."""

    sigma: float
    source: str


def document(
    scene: Scene, plane: Plane, noise: PixelNoise, pixels: Sequence[Pixel], measured: Measurement
) -> dict[str, Any]:
    """Everything that was measured.

    Args:
        scene: the camera at its pose.
        plane: what was measured on.
        noise: of the pixels.
        pixels: what was measured.
        measured: their points.
    """
    points, remarks = _points(scene.camera, plane, pixels, measured)
    names = [pixel.name for pixel in pixels]
    found = _quantities(measured.lengths()) if len(points) > 1 else []
    lengths = [
        {"from": number, "to": number + 1, "name": f"{names[number - 1]}, {names[number]}", **length}
        for number, length in enumerate(found, start=1)
    ]
    for (start, end), length in zip(pairwise(names), lengths, strict=True):
        if length["significant"] is False and length["deviation"] is not None:
            remarks.append(f"The length {start} to {end} is below three deviations: it cannot be told from 0.")
    area = None
    if len(points) > 2:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of outlines that cross themselves, of which a remark below tells
            area = {"name": f"{names[0]} to {names[-1]}", **_quantities(measured.area())[0]}
    if area is not None and area["value"] is not None and bool(crosses_itself(measured.points)):
        remarks.append("The outline crosses itself, so its area means little: give the points in order around it.")
    elif area is not None and area["significant"] is False and area["deviation"] is not None:
        remarks.append("The area is below three deviations: it cannot be told from 0.")
    if scene.calibration.has_alternatives and bool(scene.calibration.ambiguous[scene.view]):
        ratio = float(scene.calibration.likelihood_ratio[scene.view])
        what, remedy = "board's corners", "A photograph with the board larger or more tilted tells"
        if scene.has_landmarks:
            what, remedy = "landmarks", "More of them, or some that are not on their plane, tell"
        remarks.append(
            f"The {what} fit two poses, and the one taken is only {ratio:.2g} times likelier than the other; the "
            f"deviations hold the doubt. {remedy} them apart."
        )
    height = height_above_face(scene, plane)
    return {
        "camera": str(scene.camera_file),
        "photograph": None if scene.photograph is None else scene.photograph.label,
        "view": scene.calibration.views.names[scene.view],
        "view_rms": known(float(scene.calibration.view_rms[scene.view])),
        "unit": scene.square.unit,
        "square": None if scene.has_landmarks else scene.square.value,
        "plane": [*plane.normal.tolist(), float(plane.offset)],
        "height": height,
        "plane_in_words": described(plane, None if scene.has_landmarks else height, scene.square.unit),
        "pixel_sigma": noise.sigma,
        "pixel_sigma_from": noise.source,
        "deviations_include": list(scene.includes),
        "points": points,
        "lengths": lengths,
        "area": area,
        "doubts": in_words(measured.doubts, scene.square.unit) or None,
        "remarks": remarks,
    }


def _points(
    camera: Camera, plane: Plane, given: Sequence[Pixel], measured: Measurement
) -> tuple[list[dict[str, Any]], list[str]]:
    """The points, and remarks on those that are not on the plane or not in the photograph."""
    rows, remarks = [], []
    pixels = torch.tensor([[pixel.u, pixel.v] for pixel in given], dtype=torch.float64, device="cpu")
    seen = camera.in_image(pixels).tolist() if camera.size is not None else [True] * len(pixels)
    beyond = [None] * len(pixels) if measured.extrapolated is None else measured.extrapolated.tolist()
    bent, outside = measured.nonlinear.tolist(), []
    columns = (pixels, explain(pixels, camera, plane), measured.points, measured.deviations, *measured.interval())
    for number, (pixel, code, point, deviation, low, high) in enumerate(
        zip(*(column.tolist() for column in columns), strict=True), start=1
    ):
        reason = Reason(code)
        valid = reason == Reason.VALID
        name = given[number - 1].name
        row = {"number": number, "name": name, "pixel": pixel, "valid": valid, "reason": None if valid else reason.name}
        row["world"] = [known(x) for x in point] if valid else None
        row["deviation"] = [known(x) for x in deviation] if valid else None
        row["interval_95"] = [[known(a), known(b)] for a, b in zip(low, high, strict=True)] if valid else None
        row["extrapolated"] = beyond[number - 1]
        rows.append(row)
        if not valid:
            remarks.append(f"Point {name} is not on the plane: {REASONS[reason]}.")
        elif not seen[number - 1]:
            width, height = camera.size or (0, 0)
            remarks.append(f"Point {name} lies outside the photograph of {width} x {height} px.")
        elif beyond[number - 1]:
            outside.append(name)
        if bent[number - 1]:
            bounds = ", ".join(
                f"{axis} {between(a, b, s)}"
                for axis, a, b, s in zip("xyz", low, high, deviation, strict=True)
                if s > 1e-9 * max(deviation)
            )
            remarks.append(
                f"Point {name} is so close to the horizon that its deviations mislead. 95 % intervals: {bounds}."
            )
    if outside:
        remarks.append(
            f"{listed('Point', outside)} outside of the region that the calibration's corners covered. Only the "
            "lens model tells the lens there, and where it does not fit, the truth lies further off: calibrate with "
            "the board there too."
        )
    return rows, remarks


def listed(word: str, names: Sequence[str]) -> str:
    """`Point 2 lies`, `Points 2, 3 and 5 lie`."""
    *most, last = names
    return f"{word}s {', '.join(most)} and {last} lie" if most else f"{word} {last} lies"


def between(low: float, high: float, scale: float) -> str:
    """An interval for people, whose bounds may be infinite, to the second digit of the standard deviation `scale`."""
    decimals = max(0, 1 - math.floor(math.log10(scale))) if 0 < scale < math.inf else 3
    start, end = (f"{end:.{decimals}f}" if math.isfinite(end) else "" for end in (low, high))
    if start and end:
        return f"{start} to {end}"
    return f"from {start}" if start else f"up to {end}" if end else "unknown"


def _quantities(found: Quantity) -> list[dict[str, Any]]:
    low, high = found.interval(0.95)
    columns = (found.value, found.deviation, low, high, found.significant & (found.value > 0))
    return [
        {
            "value": known(value),
            "deviation": known(deviation),
            "interval_95": [known(below), known(above)] if math.isfinite(value) and math.isfinite(deviation) else None,
            "significant": significant if math.isfinite(value) else None,
        }
        for value, deviation, below, above, significant in zip(*(column.tolist() for column in columns), strict=True)
    ]
