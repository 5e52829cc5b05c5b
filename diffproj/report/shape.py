"""The part on the target's shape: where the points of the board, or the landmarks, lie, against where they should."""

import math

import numpy as np
import torch
from markupsafe import Markup

from diffproj.report import svg
from diffproj.report.document import Part, render
from diffproj.report.facts import Facts

ARROW = 0.06
"""Length of a displacement within the plane as large as their RMS, as a part of the target's longer side."""
BALL = 7.0
"""Radius of the largest displacement out of the plane."""


def shape_part(facts: Facts) -> Part:
    """How the board was printed, or where the landmarks are."""
    calibration = facts.calibration
    fitted = calibration.shape != "flat" and facts.converged
    figure, rms = _figure(facts) if fitted else (Markup(), "")
    html = render(
        "shape.html",
        fitted=fitted,
        bowed=calibration.shape == "bow",
        board=facts.planar,
        figure=figure,
        rms=rms,
        unit=facts.unit,
    )
    return Part("The board's shape" if facts.planar else "The landmarks' places", "shape", html, svg.STYLE)


def _figure(facts: Facts) -> tuple[Markup, str]:
    calibration = facts.calibration
    nominal = calibration.nominal.detach().to("cpu", torch.float64).numpy()
    off = calibration.board_points.detach().to("cpu", torch.float64).numpy() - nominal
    low, high = nominal[:, :2].min(0), nominal[:, :2].max(0)
    side = float((high - low).max())
    room = 0.1 * side
    x, y = (low - room).tolist()
    x2, y2 = (high + room).tolist()
    y_range = (y2, y) if float(calibration.cameras.R[..., 2, 2].detach().mean()) > 0 else (y, y2)
    left = svg.room_beside(y_range)
    wide = svg.WIDTH - left - svg.RIGHT
    height = svg.TOP + svg.BOTTOM + wide * min(1.6, (y2 - y) / (x2 - x))
    axes = svg.Axes((x, x2), y_range, height=height, left=left)
    within = float(np.sqrt((off[:, :2] ** 2).sum(-1).mean()))
    times = float(f"{ARROW * side / within:.2g}") if within > 0 else 1.0
    most = float(np.abs(off[:, 2]).max())
    parts = [axes.drawn(f"x, {facts.unit}", f"y, {facts.unit}", grid=False)]
    for place, z in zip(axes.at(nominal[:, :2]), off[:, 2].tolist(), strict=True):
        radius = BALL * math.sqrt(abs(z) / most) if most > 0 else 0.0
        parts.append(
            Markup('<circle class="{}" fill-opacity="0.45" cx="{}" cy="{}" r="{}"/>').format(
                "plus" if z >= 0 else "minus", f"{place[0]:.1f}", f"{place[1]:.1f}", f"{radius:.1f}"
            )
        )
    tips = nominal[:, :2] + times * off[:, :2]
    parts.append(svg.dots(axes.at(nominal[:, :2]), "small faint"))
    parts.append(svg.segments(axes.at(nominal[:, :2]), axes.at(tips), ""))
    parts.append(_ellipses(facts, axes, tips, times))
    rms = svg.plain(float(np.sqrt((off**2).sum(-1).mean())))
    points = "Points of the board" if facts.planar else "Landmarks"
    label = f"{points} off by {rms} {facts.unit} (RMS), at most {svg.plain(most)} out of the plane"
    keys = svg.key(
        ("dot", f"out of the plane along z, at most {svg.plain(float(off[:, 2].max(initial=0)))} {facts.unit}"),
        ("dot-bad", f"against z, at most {svg.plain(float(-off[:, 2].min(initial=0)))} {facts.unit}"),
    )
    sure = " Ellipses at their tips are one standard deviation." if calibration.displacements is not None else ""
    caption = f"Lines lead from where each point should be to where it is, {times:g} times as long.{sure}"
    return svg.figure(svg.picture(axes.width, axes.height, label, *parts) + keys, caption), rms


def _ellipses(facts: Facts, axes: svg.Axes, tips: np.ndarray, times: float) -> Markup:
    """One standard deviation around the tips of free points, magnified as they are."""
    calibration = facts.calibration
    if calibration.displacements is None or not calibration.has_covariance:
        return Markup()
    blocks = calibration.covariance.points.detach().to("cpu", torch.float64)
    blocks = blocks.unflatten(-1, (-1, 3)).unflatten(-3, (-1, 3))
    angle = np.linspace(0, 2 * np.pi, 17)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    parts = []
    for n, tip in enumerate(tips):
        block = blocks[n, :2, n, :2].numpy()
        if np.isfinite(block).all():
            size, turn = np.linalg.eigh(block)
            ring = tip + times * ((turn * np.sqrt(np.clip(size, 0, None))) @ circle).T
            parts.append(svg.polyline(axes.at(ring), "bad thin", closed=True))
    return Markup("").join(parts)
