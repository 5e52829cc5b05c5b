"""The part on accuracy: how surely a pixel is put back on the board's plane, over the image and over the plane."""

import math
import warnings
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float
from markupsafe import Markup

from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.plane import Plane
from diffproj.measurement.accuracy_map import AccuracyMap
from diffproj.report import svg
from diffproj.report.document import Part, data_uri, render
from diffproj.report.facts import Facts

PLACES = 56
"""Places of a map along its longer side."""
AROUND = 0.6
"""How far beyond the board the plane is drawn, as a part of the board's sides."""
BAR, BAR_ROOM = 12.0, 62.0
FINE_STEPS = (1, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.8, 2, 2.2, 2.5, 3, 3.5, 4, 4.5, 5, 6, 7, 8, 9)
EDGE = 12
"""Places along each edge of the region that the corners cover, whose image on the plane is curved."""


def accuracy_part(facts: Facts) -> Part:
    """The two maps, for the view whose distance is the usual one."""
    if not (facts.converged and facts.calibration.has_covariance and facts.seen_views):
        why = "How sure a pixel is cannot be told: " + (
            "the camera was not found." if not facts.converged else "the file holds no deviations."
        )
        return Part("Accuracy", "accuracy", render("nothing.html", why=why), svg.STYLE)
    view, calibration = facts.usual_view, facts.calibration
    plane = Plane.z(facts.plane_z)
    with warnings.catch_warnings():  # what they say is in the verdict
        warnings.simplefilter("ignore")
        over_image = AccuracyMap.over_image(calibration, plane, view, max(facts.size) / PLACES)
        over_plane = AccuracyMap.over_plane(calibration, _extent(calibration), plane, view, _shape(calibration))
    html = render(
        "accuracy.html",
        view=facts.names[view],
        board=facts.planar,
        distance=f"{svg.plain(float(facts.distances[view]), 3)} {facts.unit}",
        sigma=svg.plain(facts.sigma),
        figures=[_image_figure(facts, over_image), _plane_figure(facts, over_plane, plane)],
    )
    return Part("Accuracy", "accuracy", html, svg.STYLE)


def _extent(calibration: Calibration) -> tuple[float, float, float, float]:
    """The target with some room around it."""
    xy = calibration.nominal[:, :2]
    low, high = xy.amin(0), xy.amax(0)
    side = (high - low).amax() * AROUND
    x, y, x2, y2 = [*(low - side).tolist(), *(high + side).tolist()]
    return (x, y, x2, y2)


def _shape(calibration: Calibration) -> tuple[int, int]:
    x, y, x2, y2 = _extent(calibration)
    scale = PLACES / max(x2 - x, y2 - y)
    return max(2, round((y2 - y) * scale)), max(2, round((x2 - x) * scale))


def _image_figure(facts: Facts, found: AccuracyMap) -> Markup:
    frame = svg.image_axes(facts.size)
    width, height = facts.size
    axes = svg.Axes(frame.x_range, frame.y_range, svg.WIDTH + BAR_ROOM, frame.height, right=svg.RIGHT + BAR_ROOM)
    values = found.deviation.numpy(force=True)
    # Places lie on the image's edge, in the middle of the map's outer cells.
    rows, columns = values.shape
    du, dv = (width - 1) / (columns - 1), (height - 1) / (rows - 1)
    box = (-du / 2, -dv / 2, width - 1 + du / 2, height - 1 + dv / 2)
    region = _region(facts)
    drawn = [
        _pattern("hatch-image"),
        svg.rectangle(*axes.field, "lost"),
        svg.clipped(
            "map-image",
            axes,
            _map(axes, values, box),
            _covered(axes, None if region is None else axes.at(region), "hatch-image"),
        ),
        axes.drawn("u, px", "v, px", grid=False),
        _bar(axes, values, facts.unit),
    ]
    plane = "the board's plane" if facts.planar else "that plane"
    caption = f"Over the image: standard deviation of a point on {plane} along its worst direction."
    return svg.figure(svg.picture(axes.width, axes.height, _label("the image", values, facts.unit), *drawn), caption)


def _plane_figure(facts: Facts, found: AccuracyMap, plane: Plane) -> Markup:
    calibration = facts.calibration
    x, y, x2, y2 = _extent(calibration)
    y_range = (y2, y) if float(calibration.cameras.R[..., 2, 2].detach().mean()) > 0 else (y, y2)
    left = svg.room_beside(y_range)
    wide = svg.WIDTH - left - svg.RIGHT
    axes = svg.Axes(
        (x, x2),
        y_range,
        svg.WIDTH + BAR_ROOM,
        svg.TOP + svg.BOTTOM + wide * min(1.5, (y2 - y) / (x2 - x)),
        left=left,
        right=svg.RIGHT + BAR_ROOM,
    )
    values = found.deviation.numpy(force=True)
    rows, columns = values.shape
    dx, dy = (x2 - x) / (columns - 1), (y2 - y) / (rows - 1)
    box = (x - dx / 2, y - dy / 2, x2 + dx / 2, y2 + dy / 2)
    low, high = calibration.nominal[:, :2].amin(0).tolist(), calibration.nominal[:, :2].amax(0).tolist()
    board = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    region = _on_plane(facts, plane)
    drawn = [
        _pattern("hatch-plane"),
        svg.rectangle(*axes.field, "lost"),
        svg.clipped(
            "map-plane",
            axes,
            _map(axes, values, box),
            _covered(axes, None if region is None else axes.at(region), "hatch-plane"),
        ),
        svg.polyline(axes.at(board), "board", closed=True) if facts.planar else Markup(),
        axes.drawn(f"x, {facts.unit}", f"y, {facts.unit}", grid=False),
        _bar(axes, values, facts.unit),
    ]
    caption = "Over that plane, in the landmarks' x and y."
    if facts.planar:
        caption = "Over the board's plane, in its own x and y; the thin rectangle is the board."
    return svg.figure(svg.picture(axes.width, axes.height, _label("the plane", values, facts.unit), *drawn), caption)


