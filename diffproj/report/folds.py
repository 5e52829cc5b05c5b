"""The part on views held out: what the camera is worth on photographs that it was not fitted to."""

import math
from typing import NamedTuple

from jaxtyping import Float
from markupsafe import Markup
from torch import Tensor

from diffproj.calibration.results.calibration import CalibrationError
from diffproj.calibration.validation import CrossValidation, cross_validate
from diffproj.report import svg
from diffproj.report.document import Part, render
from diffproj.report.facts import Facts
from diffproj.targets.landmarks import Landmarks
from diffproj.targets.target import Target

FEWEST = 4
"""Views with corners below which none can be spared."""
CLOSE = 1.5
"""Times the fitted error up to which the held-out one is close to it."""


class Points(NamedTuple):
    """A target of points alone.

    Attributes:
        points: in the world.
    """

    points: Float[Tensor, "n 3"]


def folds_part(facts: Facts, folds: CrossValidation | int | None, target: Target | None) -> Part:
    """The errors on views held out."""
    found, why = _validated(facts, folds, target)
    figure, rows, means = Markup(), [], {}
    if found is not None:
        table = found.to_dict()
        names = ("in_sample_px", "held_out_px", "in_sample_world", "held_out_world")
        means = {name: _rms(table[name]) for name in names}
        columns = [_column([*table[name], means[name]]) for name in names]
        rows = [list(row) for row in zip([*map(str, table["fold"]), "all"], *columns, strict=True)]
        figure = _figure(table["in_sample_px"], table["held_out_px"])
    html = render(
        "folds.html",
        why=why,
        rows=rows,
        figure=figure,
        unit=facts.unit,
        thing=facts.thing,
        count=len(rows) - 1,
        held_out_px=svg.plain(means.get("held_out_px", math.nan), 3),
        held_out_world=svg.plain(means.get("held_out_world", math.nan)),
        in_sample_px=svg.plain(means.get("in_sample_px", math.nan), 3),
        close=means.get("held_out_px", math.inf) <= CLOSE * means.get("in_sample_px", 0.0),
        lost=0 if found is None else int(found.lost.sum()),
    )
    return Part("Views held out", "held-out", html, svg.STYLE)


def _validated(
    facts: Facts, folds: CrossValidation | int | None, target: Target | None
) -> tuple[CrossValidation | None, str]:
    """The cross-validation, or why there is none."""
    calibration = facts.calibration
    if isinstance(folds, CrossValidation):
        return folds, ""
    if folds is None:
        return None, "It was not asked for: folds=5 (--folds 5) refits without each fifth of the views in turn."
    if not facts.converged:
        return None, "The camera was not found, so there is nothing to test."
    if len(facts.seen_views) < FEWEST:
        return None, f"It takes {FEWEST} views, and here are {len(facts.seen_views)}: none can be spared for a test."
    if any(value == 0 for value in facts.deviations.values()):
        return None, "Some parameters were held; give dp.cross_validate(...) with the same options as folds."
    if target is None:
        target = Landmarks(calibration.nominal) if calibration.landmarks else Points(calibration.nominal)
    views = calibration.views[facts.seen_views].hiding(calibration.rejected[facts.seen_views])
    try:
        return (
            cross_validate(
                views,
                target,
                calibration.parameters.lens,
                min(folds, len(views)),
                shape=calibration.shape,
                skew=calibration.skew,
                objective=calibration.objective,
            ),
            "",
        )
    except (CalibrationError, ValueError) as error:
        return None, f"It failed: {error}"


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(value * value for value in values) / len(values))


def _column(values: list[float]) -> list[str]:
    """Numbers with as many decimals as show four digits of the last, their mean."""
    last = (
        values[-1] if math.isfinite(values[-1]) and values[-1] > 0 else max(filter(math.isfinite, values), default=0.0)
    )
    decimals = min(max(0, 3 - math.floor(math.log10(last))), 12) if last > 0 else 4
    return [f"{value:.{decimals}f}" if math.isfinite(value) else "failed" for value in values]


def _figure(fitted: list[float], held_out: list[float]) -> Markup:
    count = len(fitted)
    row = max(9.0, min(30.0, 300 / count))
    height = svg.TOP + svg.BOTTOM + row * count
    axes = svg.Axes((0, svg.reach([*fitted, *held_out])), (0, count), height=height)
    parts = [axes.drawn("RMS, px", "fold", y_ticks=[])]
    places = [svg.TOP + (n + 0.5) * row for n in range(count)]
    for n, (y, one, other) in enumerate(zip(places, fitted, held_out, strict=True), start=1):
        if row > 13:
            parts.append(svg.text(svg.LEFT - 6, y + 4, str(n), "end", "tick"))
        if math.isfinite(one + other):
            parts.append(svg.line(axes.x(one), y, axes.x(other), y, "faint"))
    finite = [n for n in range(count) if math.isfinite(fitted[n] + held_out[n])]
    parts.append(svg.dots([(axes.x(fitted[n]), places[n]) for n in finite], "large faint"))
    parts.append(svg.dots([(axes.x(held_out[n]), places[n]) for n in finite], "large"))
    label = f"RMS of {count} folds, fitted and held out"
    keys = svg.key(("dot-faint", "views of the fit"), ("dot", "views held out"))
    caption = "One line a fold. The held-out dot should not lie far to the right of the other."
    return svg.figure(svg.picture(axes.width, axes.height, label, *parts) + keys, caption)
