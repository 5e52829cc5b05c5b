"""The part on the lens: what it does to a pixel at each distance from the middle, where it ends, and other lenses."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from markupsafe import Markup
from torch import Tensor

from diffproj.calibration.results.border import border_with_rays
from diffproj.geometry.camera import Camera
from diffproj.lens.models import MODELS
from diffproj.report import svg
from diffproj.report.document import Part, render
from diffproj.report.facts import Facts

STEPS, AZIMUTHS = 160, 12
"""Angles from the axis, and directions around it over which the radius is averaged."""
FARTHEST = 12.0
"""Times the least of the poorer lenses' errors up to which errors are drawn."""
NEARLY_SIDEWAYS = 89.0
"""Degrees from the axis up to which a perspective lens is drawn."""
TITLES = {"none": "pinhole, no distortion", "fisheye": "fisheye (Kannala-Brandt), 4 coefficients"}


class Curve(NamedTuple):
    """What a lens does along the radius.

    Attributes:
        angle: from the axis in degrees.
        radius: how far from the principal point it is seen, in px.
        deviation: of that, in px; 0 where there is no covariance, NaN where the lens may end before.
        pinhole: the radius without the lens, in px; infinite at 90 degrees and beyond.
    """

    angle: Float[np.ndarray, " n"]
    radius: Float[np.ndarray, " n"]
    deviation: Float[np.ndarray, " n"]
    pinhole: Float[np.ndarray, " n"]


def lens_title(facts: Facts) -> str:
    """The lens in words."""
    name = facts.calibration.parameters.lens
    return TITLES.get(name, f"{name} (Brown-Conrady), {MODELS[name].count} coefficients")


def lens_part(facts: Facts) -> Part:
    """The lens curve, and the comparison of lenses where there was one."""
    figures = []
    if facts.converged and facts.calibration.camera.distortion is not None:
        figures.append(_curve_figure(facts, curve(facts)))
    comparison = facts.calibration.comparison
    if comparison is not None:
        figures.append(_comparison_figure(facts))
    rows = [] if comparison is None else list(_rows(facts))
    held_out = "" if comparison is None else comparison.held_out
    html = render(
        "lens.html",
        title=lens_title(facts),
        figures=figures,
        rows=rows,
        held_out=held_out,
        ends=_ends(facts),
        thing=facts.thing,
    )
    return Part("Lens", "lens", html, svg.STYLE)


def curve(facts: Facts) -> Curve:
    """The lens along the radius, up to the farthest corner of the image or the end of its domain."""
    calibration = facts.calibration
    camera = calibration.camera.detach().to("cpu", torch.float64).without_pose()
    perspective = MODELS[calibration.parameters.lens].perspective
    most = min(_domain_angle(camera, perspective), NEARLY_SIDEWAYS if perspective else 180.0)
    angle = torch.linspace(0, math.radians(most) * (1 - 1e-9), STEPS * 8, dtype=torch.float64, device="cpu")
    radius = _radius(camera, angle)
    inside = int((radius <= 1.02 * _farthest(facts)).sum())  # none that is not seen
    angle = torch.linspace(0, float(angle[max(1, inside - 1)]), STEPS, dtype=torch.float64, device="cpu")
    radius = _radius(camera, angle)
    pinhole = _radius(Camera(camera.K), angle.clamp(max=math.radians(89.99)))
    pinhole = torch.where(angle < math.radians(89.9), pinhole, torch.inf)
    return Curve(
        torch.rad2deg(angle).numpy(), radius.numpy(), _deviation(facts, camera, angle).numpy(), pinhole.numpy()
    )


def _radius(camera: Camera, angle: Tensor) -> Tensor:
    """How far from the principal point rays at angles `(n,)` are seen `(*B, n)`, in the mean around the axis.

    NaN where one of them is not seen.
    """
    around = torch.arange(AZIMUTHS, dtype=angle.dtype, device=angle.device) * (2 * math.pi / AZIMUTHS)
    side = angle.sin()[:, None]
    rays = torch.stack([side * around.cos(), side * around.sin(), angle.cos()[:, None].expand(-1, AZIMUTHS)], dim=-1)
    pixels, valid = camera.project(rays.flatten(0, 1))
    off = (pixels - camera.K[..., None, :2, 2]).norm(dim=-1)
    return torch.where(valid, off, torch.nan).unflatten(-1, (-1, AZIMUTHS)).mean(-1)


