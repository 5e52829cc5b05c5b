"""`diffproj locate`: where a camera stood, from surveyed landmarks and the pixels that show them."""

import argparse
import re
from dataclasses import replace
from typing import Any

from torch import Tensor

from diffproj.calibration.locate import locate
from diffproj.calibration.parametrisation import Parametrisation
from diffproj.calibration.refine import refine
from diffproj.calibration.result import Calibration, CalibrationError
from diffproj.cli.drawing import check_drawing, check_no_photograph, write_drawing
from diffproj.cli.inputs import check_not_the_same, check_writable, writing
from diffproj.cli.landmarks_file import Surveyed, read_landmarks
from diffproj.cli.locate_document import document, say
from diffproj.cli.photographs import one_photograph
from diffproj.cli.scene import check_size, loaded
from diffproj.cli.terminal import as_json, failure, result
from diffproj.files.save import save_camera
from diffproj.geometry.camera import Camera
from diffproj.targets.images import grey
from diffproj.targets.views import Views

FEWEST = 4
"""Landmarks that a pose needs."""


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    check_drawing(options.draw)
    if options.output is not None:
        check_writable("--output", options.output)
        check_not_the_same("--output", options.output, [options.camera, options.landmarks])
    if options.photograph is not None:
        check_no_photograph(options.draw, [options.photograph])
    camera, calibration = loaded(options.camera)
    surveyed = read_landmarks(options.landmarks)
    picture, size = None, camera.size
    if options.photograph is not None:
        picture = grey(one_photograph(options.photograph, options.orientation))
        size = picture.shape[1], picture.shape[0]
        check_size(camera, size, options.camera, options.photograph)
    if size is None and options.draw is not None:
        raise ValueError(f"--draw: want PHOTO, or the image's size in {options.camera}, got neither")
    view = options.photograph.name if options.photograph is not None else options.landmarks.stem
    found = _located(options, camera, calibration, surveyed, view, size)
    told = document(options, found, surveyed, _free(options, camera), calibration is not None)
    told["warnings"] = options.warned
    if options.draw is not None:
        from diffproj import figures  # here, for it loads matplotlib

        write_drawing(options.draw, figures.landmarks(found, 0, picture, f"{view}: RMS {float(found.rms):.3g} px"))
    if options.output is not None:
        with writing("--output", options.output):
            save_camera(options.output, found)
    if options.json:
        as_json(told)
        return 0
    say(told)
    for verb, path in (("Written", options.output), ("Drawn", options.draw)):
        if path is not None:
            result(f"{verb} to {path}")
    return 0


def _located(
    options: argparse.Namespace,
    camera: Camera,
    calibration: Calibration | None,
    surveyed: Surveyed,
    view: str,
    size: tuple[int, int] | None,
) -> Calibration:
    """The camera at its place.

    Raises:
        ValueError: the landmarks do not tell it.
    """
    path = options.landmarks
    visible = surveyed.pixels.isfinite().all(-1)
    count = int(visible.sum())
    if count < FEWEST:
        raise ValueError(f"--landmarks: want at least {FEWEST} with a pixel, got {count} in {path}")
    steps: dict[str, Any] = {"reject_outliers": options.reject_outliers, "pixel_sigma": _noise(options, surveyed)}
    try:
        views = Views(surveyed.pixels.unsqueeze(0), visible.unsqueeze(0), [view], size)
        if not options.free:
            found = locate(views, surveyed.landmarks, camera if calibration is None else calibration, **steps)
        else:
            free = _free(options, camera)
            fixed = [name for name in Parametrisation.of(camera).names if name not in free]
            start, tied = camera.without_pose(), "focal" in options.free
            found = refine(views, surveyed.landmarks, start, fixed=fixed, tied_focal=tied, **steps)
    except (ValueError, CalibrationError) as error:
        text = _in_words(failure(error), surveyed)
        raise ValueError(text if text.startswith("--") else f"{path}: {text}") from error
    return replace(found, unit=options.unit)


def _in_words(text: str, surveyed: Surveyed) -> str:
    """What the library says of the landmarks, with their names and the command's options."""
    text = re.sub("^(target|views): |^refine: ", "", text)
    text = re.sub(r"; fixed=\(.*$", "; or less in --free", text)
    names = surveyed.landmarks.names
    return re.sub(
        r"with (\d+) and (\d+) alike", lambda m: f"with {names[int(m[1])]!r} and {names[int(m[2])]!r} alike", text
    )


def _free(options: argparse.Namespace, camera: Camera) -> tuple[str, ...]:
    """The names of the intrinsics that are found along with the pose."""
    parameters = Parametrisation.of(camera)
    places = {place for name in options.free for place in parameters.positions("--free", name)}
    return tuple(parameters.names[place] for place in sorted(places))


def _noise(options: argparse.Namespace, surveyed: Surveyed) -> Tensor | float | None:
    """The standard deviation of each landmark's pixel, as far as it is known."""
    given = surveyed.pixel_sigma
    if given is None:
        return options.pixel_sigma
    lost = given.isnan() & surveyed.pixels.isfinite().all(-1)
    if bool(lost.any()) and options.pixel_sigma is None:
        name = surveyed.landmarks.names[int(lost.nonzero()[0])]
        raise ValueError(
            f"--landmarks: want a standard deviation in column 'pixel_sigma' for each landmark with a pixel, got none "
            f"for {name!r} in {options.landmarks}; or give --pixel-sigma for those without"
        )
    return given.nan_to_num(options.pixel_sigma or 1.0)
