"""What `diffproj measure` found, as tables and sentences for people."""

from typing import Any

from rich.markup import escape
from rich.table import Table

from diffproj._core.shown import plain
from diffproj.cli.scene import Scene
from diffproj.cli.terminal import RESULTS, aligned, result, rounded
from diffproj.cli.units import heading

ALL = 3
"""What deviations may hold: noise of pixels, pose and camera."""

EXACT, ROUNDED = 1e-9, 1e-13
"""Standard deviation, as a part of the point's largest one or of its largest coordinate, that is rounding error: the
plane alone says what such a coordinate is. On a map coordinates are millions of metres, and known to millimetres."""

NOISE = {
    "hand": "{} px for each pixel, as for points picked by hand (--pixel-sigma)",
    "option": "{} px for each pixel",
    "detector": "{} px for each pixel, as for those that the pose was found from",
}
"""The noise of the pixels that were measured, by where it comes from."""


def say(document: dict[str, Any], scene: Scene) -> None:
    """Print what was measured.

    Args:
        document: see `measure_document`.
        scene: the camera at its pose.
    """
    result(f"{scene.title}\n")
    RESULTS.print(_points_table(document, scene.unit_in_words))
    if document["lengths"]:
        result("")
        RESULTS.print(_lengths_table(document["lengths"], heading(scene.square.unit)))
    area = document["area"]
    if area is not None:
        value, deviation, interval = shown(area)
        unit = f" {scene.square.unit}²" if scene.square.unit else ""
        known = f"{value} ± {deviation}{unit}, 95 % interval {interval}"
        text = "not known, for not all points are on the plane" if area["value"] is None else known
        result(f"\nArea of the outline {area['name']}: {text}")
    doubts = doubtful(document)
    if document["remarks"] or doubts:
        result("")
    for remark in [*document["remarks"], *doubts]:
        RESULTS.print(remark, markup=False)
    result("")
    RESULTS.print(about_deviations(document), markup=False)


def doubtful(document: dict[str, Any]) -> list[str]:
    """A sentence on why no number is to be trusted, for results that are handed on without their warnings."""
    return [f"DOUBTFUL: {document['doubts']}"] if document["doubts"] else []


def about_deviations(document: dict[str, Any]) -> str:
    """What the deviations hold, and what they do not, in a sentence."""
    noise = NOISE[document["pixel_sigma_from"]].format(f"{document['pixel_sigma']:.2g}")
    sentence = {
        ALL: f"The deviations hold {noise}, and how surely the pose and the camera are known.",
        2: f"The deviations hold {noise} and how surely the pose is known, but NOT how surely the camera is, for its "
        "file does not tell: the truth may lie further off. A .json from 'diffproj calibrate' tells it.",
        1: f"The deviations hold {noise} ONLY, and not how surely the pose and the camera are known, for the file does "
        "not tell: the truth may lie further off. A .json from 'diffproj calibrate' tells it.",
    }
    return sentence[len(document["deviations_include"])]


def _points_table(document: dict[str, Any], unit: str) -> Table:
    title = f"Points on the plane {document['plane_in_words']}, in {unit}"
    table = Table(title=title, title_justify="left")
    table.add_column("point", justify="right" if all(row["name"].isdecimal() for row in document["points"]) else "left")
    table.add_column("pixel u, v", no_wrap=True)
    found = [row for row in document["points"] if row["valid"]]
    columns = []
    for axis, name in enumerate("xyz"):
        table.add_column(f"{name} ± deviation", no_wrap=True)
        pairs = [coordinate(row["world"], row["deviation"], axis) for row in found]
        starts = aligned([value for value, _ in pairs]) if pairs else []
        columns.append([start + rest for start, (_, rest) in zip(starts, pairs, strict=True)])
    cells = iter(zip(*columns, strict=True))
    for row in document["points"]:
        u, v = row["pixel"]
        table.add_row(escape(row["name"]), f"{u:g}, {v:g}", *(next(cells) if row["valid"] else ("none",) * 3))
    return table


def coordinate(world: list[float], deviations: list[float | None], axis: int) -> tuple[str, str]:
    """A coordinate, and what follows it: its standard deviation, or nothing where the plane alone determines it."""
    value, deviation = world[axis], deviations[axis]
    scale = max(map(abs, world))
    if deviation is None:
        return plain(value), " ± unknown"
    known = [each for each in deviations if each is not None]
    exact = max(EXACT * max(known), ROUNDED * scale)
    if deviation <= exact:
        return ("0" if abs(value) <= exact else plain(value)), ""
    text, spread = rounded(value, deviation)
    return text, f" ± {spread}"


def _lengths_table(lengths: list[dict[str, Any]], unit: str | None) -> Table:
    table = Table(title="Lengths" + (f" in {unit}" if unit else ""), title_justify="left")
    table.add_column("from, to", overflow="fold")
    for name in ("length", "standard deviation", "95 % interval"):
        table.add_column(name, no_wrap=True)
    rows = [shown(length) for length in lengths]
    values, deviations = (aligned(column) for column in zip(*((row[0], row[1]) for row in rows), strict=True))
    for length, value, deviation, (_, _, interval) in zip(lengths, values, deviations, rows, strict=True):
        table.add_row(escape(length["name"]), value, deviation, interval)
    return table


def shown(quantity: dict[str, Any]) -> tuple[str, str, str]:
    """A quantity, its standard deviation and its interval, all to the second digit of the standard deviation."""
    value, deviation, interval = quantity["value"], quantity["deviation"], quantity["interval_95"]
    if value is None:
        return "none", "", ""
    if deviation is None or interval is None:
        return plain(value), "unknown", "unknown"
    if deviation == 0:
        return plain(value), "0", ""
    low, high = ("" if bound is None else rounded(bound, deviation)[0] for bound in interval)
    return (*rounded(value, deviation), f"{low} to {high}" if high else f"from {low}")
