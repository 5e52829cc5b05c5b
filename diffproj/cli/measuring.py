"""`diffproj measure`: points, lengths and an area on a plane, with error bars, from pixels of a photograph."""

import argparse
import math
import textwrap
import warnings
from pathlib import Path
from typing import Any

import torch

from diffproj.cli.drawing import check_drawing, check_no_photograph, write_drawing
from diffproj.cli.inputs import DETECTOR, HAND
from diffproj.cli.measure_csv import as_csv
from diffproj.cli.measure_document import PixelNoise, document
from diffproj.cli.measure_page import check_page, write_page
from diffproj.cli.measure_plane import plane_of
from diffproj.cli.measure_tables import ALL, about_deviations, doubtful, say, shown
from diffproj.cli.photographs import warn_if_shown_turned
from diffproj.cli.points_file import Pixel, read_points
from diffproj.cli.scene import Scene, scene_of
from diffproj.cli.terminal import alert, as_json, result
from diffproj.measurement.choices import detector_noise
from diffproj.measurement.measure import measure
from diffproj.targets.images import grey

WIDE = 90
"""Characters in a line over a drawing."""


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    check_drawing(options.draw)
    if options.photograph is not None:
        check_no_photograph(options.draw, [options.photograph])
    check_page(options.page)
    given = _given_pixels(options)
    scene = scene_of(options)
    if given and options.photograph is not None:
        option = "--points" if options.points_file is None else "--points-file"
        exif = None if scene.photograph is None else scene.photograph.exif
        warn_if_shown_turned(options.photograph, options.orientation, option, exif)
    noise = _noise(options, scene)
    plane = plane_of(scene, options)
    sigma = DETECTOR if noise.source == DETECTOR else noise.sigma
    if options.page is not None:
        write_page(options, scene, plane, sigma)
        if not given:
            page = str(options.page)
            if options.json:
                as_json({"page": page, "warnings": options.warned})
            else:
                result(f"Written to {page}: open it in a browser")
            return 0
    pixels = torch.tensor([[pixel.u, pixel.v] for pixel in given], dtype=torch.float64, device="cpu")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "measure: pixel .* outside of the photograph")  # remarks tell it by name
        measured = measure(pixels, scene.calibration, plane, scene.view, sigma)
    found = document(scene, plane, noise, given, measured)
    found["warnings"] = options.warned
    if options.draw is not None:
        _draw(options.draw, scene, found)
    if options.json:
        as_json(found)
    elif options.csv:
        result(as_csv(found).rstrip())
        if len(found["deviations_include"]) < ALL:  # what a table has no place for
            alert(about_deviations(found))
    else:
        say(found, scene)
        if options.draw is not None:
            result(f"\nDrawn to {options.draw}")
        if options.page is not None:
            result(f"\nPage written to {options.page}")
    return 0


def _given_pixels(options: argparse.Namespace) -> list[Pixel]:
    """The pixels to measure, named by their numbers where they have no names."""
    if options.points_file is not None:
        return read_points(options.points_file)
    if options.points is None:
        return []
    return [Pixel(str(number), u, v) for number, (u, v) in enumerate(options.points, start=1)]


def _noise(options: argparse.Namespace, scene: Scene) -> PixelNoise:
    """The noise of the pixels: that of the option, or of points picked by hand."""
    if options.pixel_sigma is None:
        return PixelNoise(HAND, "hand")
    if options.pixel_sigma != DETECTOR:
        return PixelNoise(options.pixel_sigma, "option")
    known = detector_noise(scene.calibration, scene.view)
    if known is None or not math.isfinite(known):
        raise ValueError(f"--pixel-sigma: want a number of px, for {options.camera} does not tell the detector's noise")
    return PixelNoise(float(known), DETECTOR)


def _draw(path: Path, scene: Scene, found: dict[str, Any]) -> None:
    """Draw what was measured into the photograph."""
    from diffproj import figures  # here, for it loads matplotlib

    figure = figures.measured(
        scene.calibration,
        scene.view,
        [row["pixel"] for row in found["points"]],
        [row["name"] if row["valid"] else f"{row['name']} (not on the plane)" for row in found["points"]],
        [length_in_words(length, scene.square.unit) for length in found["lengths"]],
        photograph=None if scene.photograph is None else grey(scene.photograph),
        title="\n".join(
            [f"{found['view']}: {found['plane_in_words']}", *textwrap.wrap(" ".join(doubtful(found)), WIDE)]
        ),
    )
    write_drawing(path, figure)


def length_in_words(length: dict[str, Any], unit: str | None) -> str:
    """`199.9 ± 0.2 mm`, or `199.9 ± unknown mm`; empty where there is no length."""
    value, deviation, _ = shown(length)
    return "" if length["value"] is None else f"{value} ± {deviation}" + (f" {unit}" if unit else "")
