"""The part with the photographs: where corners were seen, and where the camera puts them."""

import math

import numpy as np
from markupsafe import Markup

from diffproj.report import svg
from diffproj.report.document import Part, render, shortened
from diffproj.report.facts import NAME, Facts
from diffproj.report.pictures import MOST_VIEWS, SIDE, Pictures

MOST_CORNERS = 40_000
"""Corners of all views together above which only some views are shown, those that fit worst first."""
ODD = 2.0
"""Times the usual RMS from which on a view is marked."""
ARROW = 0.02
"""Length of a residual as large as the RMS, as a part of the image's longer side."""


def photographs_part(facts: Facts, pictures: Pictures) -> Part:
    """The views, each with its corners and residuals."""
    views, count = list(range(len(facts.names))), len(facts.names)
    fitting = max(1, MOST_CORNERS // max(1, facts.pixels.shape[1]))
    if count > min(MOST_VIEWS, fitting):
        worst = sorted(views, key=lambda view: -np.nan_to_num(facts.view_rms[view]))
        views = sorted(worst[: min(MOST_VIEWS, fitting)])
    addresses = pictures.addresses(views)
    magnification = times(facts, ARROW)
    usual = float(np.nanmedian(facts.view_rms)) if facts.seen_views else 0.0
    cards = []
    for view in views:
        seen = int(facts.calibration.views.visible[view].sum())
        rms = facts.view_rms[view]
        cards.append(
            {
                "name": facts.names[view],
                "picture": _card(facts, view, addresses.get(view), magnification),
                "loupe": _loupe(facts, view, pictures),
                "corners": f"{int(facts.used[view].sum())} of {seen} {facts.thing}s",
                "rms": f"RMS {svg.plain(float(rms), 3)} px" if math.isfinite(rms) else "left out",
                "odd": bool(rms > ODD * usual > 0),
                "where": _where(facts, view),
            }
        )
    others = [shortened(name, NAME) for name in pictures.others]
    html = render(
        "photographs.html",
        cards=cards,
        left_out=count - len(views),
        count=count,
        others=others,
        searched=pictures.searched,
        magnification=f"{magnification:g}",
        shown=bool(addresses),
        rejected=bool(facts.rejected.any()),
        thing=facts.thing,
    )
    return Part("Photographs", "photographs", html, svg.STYLE)


def times(facts: Facts, part: float) -> float:
    """How many times as long as they are residuals are drawn, so that a usual one has that part of the image's side."""
    known = facts.residuals[facts.known]
    rms = float(np.sqrt((known**2).sum(-1).mean())) if len(known) else 0.0
    return float(f"{part * max(facts.size) / rms:.2g}") if rms > 1e-9 else 1.0


def _card(facts: Facts, view: int, address: str | None, magnification: float) -> Markup:
    width, height = facts.size
    parts = []
    if address is not None:
        parts.append(svg.image(-0.5, -0.5, width, height, address, "photograph"))
    known, used = facts.known[view], facts.used[view]
    pixels, residuals = facts.pixels[view], facts.residuals[view]
    rings = svg.rings(pixels[used], 0.008 * max(width, height), "seen")
    ends = pixels[known], pixels[known] + magnification * residuals[known]
    parts += [
        Markup('<g class="under">{}{}</g>').format(rings, svg.segments(*ends, "")),
        rings,
        svg.segments(*ends, "off"),
    ]
    parts.append(svg.crosses(pixels[facts.rejected[view]], 0.01 * max(width, height), "off"))
    label = f"{facts.names[view]}: {int(used.sum())} {facts.thing}s"
    if used.any():
        label += f", RMS {svg.plain(float(facts.view_rms[view]), 3)} px"
    return Markup('<svg class="picture" viewBox="-0.5 -0.5 {} {}" role="img" aria-label="{}">{}</svg>').format(
        width, height, label, Markup("").join(parts)
    )


def _loupe(facts: Facts, view: int, pictures: Pictures) -> Markup:
    """The worst corner of a view, enlarged; nothing without its photograph."""
    lengths = np.hypot(*facts.residuals[view].T)
    if not np.isfinite(lengths).any():
        return Markup()
    corner = int(np.nanargmax(lengths))
    u, v = facts.pixels[view, corner]
    found = pictures.enlarged(view, u, v)
    if found is None:
        return Markup()
    address, left, top = found
    du, dv = facts.residuals[view, corner]
    parts = [
        svg.image(left - 0.5, top - 0.5, SIDE, SIDE, address, "pixels"),
        svg.rings([(u, v)], 2.0, "seen"),
        svg.crosses([(u + du, v + dv)], 1.6, "off", 2),
    ]
    off = svg.plain(float(lengths[corner]))
    label = f"The {facts.thing} of {facts.names[view]} that fits worst, enlarged: {off} px off"
    box = f"{left - 0.5} {top - 0.5} {SIDE} {SIDE}"
    return Markup('<svg class="picture loupe" viewBox="{}" role="img" aria-label="{}">{}</svg>').format(
        box, label, Markup("").join(parts)
    )


def _where(facts: Facts, view: int) -> str:
    """How far away the target was, and how it was tilted."""
    if not facts.used[view].any():
        return ""
    away = f"{svg.plain(float(facts.distances[view]), 3)} {facts.unit} away"
    return f"{away}, tilted {np.hypot(*facts.tilts[view]):.0f}°" if facts.planar else away
