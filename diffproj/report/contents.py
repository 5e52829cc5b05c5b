"""What a report holds, in its order, and what stands above it."""

import warnings
from collections.abc import Iterable

import torch

from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.validation import CrossValidation
from diffproj.geometry.plane import Plane
from diffproj.report.accuracy import accuracy_part
from diffproj.report.coverage import coverage_part
from diffproj.report.document import Part, document, render
from diffproj.report.facts import Facts
from diffproj.report.folds import folds_part
from diffproj.report.lens import lens_part, lens_title
from diffproj.report.measuring import measuring_part
from diffproj.report.parameters import parameters_part
from diffproj.report.photographs import photographs_part
from diffproj.report.pictures import Pictures, pictures
from diffproj.report.residuals import residuals_part
from diffproj.report.shape import shape_part
from diffproj.report.usage import usage_part
from diffproj.report.verdict import verdict_part
from diffproj.targets.images import Orientation, Source
from diffproj.targets.target import Target
from diffproj.targets.videos import Frame


def contents(
    calibration: Calibration,
    photographs: Source | Iterable[Source] | Pictures | None,
    folds: CrossValidation | int | None,
    target: Target | None,
    orientation: Orientation,
    title: str,
    camera_file: str,
) -> str:
    """The whole page; the arguments are those of `write_report`, checked.

    Raises:
        ValueError: the photographs are not those of the views, or no size is known.
    """
    views, size = calibration.views, calibration.views.size or calibration.camera.size
    if isinstance(photographs, Pictures):
        found = photographs
    else:
        corners = views.pixels.detach().to("cpu", torch.float64).numpy()
        found = pictures(photographs, views.names, corners, size, orientation)
    if found.size is None:
        raise ValueError(
            "calibration: want one whose image size is known, got none; give views a size, dp.Views(pixels, "
            "size=(width, height)), or the photographs"
        )
    facts = Facts(calibration, found.size)
    with warnings.catch_warnings():  # what is to be known is in the report
        warnings.simplefilter("ignore", UserWarning)
        parts = [
            verdict_part(facts),
            photographs_part(facts, found),
            residuals_part(facts),
            coverage_part(facts),
            lens_part(facts),
            parameters_part(facts),
            accuracy_part(facts),
            shape_part(facts),
            folds_part(facts, folds, target),
            usage_part(facts, camera_file),
            *_measuring(facts, found, orientation),
        ]
    return document(title, parts, _lead(facts))


def _measuring(facts: Facts, found: Pictures, orientation: Orientation) -> list[Part]:
    """The page that measures, in the photograph whose distance is the usual one; none without it."""
    view = facts.usual_view
    if view not in found.sources or not (facts.converged and facts.planar and facts.seen_views):
        return []
    plane = Plane.z(facts.plane_z)
    source, name = found.sources[view], facts.names[view]
    if isinstance(source, Frame):  # as its corners were counted; pixels alone are not turned any more
        source = source.upright if orientation == "upright" else source.image
    return [measuring_part(source, facts.calibration, plane, view, orientation=orientation, name=name)]


def _lead(facts: Facts) -> str:
    """The line below the title."""
    width, height = facts.size
    points = int(facts.used.sum())
    return render(
        "lead.html",
        views=len(facts.seen_views),
        points=f"{points} {facts.thing}{'s' * (points != 1)}",
        width=width,
        height=height,
        lens=lens_title(facts),
    )
