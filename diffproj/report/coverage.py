"""The part on coverage: where in the image the corners lie, and at which distances the target was."""

import numpy as np
import torch
from markupsafe import Markup

from diffproj.calibration.results.region import in_region
from diffproj.report import svg
from diffproj.report.document import Part, render
from diffproj.report.facts import Facts
from diffproj.report.residuals import some

CELLS = (12, 9)
"""Across and down, into which the image is divided for counting corners."""


def coverage_part(facts: Facts) -> Part:
    """Where the corners lie."""
    share = covered_share(facts)
    figures = [_corners(facts, share), _density(facts), _distances(facts)]
    html = render(
        "coverage.html", share=None if share is None else f"{100 * share:.0f}", figures=figures, thing=facts.thing
    )
    return Part("Coverage", "coverage", html, svg.STYLE)


def covered_share(facts: Facts) -> float | None:
    """Which part of the image that the lens sees the corners surround; `None` where it is not known."""
    reach = facts.calibration.region
    if reach is None:
        return None
    width, height = facts.size
    u, v = np.meshgrid((np.arange(96) + 0.5) * width / 96 - 0.5, (np.arange(72) + 0.5) * height / 72 - 0.5)
    pixels = torch.tensor(np.stack([u, v], axis=-1).reshape(-1, 2), dtype=torch.float64, device="cpu")
    _, has_ray = facts.calibration.camera.detach().to("cpu", torch.float64).directions(pixels)
    inside = in_region(pixels, reach.to("cpu", torch.float64))
    return float((inside & has_ray).sum() / has_ray.sum().clamp(min=1))


def region_line(facts: Facts, axes: svg.Axes, kind: str) -> Markup:
    """The outline of the corners' region."""
    return Markup() if facts.region is None else svg.polyline(axes.at(facts.region), kind, closed=True)


def _corners(facts: Facts, share: float | None) -> Markup:
    axes = svg.image_axes(facts.size)
    places = facts.pixels[facts.used]
    chosen = places[some(len(places))]
    drawn = [
        svg.rectangle(*axes.field, "paper"),
        svg.clipped("corners", axes, region_line(facts, axes, "faint dashed"), svg.dots(axes.at(chosen), "small")),
        svg.dots(axes.at(facts.pixels[facts.rejected]), "bad"),
        axes.drawn("u, px", "v, px", grid=False),
    ]
    label = f"{len(places)} {facts.thing}s of {len(facts.seen_views)} views over the image"
    keys = [("dot", facts.thing), ("line-faint", "region that they cover")]
    if facts.rejected.any():
        keys.append(("dot-bad", "rejected"))
    caption = f"All {facts.thing}s. Beyond the dashed line the lens is what its model makes of it."
    if share is not None:
        caption = f"All {facts.thing}s. The dashed line surrounds {100 * share:.0f} % of the image; beyond it " + (
            "the lens is what its model makes of it."
        )
    return svg.figure(svg.picture(axes.width, axes.height, label, *drawn) + svg.key(*keys), caption)


def _density(facts: Facts) -> Markup:
    axes = svg.image_axes(facts.size)
    (columns, rows), (width, height) = CELLS, facts.size
    u, v = facts.pixels[facts.used].T
    bounds = [[-0.5, width - 0.5], [-0.5, height - 0.5]]
    counts, _, _ = np.histogram2d(u, v, bins=CELLS, range=bounds)
    most = max(1.0, float(counts.max()))
    left, top, wide, high = axes.field
    parts = []
    for column in range(columns):
        for row in range(rows):
            count = int(counts[column, row])
            x, y = left + wide * column / columns, top + high * row / rows
            opacity = 0.06 + 0.5 * (count / most) ** 0.5 if count else 1.0
            kind = "cell" if count else "missing"
            words = f"{count} {facts.thing}s"
            parts.append(svg.rectangle(x, y, wide / columns - 1, high / rows - 1, kind, words, opacity))
            parts.append(svg.text(x + wide / columns / 2, y + high / rows / 2 + 3.5, str(count), "middle", "on-cell"))
    empty = float((counts == 0).mean())
    label = f"{facts.thing.title()}s in {columns} x {rows} cells of the image; {100 * empty:.0f} % of them have none"
    parts.append(axes.drawn("u, px", "v, px", grid=False))
    caption = f"How many {facts.thing}s lie in each cell of the image. {100 * empty:.0f} % of the cells have none."
    return svg.figure(svg.picture(axes.width, axes.height, label, *parts), caption)


def _distances(facts: Facts) -> Markup:
    far = facts.distances[facts.seen_views]
    if not len(far):
        return Markup()
    width = facts.size[0]
    parts_of_image = [
        float(np.ptp(hull[:, 0])) / width if len(hull) else 0.0
        for hull in (facts.outlines[v] for v in facts.seen_views)
    ]
    axes = svg.Axes((0, svg.reach(far.tolist())), (0, svg.reach([100 * part for part in parts_of_image], 50)))
    spots = svg.dots(axes.at(np.stack([far, 100 * np.array(parts_of_image)], axis=-1)), "large pale")
    drawn = [axes.drawn(f"distance of the target, {facts.unit}", "width in the image, %"), spots]
    label = f"Distances from {svg.plain(float(far.min()), 3)} to {svg.plain(float(far.max()), 3)} {facts.unit}"
    caption = "How far away the target was, and how much of the image's width it filled, one dot a view."
    return svg.figure(svg.picture(axes.width, axes.height, label, *drawn), caption)