def _deviation(facts: Facts, camera: Camera, angle: Tensor) -> Tensor:
    """The standard deviation of the radius `(n,)`: how it moves with each independent step of the parameters.

    NaN from where on a step makes the lens end: nothing is known there.
    """
    calibration = facts.calibration
    nothing = torch.zeros_like(angle)
    if not calibration.has_covariance:
        return nothing
    parameters = calibration.parameters.of_camera
    count = parameters.size
    spread = calibration.covariance.shared.detach().to("cpu", torch.float64)[:count, :count]
    if not bool(spread.isfinite().all()):
        return nothing
    size, turn = torch.linalg.eigh(spread)
    steps = (turn * size.clamp(min=0).sqrt()).mT
    shared = calibration.shared.detach().to("cpu", torch.float64)[:count]
    both = torch.stack([shared + steps, shared - steps])
    posed = parameters.unpack(both, (camera.R.expand(2, count, 3, 3), camera.t.expand(2, count, 3)))
    ahead, behind = _radius(posed, angle)
    return ((ahead - behind) / 2).square().sum(0).sqrt()


def _domain_angle(camera: Camera, perspective: bool) -> float:
    """Where the lens ends, in degrees from the axis."""
    domain = math.inf if camera.distortion is None else float(camera.distortion.domain)
    return math.degrees(math.atan(domain) if perspective else min(domain, math.pi))


def _farthest(facts: Facts) -> float:
    """How far from the principal point the farthest corner of the image lies, in px."""
    width, height = facts.size
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=float)
    return float(np.hypot(*(corners - facts.middle).T).max())


def _outermost(facts: Facts) -> float:
    """How far from the principal point the farthest corner that was used lies, in px."""
    places = facts.pixels[facts.used]
    return float(np.hypot(*(places - facts.middle).T).max()) if len(places) else 0.0


def _ends(facts: Facts) -> str:
    """Where the lens ends, in a sentence."""
    if not facts.converged or facts.calibration.camera.distortion is None:
        return ""
    camera = facts.calibration.camera.detach().to("cpu", torch.float64)
    perspective = MODELS[facts.calibration.parameters.lens].perspective
    angle = _domain_angle(camera, perspective)
    if angle >= 180 or (perspective and angle >= 89.99):
        return "Its model is one-to-one everywhere, so every pixel has a ray."
    edge = torch.full((1,), math.radians(angle) * (1 - 1e-6), dtype=torch.float64, device="cpu")
    where = f"{angle:.0f}° from the axis, {float(_radius(camera.without_pose(), edge)):.0f} px from the principal point"
    if float(border_with_rays(camera, facts.size)) == 1:
        return f"Its model ends at {where}, outside of the image, so every pixel has a ray."
    return f"Its model ends at {where}, inside the image: pixels beyond have no ray."


def _curve_figure(facts: Facts, found: Curve) -> Markup:
    outermost, farthest = _outermost(facts), _farthest(facts)
    if MODELS[facts.calibration.parameters.lens].perspective:
        x, y, low, high = found.radius, *_displacement(found)
        x_label, y_label = "distance from the principal point, px", "moved outward by the lens, px"
        marks, other = [(outermost, f"outermost {facts.thing}"), (farthest, "corner of the image")], []
    else:
        x, y = found.angle, found.radius
        low, high = y - found.deviation, y + found.deviation
        x_label, y_label = "angle from the axis, degrees", "distance from the principal point, px"
        marks = [(float(np.interp(outermost, found.radius, found.angle)), f"outermost {facts.thing}")]
        flat = found.pinhole <= 1.02 * farthest
        other = list(zip(found.angle[flat], found.pinhole[flat], strict=True))
    told = np.isfinite(found.deviation)
    bottom = min(0.0, float(y.min()), float(low[told].min(initial=0)))
    top = max(0.0, float(y.max()), float(high[told].max(initial=0)))
    room = 0.06 * (top - bottom) or 1.0
    x_range, y_range = (0, max(float(x.max()), *(place for place, _ in marks)) * 1.03), (bottom - room, top + room)
    axes = svg.Axes(x_range, y_range, left=svg.room_beside(y_range), top=38)
    band = np.stack([np.append(x[told], x[told][::-1]), np.append(low[told], high[told][::-1])], axis=-1)
    parts = [
        axes.drawn(x_label, y_label),
        svg.line(axes.x(0), axes.y(0), axes.x(axes.x_range[1]), axes.y(0), "zero"),
        svg.polyline(axes.at(band), "band", closed=True),
        svg.polyline(axes.at(other), "faint dashed"),
        svg.polyline(axes.at(zip(x, y, strict=True)), "accent"),
    ]
    for n, (place, name) in enumerate(marks):
        spot = axes.x(place)
        parts.append(svg.line(spot, axes.y(axes.y_range[0]), spot, 18 + 14 * n, "faint dashed thin"))
        parts.append(svg.text(min(spot, axes.width - svg.RIGHT), 14 + 14 * n, name, "end", "tick"))
    most = float(np.abs(y).max())
    label = f"Lens curve: {y_label}, by {x_label}; {svg.plain(most, 3)} px at most"
    keys = [("line-accent", lens_title(facts).partition(",")[0]), ("box-band", "± one deviation")]
    if other:
        keys.append(("line-faint", "pinhole"))
    caption = (
        f"What the lens does, in the mean around its axis. Beyond the outermost {facts.thing} the curve is extrapolated"
    )
    caption += "." if told.all() else "; beyond the band it may end at any place."
    return svg.figure(svg.picture(axes.width, axes.height, label, *parts) + svg.key(*keys), caption)


