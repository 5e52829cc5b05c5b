"""The part on residuals: over the image, by distance from the middle, by view, and against a normal curve."""

import itertools
import math

import numpy as np
from markupsafe import Markup

from diffproj.report import svg
from diffproj.report.document import Part, render
from diffproj.report.facts import Facts
from diffproj.report.photographs import times

ARROW = 0.03
"""Length of a residual as large as the RMS, as a part of the image's longer side."""
MOST = 4000
"""Corners that a picture shows, evenly chosen where there are more."""
MOST_VIEWS = 40
"""Views that a picture names, those that fit worst where there are more."""
ODD = 2.0
BINS = 10
"""Rings around the middle over which residuals are averaged, and half of the bins of the histogram."""
LABEL = 17
"""Characters of a view's name beside its bar."""


def residuals_part(facts: Facts) -> Part:
    """The pictures of residuals."""
    places, residuals = facts.pixels[facts.known], facts.residuals[facts.known]
    if not len(places):
        why = f"No {facts.thing} has a residual."
        return Part("Residuals", "residuals", render("nothing.html", why=why), svg.STYLE)
    coordinates = residuals.reshape(-1)
    sigma = float(np.sqrt((coordinates**2).mean()))
    beyond = float((np.abs(coordinates) > 3 * sigma).mean()) if sigma > 0 else 0.0
    html = render(
        "residuals.html",
        figures=[
            _over_image(facts, places, residuals),
            _by_distance(facts, places, residuals),
            _by_view(facts),
            _histogram(coordinates, sigma, beyond, facts.thing),
        ],
        rms=svg.plain(facts.rms, 3),
        sigma=svg.plain(facts.sigma, 3),
        thing=facts.thing,
        rows=[
            (name, int(used), f"{rms:.4f}" if used else "left out")
            for name, used, rms in zip(facts.names, facts.used.sum(-1), facts.view_rms, strict=True)
        ],
    )
    return Part("Residuals", "residuals", html, svg.STYLE)


