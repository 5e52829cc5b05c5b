"""The part on the parameters: values, deviations, and which of them the views hardly tell apart."""

import math

import torch
from markupsafe import Markup

from diffproj._core.shown import rounded
from diffproj.report import svg
from diffproj.report.document import Part, render
from diffproj.report.facts import Facts

STRONG = 0.9
"""Correlation from which on a pair is named."""
TIED = 1 - 1e-9
"""Correlation from which on two parameters are one, as focal lengths that were tied."""
NAMED = 4
NUMBERS = 10
"""Parameters up to which correlations are written into their cells."""
MEANINGS = {
    "f_x": "focal length along u, px",
    "f_y": "focal length along v, px",
    "c_x": "principal point u, px",
    "c_y": "principal point v, px",
    "p1": "decentred lens",
    "p2": "decentred lens",
    "skew": "skew of rows and columns, px",
    "tau_x": "tilted sensor, radians",
    "tau_y": "tilted sensor, radians",
}


def parameters_part(facts: Facts) -> Part:
    """The table and the correlations."""
    calibration = facts.calibration
    rows = []
    for name, value in zip(calibration.parameters.few_names, calibration.shared.tolist(), strict=False):
        deviation = facts.deviations.get(name, math.nan)
        shown, spread = rounded(value, deviation)
        if deviation == 0:
            spread = "held"
        elif math.isinf(deviation):
            spread = "not determined"
        rows.append(
            {"name": name, "meaning": _meaning(facts, name), "value": shown, "deviation": spread or "not known"}
        )
    figure, strong = _correlations(facts)
    html = render("parameters.html", rows=rows, figure=figure, strong=strong)
    return Part("Parameters", "parameters", html, svg.STYLE)


def _meaning(facts: Facts, name: str) -> str:
    if name.startswith("bow"):
        return f"bow of the board along {name[-1]}, {facts.unit}"
    if name in MEANINGS:
        return MEANINGS[name]
    return "thin prism" if name.startswith("s") else "along the radius"


def _correlations(facts: Facts) -> tuple[Markup, list[str]]:
    """The picture of the correlations, and the pairs that are strong, in words."""
    calibration = facts.calibration
    names = [name for name, value in facts.deviations.items() if 0 < value < math.inf]
    if len(names) < 2:
        return Markup(), []
    known = calibration.parameters.few_names
    where = torch.tensor([known.index(name) for name in names], device="cpu")
    spread = calibration.covariance.shared.detach().to("cpu", torch.float64)[where][:, where]
    scale = spread.diagonal().sqrt()
    values = (spread / scale / scale[:, None]).clamp(-1, 1).tolist()
    cell = min(34.0, 340 / len(names))
    left, top = 52.0, 30.0
    parts = []
    for i, one in enumerate(names):
        y = top + i * cell
        parts.append(svg.text(left - 6, y + cell / 2 + 4, one, "end"))
        parts.append(svg.text(left + (i + 0.5) * cell, top - 8, one, "middle", "label" if cell > 26 else "tick"))
        for j in range(i + 1):
            value = values[i][j]
            x = left + j * cell
            words = f"{one}, {names[j]}: {value:+.2f}"
            kind = "plus" if value >= 0 else "minus"
            parts.append(svg.rectangle(x, y, cell - 1, cell - 1, kind, words, max(0.02, 0.6 * abs(value))))
            if len(names) <= NUMBERS and i != j:
                told = f"{value:+.2f}".replace("-", "\N{MINUS SIGN}").replace("0.", ".")
                parts.append(svg.text(x + cell / 2 - 0.5, y + cell / 2 + 3, told, "middle", "on-cell"))
    pairs = sorted(
        (
            (abs(values[i][j]), values[i][j], names[j], one)
            for i, one in enumerate(names)
            for j in range(i)
            if abs(values[i][j]) < TIED
        ),
        reverse=True,
    )
    strong = [f"{a} and {b} ({value:+.2f})".replace("-", "\N{MINUS SIGN}") for r, value, a, b in pairs if r >= STRONG]
    label = f"Correlations of {len(names)} parameters" + (f"; strongest {', '.join(strong[:NAMED])}" if strong else "")
    side = left + len(names) * cell + 6
    drawing = svg.picture(side, top + len(names) * cell + 4, label, *parts)
    keys = svg.key(("dot", "they err together"), ("dot-bad", "they err against each other"))
    caption = (
        "Correlations, 1 at full strength. Strong ones are common among the lens's coefficients and do no harm there."
    )
    return svg.figure(drawing + keys, caption), strong[:NAMED]