def _displacement(found: Curve) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    moved = found.radius - found.pinhole
    return moved, moved - found.deviation, moved + found.deviation


def _rows(facts: Facts) -> list[dict[str, str | bool]]:
    comparison = facts.calibration.comparison
    if comparison is None:
        return []
    table = comparison.to_dict()
    keys = ("model", "fitted_px", "held_out_px", "worse_px", "deviation_px", "cause")
    rows = []
    for name, fitted, held_out, worse, deviation, cause in zip(*(table[key] for key in keys), strict=True):
        told = "the best" if worse == 0 else f"{worse:.4f} ± {deviation:.4f}"
        rows.append(
            {
                "name": name,
                "chosen": name == comparison.chosen,
                "count": str(MODELS[name].count),
                "fitted": f"{fitted:.4f}" if math.isfinite(fitted) else "failed",
                "held_out": f"{held_out:.4f}" if math.isfinite(held_out) else "failed",
                "worse": cause or told,
            }
        )
    return rows


def _comparison_figure(facts: Facts) -> Markup:
    comparison = facts.calibration.comparison
    assert comparison is not None  # noqa: S101  # who calls has looked
    worse, deviation = comparison.worse_px.tolist(), comparison.deviation_px.tolist()
    shown = [n for n, value in enumerate(worse) if math.isfinite(value)]
    ends = sorted(end for n in shown if 0 < (end := worse[n] + 2 * deviation[n]) < math.inf)
    far = min(1.06 * ends[-1], FARTHEST * ends[0]) if ends else 1.0
    row, left = 26.0, 80.0
    count = len(comparison.models)
    height = svg.TOP + svg.BOTTOM + count * row
    axes = svg.Axes((0, far), (0, count), height=height, left=left)
    parts = [axes.drawn("held-out error above the best lens's, px", "", y_ticks=[])]
    for n, name in enumerate(comparison.models):
        y = svg.TOP + (n + 0.5) * row
        parts.append(svg.text(left - 8, y + 4, name, "end", "strong" if name == comparison.chosen else "label"))
        if n not in shown:
            parts.append(svg.text(left + 6, y + 4, "failed", "start", "tick"))
        elif worse[n] > far:
            parts.append(svg.text(axes.x(far) - 4, y + 4, f"{worse[n]:.3g} px →", "end", "tick"))
        else:
            spread = deviation[n] if math.isfinite(deviation[n]) else 0.0
            low, high = axes.x(max(0.0, worse[n] - 2 * spread)), axes.x(min(far, worse[n] + 2 * spread))
            parts.append(svg.line(low, y, high, y, "accent"))
            parts.append(svg.dots([(axes.x(worse[n]), y)], "large"))
    label = f"Held-out errors of {count} lenses above the best one's; {comparison.chosen} was taken"
    caption = (
        "Lenses compared by corners held out, ± two deviations. The simplest that is no worse than the best is taken."
    )
    return svg.figure(svg.picture(axes.width, axes.height, label, *parts), caption)