def some(count: int, most: int = MOST) -> slice:
    """So many of a number of things at most, evenly chosen."""
    return slice(None, None, max(1, -(-count // most)))


def _over_image(facts: Facts, places: np.ndarray, residuals: np.ndarray) -> Markup:
    axes = svg.image_axes(facts.size)
    magnification = times(facts, ARROW)
    chosen = some(len(places))
    tips = places[chosen] + magnification * residuals[chosen]
    drawn = [
        svg.clipped(
            "arrows",
            axes,
            svg.segments(axes.at(places[chosen]), axes.at(tips), "bad"),
            svg.dots(axes.at(places[chosen]), "small"),
        ),
        axes.drawn("u, px", "v, px", grid=False),
    ]
    label = f"Residuals of {len(places)} {facts.thing}s over the image, {magnification:g} times as long"
    note = "" if chosen.step == 1 else f" Every {chosen.step}th {facts.thing} is shown."
    caption = (
        f"Over the image: from each {facts.thing} to where the camera puts it, {magnification:g} times as long. "
        f"Neighbours should point this way and that; arrows that flow together are the sign of another lens.{note}"
    )
    return svg.figure(svg.picture(axes.width, axes.height, label, *drawn), caption)


def _by_distance(facts: Facts, places: np.ndarray, residuals: np.ndarray) -> Markup:
    off = places - facts.middle
    distance = np.hypot(*off.T)
    outward = (residuals * off).sum(-1) / np.maximum(distance, 1e-9)
    far = svg.reach(distance.tolist())
    high = svg.reach(np.abs(outward).tolist())
    axes = svg.Axes((0, far), (-high, high), left=svg.room_beside((-high, high)))
    means, bands = [], []
    edges = np.quantile(distance, np.linspace(0, 1, BINS + 1))
    for low, top in itertools.pairwise(edges.tolist()):
        inside = (distance >= low) & (distance <= top)
        if inside.sum() > 3:
            mean, error = float(outward[inside].mean()), float(outward[inside].std() / math.sqrt(inside.sum()))
            middle = float(distance[inside].mean())
            means.append((middle, mean))
            bands.append((middle, mean - 2 * error, mean + 2 * error))
    chosen = some(len(places))
    cloud = svg.dots(axes.at(np.stack([distance, outward], axis=-1)[chosen]), "small pale faint")
    band = [(x, low) for x, low, _ in bands] + [(x, top) for x, _, top in reversed(bands)]
    drawn = [
        axes.drawn("distance from the principal point, px", "outward residual, px"),
        svg.line(axes.x(0), axes.y(0), axes.x(far), axes.y(0), "zero"),
        cloud,
        svg.polyline(axes.at(band), "band", closed=True),
        svg.polyline(axes.at(means), "accent"),
    ]
    worst = max((abs(mean) for _, mean in means), default=0.0)
    label = (
        f"Outward residuals by distance from the principal point; the mean of a ring is {svg.plain(worst)} px at most"
    )
    keys = svg.key(
        ("dot-faint", f"a {facts.thing}"), ("line-accent", "mean of a ring"), ("box-band", "mean ± 2 of its deviations")
    )
    caption = "By distance from the middle: the line should stay on zero within its band; a wave means another lens."
    return svg.figure(svg.picture(axes.width, axes.height, label, *drawn) + keys, caption)


def _by_view(facts: Facts) -> Markup:
    seen = facts.seen_views
    shown = seen
    if len(seen) > MOST_VIEWS:
        shown = sorted(sorted(seen, key=lambda view: -facts.view_rms[view])[:MOST_VIEWS])
    values = facts.view_rms[shown]
    finite = values[np.isfinite(values)]
    usual = float(np.median(finite)) if len(finite) else 0.0
    row, left = 17.0, 118.0
    height = svg.TOP + svg.BOTTOM + max(6.0, len(shown)) * row
    axes = svg.Axes((0, svg.reach([*values.tolist(), 1.2 * usual])), (0, max(6, len(shown))), height=height, left=left)
    parts = [axes.drawn("RMS, px", "", y_ticks=[])]
    for n, (view, rms) in enumerate(zip(shown, values.tolist(), strict=True)):
        y = svg.TOP + n * row
        name = facts.names[view]
        short = name if len(name) <= LABEL else f"{name[: LABEL // 2]}…{name[-(LABEL // 2) :]}"
        parts.append(svg.text(left - 6, y + 12.5, short, "end", "tick"))
        kind = "bar odd" if rms > ODD * usual > 0 else "bar"
        top = min(rms, axes.x_range[1]) if math.isfinite(rms) else axes.x_range[1]
        words = f"{name}: {svg.plain(rms, 3)} px"
        parts.append(svg.rectangle(left, y + 3, axes.x(top) - left, row - 5, kind, words))
    parts.append(svg.line(axes.x(usual), svg.TOP, axes.x(usual), height - svg.BOTTOM, "faint dashed"))
    label = f"RMS of {len(shown)} views, {svg.plain(usual, 3)} px in the median"
    caption = "By view: the dashed line is the median. " + (
        f"A bar beyond {ODD:g} times as much is red: look at that photograph."
        if len(shown) == len(seen)
        else f"Of {len(seen)} views those {len(shown)} that fit worst."
    )
    return svg.figure(svg.picture(axes.width, axes.height, label, *parts), caption)


def _histogram(coordinates: np.ndarray, sigma: float, beyond: float, thing: str) -> Markup:
    scale = sigma if sigma > 0 else 1.0
    end = 4.0
    counts, edges = np.histogram(np.clip(coordinates / scale, -end, end), 4 * BINS, (-end, end))
    density = counts / (len(coordinates) * (edges[1] - edges[0]))
    curve = [(x, math.exp(-x * x / 2) / math.sqrt(2 * math.pi)) for x in np.linspace(-end, end, 81).tolist()]
    y_range = 0.0, svg.reach([*density.tolist(), 0.4]) / scale
    axes = svg.Axes((-end * scale, end * scale), y_range, left=svg.room_beside(y_range))
    parts = [axes.drawn("residual along u and v, px", "part of all, per px")]
    for low, high, value in zip(edges[:-1] * scale, edges[1:] * scale, density / scale, strict=True):
        top = axes.y(value)
        parts.append(svg.rectangle(axes.x(low) + 0.5, top, axes.x(high) - axes.x(low) - 1, axes.y(0) - top, "bar two"))
    parts.append(svg.polyline(axes.at((x * scale, y / scale) for x, y in curve), "accent"))
    label = f"Histogram of {len(coordinates)} residuals against a normal curve of deviation {svg.plain(sigma, 3)} px"
    caption = (
        f"Against a normal curve of the same deviation, {svg.plain(sigma, 3)} px. Beyond three deviations lie "
        f"{100 * beyond:.1f} % of the residuals, of a normal curve 0.3 %; many more are the sign of wrong {thing}s."
    )
    return svg.figure(svg.picture(axes.width, axes.height, label, *parts), caption)
