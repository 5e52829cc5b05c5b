"""What `diffproj locate` found: one JSON document, in which what is not known is `None`, and tables for people."""

import argparse
import math
import textwrap
from typing import Any

from rich.markup import escape
from rich.table import Table

from diffproj._core.shown import plain
from diffproj.calibration.evidence.adjustment import mounting_covariance
from diffproj.calibration.results.calibration import Calibration
from diffproj.cli.assumed_camera import Assumed
from diffproj.cli.landmarks_file import Surveyed
from diffproj.cli.terminal import RESULTS, aligned, counted, in_words, known, result, rounded
from diffproj.cli.units import heading

MOUNTING = ("tilt", "roll", "heading", "x", "y", "z")
"""In the order of the covariance of a mounting."""

ANGLES = MOUNTING[:3]
LEVEL = 0.1
"""Relief, as a part of their extent, below which landmarks lie on a ground."""

FEW = 8
"""Degrees of freedom below which they are told."""

BELOW = (
    "The camera is on the side of the landmarks to which z decreases. If z points up, x and y are exchanged: x is east "
    "or right, y north or ahead. If not, tilt, roll and heading are those of a world that is upside down."
)
IN_WORDS = {
    "tilt": "tilt, degrees below the horizon",
    "roll": "roll, degrees",
    "heading": "heading, degrees from y to x",
}


def document(
    options: argparse.Namespace,
    found: Calibration,
    surveyed: Surveyed,
    free: tuple[str, ...],
    calibrated: bool,
    assumed: Assumed | None,
) -> dict[str, Any]:
    """Everything that was found.

    Args:
        options: of the command.
        found: the camera at its place.
        surveyed: the landmarks.
        free: names of the intrinsics that were found along.
        calibrated: whether the camera file holds a calibration.
        assumed: of the camera, where there is no file.
    """
    camera = found.cameras[0]
    mounting = camera.mounting()
    values = (mounting.tilt, mounting.roll, mounting.heading, *mounting.position, mounting.height)
    held = {one.name for one in options.fixed}
    held = {"z" if name == "height" else name for name in held}
    spread = mounting_covariance(found).diagonal().clamp(min=0).sqrt()
    where = {
        name: {"value": float(value), "deviation": 0.0 if name in held else known(float(deviation))}
        for name, value, deviation in zip(MOUNTING, values, spread, strict=True)
    }
    intrinsics = {
        name: {"value": float(value), "deviation": known(float(found.covariance.deviations[name]))}
        for name, value in zip(found.parameters.names, found.shared, strict=True)
        if name in free
    }
    rows = _landmarks(found, surveyed)
    used = [row for row in rows if row["used"]]
    includes = ["pixels", "landmarks"] if surveyed.landmarks.covariances is not None else ["pixels"]
    includes += ["priors"] if options.prior else []
    return {
        "camera": None if options.camera is None else str(options.camera),
        "assumed": None if assumed is None else assumed.told(),
        "photograph": None if options.photograph is None else str(options.photograph),
        "landmarks_file": str(options.landmarks),
        "view": found.views.names[0],
        "unit": found.unit,
        "crs": surveyed.crs,
        "position": {axis: where[axis] for axis in "xyz"},
        "mounting": {name: where[name] for name in ANGLES},
        "intrinsics": intrinsics,
        "priors": {one.name: {"value": one.value, "deviation": one.deviation} for one in options.prior},
        "fixed": {one.name: one.value for one in options.fixed},
        "rms": float(found.rms),
        "pixel_sigma": None if found.pixel_sigma is None else known(float(found.pixel_sigma)),
        "degrees_of_freedom": None if found.degrees_of_freedom is None else known(float(found.degrees_of_freedom)),
        "deviations_include": includes + (["camera"] if calibrated and not free and found.knows_intrinsics else []),
        "landmarks": rows,
        "worst": max(used, key=lambda row: row["off"])["name"],
        "remarks": [BELOW] if _from_below(found) else [],
        "message": in_words(found.message, found.unit),
        "verdict": in_words(found.verdict, found.unit),
    }


def _from_below(found: Calibration) -> bool:
    """Whether level ground is seen from where z decreases: so it looks where x and y were exchanged."""
    points = found.points
    size = points.amax(0) - points.amin(0)
    return bool(size[2] < LEVEL * size[:2].amax()) and bool(found.cameras[0].center[2] < points[:, 2].mean())