def _label(where: str, values: np.ndarray, unit: str) -> str:
    known = values[np.isfinite(values)]
    spread = f"from {svg.plain(float(known.min()))} to {svg.plain(float(known.max()))} {unit}" if known.size else "none"
    return f"Map over {where} of the standard deviation of a measured point: {spread}"


def _map(axes: svg.Axes, values: np.ndarray, box: Sequence[float]) -> Markup:
    """The map's colours, one pixel a place, over the box of the axes' values that its pixels fill."""
    x, y, x2, y2 = box
    left, right = sorted((axes.x(x), axes.x(x2)))
    top, bottom = sorted((axes.y(y), axes.y(y2)))
    if axes.y(y) > axes.y(y2):
        values = values[::-1]
    picture = _coloured(values, *_range(values))
    return svg.image(left, top, right - left, bottom - top, data_uri(cv2.imencode(".png", picture)[1].tobytes()))


def _range(values: np.ndarray) -> tuple[float, float]:
    """The least and the greatest value that colours stand for, at least a fifth apart."""
    known = values[np.isfinite(values) & (values > 0)]
    if not known.size:
        return 1.0, 10.0
    low, high = float(known.min()), float(min(known.max(), 1000 * known.min()))
    return (low, high) if high > 1.2 * low else (low / 1.1, low * 1.1)


def _coloured(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Colours `(H, W, 4)` on a logarithmic scale; transparent where there is no value."""
    known = np.isfinite(values) & (values > 0)
    share = np.log(np.where(known, values, low) / low) / math.log(high / low)
    grey = np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2BGRA)
    colours[..., 3] = np.where(known, 255, 0)
    return colours


def _bar(axes: svg.Axes, values: np.ndarray, unit: str) -> Markup:
    """What the colours stand for."""
    low, high = _range(values)
    _, top, _, height = axes.field
    x = axes.width - BAR_ROOM + 4
    column = np.geomspace(high, low, 64)[:, None]
    parts = [svg.image(x, top, BAR, height, data_uri(cv2.imencode(".png", _coloured(column, low, high))[1].tobytes()))]
    for value in _log_ticks(low, high):
        y = top + height * (1 - math.log(value / low) / math.log(high / low))
        parts.append(svg.line(x + BAR, y, x + BAR + 3, y, "faint"))
        parts.append(svg.text(x + BAR + 5, y + 4, f"{value:g}", "start", "tick"))
    parts.append(svg.text(axes.width - 2, axes.height - 9, unit, "end", "label"))
    return Markup("").join(parts)


def _log_ticks(low: float, high: float) -> list[float]:
    """Round numbers between two, for a logarithmic scale, about six."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found: list[float] = []
    for steps in (FINE_STEPS, (1, 1.5, 2, 3, 5, 7), (1, 2, 5), (1,)):
        found = [float(f"{m * 10.0**p:.6g}") for p in powers for m in steps if low <= m * 10.0**p <= high]
        if len(found) <= 7:
            return found
    return found[:: -(-len(found) // 7)]


def _pattern(name: str) -> Markup:
    """Hatching for what is extrapolated."""
    return Markup(
        '<pattern class="hatch" id="{}" width="7" height="7" patternUnits="userSpaceOnUse" '
        'patternTransform="rotate(45)"><path d="M0 0V7"/></pattern>'
    ).format(name)


def _region(facts: Facts) -> Float[np.ndarray, "k 2"] | None:
    """The outline of what the corners cover within the image, in px; `None` where it is not known."""
    if facts.region is None:
        return None
    width, height = facts.size
    frame = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]])
    area, found = cv2.intersectConvexConvex(facts.region.astype(np.float32), frame.astype(np.float32))
    return found.reshape(-1, 2).astype(float) if area > 0 and found is not None else None


def _on_plane(facts: Facts, plane: Plane) -> Float[np.ndarray, "k 2"] | None:
    """The same on the plane, in its x and y; `None` where some of it has no point there."""
    region = _region(facts)
    if region is None:
        return None
    steps = np.linspace(0, 1, EDGE, endpoint=False)[:, None, None]
    dense = ((1 - steps) * region + steps * np.roll(region, -1, axis=0)).swapaxes(0, 1).reshape(-1, 2)
    camera = facts.calibration.cameras[facts.usual_view].detach()
    points, valid = back_project(camera.K.new_tensor(dense.tolist()), camera, plane)
    return points[:, :2].to("cpu", torch.float64).numpy() if bool(valid.all()) else None


def _covered(axes: svg.Axes, region: Float[np.ndarray, "k 2"] | None, pattern: str) -> Markup:
    """A line around a region, and hatching outside of it."""
    if region is None:
        return Markup()
    left, top, width, height = axes.field
    inner = "L".join(f"{x:.1f} {y:.1f}" for x, y in region.tolist())
    hatching = Markup('<path class="{}" fill-rule="evenodd" d="{}M{}Z"/>').format(
        pattern, f"M{left} {top}h{width}v{height}h{-width}Z", inner
    )
    return hatching + svg.polyline(region, "covered dark", True) + svg.polyline(region, "covered", True)