def _landmarks(found: Calibration, surveyed: Surveyed) -> list[dict[str, Any]]:
    projected, valid = found.cameras[0].project(found.points)
    off = projected - surveyed.pixels
    columns = (found.points, surveyed.pixels, off, valid, found.used[0], found.rejected[0])
    rows = []
    for name, point, pixel, residual, seen, used, rejected in zip(
        surveyed.landmarks.names, *(column.tolist() for column in columns), strict=True
    ):
        shown = math.isfinite(pixel[0])
        both = shown and seen
        rows.append(
            {
                "name": name,
                "world": point,
                "pixel": pixel if shown else None,
                "residual": residual if both else None,
                "off": math.hypot(*residual) if both else None,
                "used": used,
                "rejected": rejected,
            }
        )
    return rows


def say(told: dict[str, Any]) -> None:
    """Print what was found."""
    count = sum(row["used"] for row in told["landmarks"])
    result(f"{told['view']}: {counted(count, 'landmark')}, RMS {told['rms']:.4g} px\n")
    RESULTS.print(_camera_table(told))
    result("")
    RESULTS.print(_landmarks_table(told))
    worst = next(row for row in told["landmarks"] if row["name"] == told["worst"])
    if worst["off"] > 0.0:
        result(f"\nFarthest off: {worst['name']}, {worst['off']:.3g} px")
    if told["crs"] is not None:
        said = (
            f"x and y are metres east and north on the map {told['crs']}, which latitudes and longitudes became; in a "
            "UTM zone lengths differ by up to 0.1 % from those on the ground."
        )
        result("\n" + textwrap.fill(said, 79))
    for remark in told["remarks"]:
        result("\n" + textwrap.fill(remark, 79))
    result("\n" + textwrap.fill(told["verdict"], 79))
    if told["assumed"] is not None:
        result(textwrap.fill(told["assumed"]["text"], 79))
    result(textwrap.fill(_about_deviations(told), 79))


def _camera_table(told: dict[str, Any]) -> Table:
    unit = heading(told["unit"]) or "the landmarks' unit"
    rows = {f"{axis}, {unit}": told["position"][axis] for axis in "xyz"}
    rows |= {IN_WORDS[name]: told["mounting"][name] for name in ANGLES}
    rows |= {_title(name): found for name, found in told["intrinsics"].items()}
    pairs = [_shown(row["value"], row["deviation"]) for row in rows.values()]
    table = Table(title="The camera, if z points up", title_justify="left")
    table.add_column("")
    table.add_column("value", no_wrap=True)
    table.add_column("standard deviation", no_wrap=True)
    for name, *pair in zip(rows, *(aligned(column) for column in zip(*pairs, strict=True)), strict=True):
        table.add_row(name, *pair)
    return table


def _shown(value: float, deviation: float | None) -> tuple[str, str]:
    return (plain(value), "fixed") if deviation == 0 else rounded(value, math.inf if deviation is None else deviation)


def _title(name: str) -> str:
    titles = {"f": f"focal length {name}, px", "c": f"principal point {name}, px"}
    return titles.get(name[0], f"lens {name}")


def _landmarks_table(told: dict[str, Any]) -> Table:
    table = Table(title="Landmarks: projected minus seen", title_justify="left")
    table.add_column("landmark", overflow="fold")
    for name in ("pixel u, v", "off by u, v in px", "together"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in told["landmarks"]:
        if row["pixel"] is None:
            cells = "not seen", "", ""
        elif row["residual"] is None:
            cells = "{:.6g}, {:.6g}".format(*row["pixel"]), "outside of the lens", ""
        else:
            (u, v), (du, dv) = row["pixel"], row["residual"]
            cells = f"{u:.6g}, {v:.6g}", f"{du:+.2f}, {dv:+.2f}", f"{row['off']:.2f}"
        table.add_row(escape(row["name"]), *cells[:2], cells[2] + " rejected" * row["rejected"])
    return table


def _about_deviations(told: dict[str, Any]) -> str:
    freedom, sigma = told["degrees_of_freedom"], told["pixel_sigma"]
    noise = f"{sigma:.2g} px for each landmark" if sigma is not None else "that of each landmark"
    if freedom is not None:
        noise += ", as the residuals tell" + (
            f" from {counted(round(freedom), 'degree')} of freedom only" if freedom < FEW else ""
        )
    survey = ", the landmarks' own deviations" if "landmarks" in told["deviations_include"] else ""
    priors = told["priors"].keys() - (told["assumed"] or {"priors": ()})["priors"]
    survey += ", what --prior says" if priors else ""
    if told["assumed"] is not None:
        return (
            f"The deviations hold the noise of the pixels ({noise}){survey} and how far what is assumed may be off as "
            "said, but NOT pixels that are not square, or a lens that bends otherwise."
        )
    if "camera" in told["deviations_include"]:
        return f"The deviations hold the noise of the pixels ({noise}){survey} and how surely the camera is known."
    return (
        f"The deviations hold the noise of the pixels ({noise}){survey}, but NOT how surely the rest of the camera is "
        "known: the truth may lie further off."
    )
