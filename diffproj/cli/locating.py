"""`diffproj locate`: where a camera stood, from surveyed landmarks and the pixels that show them."""

import argparse
import re
import warnings
from dataclasses import replace
from functools import partial
from typing import Any

from torch import Tensor

from diffproj._core.warn import warn_caller
from diffproj.calibration.evidence.adjust import adjust
from diffproj.calibration.evidence.adjusted_view import of_view
from diffproj.calibration.evidence.observations import Seen
from diffproj.calibration.locate import locate
from diffproj.calibration.problem.parametrisation import Parametrisation
from diffproj.calibration.refine import refine
from diffproj.calibration.results.ambiguity import AmbiguousPoseWarning
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.results.mismatch import CameraMismatchWarning
from diffproj.calibration.results.remark import Kind
from diffproj.cli.assumed_camera import Assumed, assumed_camera, contradicted
from diffproj.cli.drawing import check_drawing, check_no_photograph, write_drawing
from diffproj.cli.inputs import check_not_the_same, check_writable, writing
from diffproj.cli.known_beforehand import FOCAL, POSE
from diffproj.cli.known_camera import check_together, one_focal_length, posed, standing_near
from diffproj.cli.landmarks_file import Surveyed, read_landmarks
from diffproj.cli.locate_document import document, say
from diffproj.cli.photographs import one_photograph, warn_if_shown_turned
from diffproj.cli.scene import check_size, loaded
from diffproj.cli.terminal import as_json, failure, result, sentence
from diffproj.files.save import save_camera
from diffproj.geometry.camera import Camera
from diffproj.targets.exif import Exif, Told
from diffproj.targets.images import grey
from diffproj.targets.one_camera import told_of
from diffproj.targets.views import Views

FEWEST = 4
"""Landmarks that a pose needs."""
OPTIONS = {"priors": "--prior", "fixed": "--fixed", "pixel_sigma": "--pixel-sigma"}
"""Of the library, and what they are called here."""
TOLD = {Kind.TOLD_APART: CameraMismatchWarning, Kind.RIVAL: AmbiguousPoseWarning}
"""What is warned of here where `locate` would."""


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    if options.camera is None and options.fov is None:
        options.command_line.error("the following arguments are required: --camera, or --fov where there is no file")
    check_drawing(options.draw)
    if options.output is not None:
        check_writable("--output", options.output)
        read = [options.landmarks] if options.camera is None else [options.camera, options.landmarks]
        check_not_the_same("--output", options.output, read)
    if options.photograph is not None:
        check_no_photograph(options.draw, [options.photograph])
    picture, size, told_by_file, exif = None, None, (), Exif()
    if options.photograph is not None:
        photograph = one_photograph(options.photograph, options.orientation)
        picture, exif = grey(photograph), photograph.exif or exif
        told_by_file = (told_of(exif, options.orientation == "upright"),)
        size = picture.shape[1], picture.shape[0]
    camera, calibration, assumed = _camera(options, size, exif)
    surveyed = read_landmarks(options.landmarks, options.crs)
    unit = _unit(options.unit, surveyed)
    if options.photograph is not None:
        check_size(camera, size, options)
        pixels = f"the pixels in {options.landmarks}"
        warn_if_shown_turned(options.photograph, options.orientation, pixels, exif)
    size = size or camera.size
    if size is None and options.draw is not None:
        raise ValueError(f"--draw: want PHOTO, or the image's size in {options.camera}, got neither")
    view = options.photograph.name if options.photograph is not None else options.landmarks.stem
    found = replace(_located(options, camera, calibration, surveyed, view, size, told_by_file), unit=unit)
    for remark in found.findings[0]:
        if remark.kind == Kind.BELOW:
            warn_caller(f"{options.landmarks}: {remark.sentence}")
    against = () if assumed is None else contradicted(assumed, found)
    for one in against:
        warn_caller(f"{options.landmarks}: {one.sentence}")
    if against:  # the verdict, here and in the file, is to know of it
        found = replace(found, _remarks=partial(tuple, [(*found.findings[0], *against)]))
    told = document(options, found, surveyed, _free(options, camera), calibration is not None, assumed)
    told["remarks"] += [f"{sentence(one.sentence)}." for one in against]
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


def _unit(said: str | None, surveyed: Surveyed) -> str | None:
    """The unit of the world: metres where the landmarks were in degrees.

    Raises:
        ValueError: another is said.
    """
    if surveyed.crs is None:
        return said
    if said not in (None, "m"):
        raise ValueError(f"--unit: want m where landmarks have latitudes and longitudes, got {said}")
    return "m"


def _camera(
    options: argparse.Namespace, size: tuple[int, int] | None, exif: Exif
) -> tuple[Camera, Calibration | None, Assumed | None]:
    """The camera of the file, or of `--fov`: what is assumed of that one goes along with the priors.

    Raises:
        ValueError: options that do not go together.
    """
    if options.camera is not None:
        camera, calibration = loaded(options.camera)
        check_together(options.prior, options.fixed, camera)
        return camera, calibration, None
    if size is None:
        raise ValueError("--fov: want PHOTO beside it, whose size tells the focal length in px, got none")
    assumed = assumed_camera(options.fov, size, options.prior, options.free, exif)
    check_together(options.prior, options.fixed, assumed.camera)
    options.prior = [*options.prior, *assumed.priors]
    return assumed.camera, None, assumed


def _located(
    options: argparse.Namespace,
    camera: Camera,
    calibration: Calibration | None,
    surveyed: Surveyed,
    view: str,
    size: tuple[int, int] | None,
    told_by_file: tuple[Told, ...],
) -> Calibration:
    """The camera at its place.

    Raises:
        ValueError: the landmarks do not tell it.
    """
    path = options.landmarks
    visible = surveyed.pixels.isfinite().all(-1)
    count = int(visible.sum())
    _check_count(options, count)
    sigma = _noise(options, surveyed)
    if options.prior and sigma is None:
        option = "--prior" if options.fov is None else "--fov"
        raise ValueError(
            f"{option}: want --pixel-sigma beside it, or a column 'pixel_sigma', for it weighs against the pixels' "
            "noise"
        )
    steps: dict[str, Any] = {"reject_outliers": options.reject_outliers, "pixel_sigma": sigma}
    free = _free(options, camera)
    tied = one_focal_length(options.free, options.prior)
    priors = {one.name: (one.value, one.deviation) for one in options.prior}
    of_pose = [one for one in (*options.prior, *options.fixed) if one.name in POSE]
    target = surveyed.landmarks
    try:
        views = Views(surveyed.pixels.unsqueeze(0), visible.unsqueeze(0), [view], size, told_by_file)
        # Few landmarks and so many unknowns have minima that `refine` may end in; `adjust` looks for the lowest.
        if (of_pose and (free or count < FEWEST)) or (options.fov is not None and not options.reject_outliers):
            found = _adjusted(options, camera, calibration, surveyed, views, sigma, free, tied)
        elif of_pose:
            held = tuple(one.name for one in options.fixed)
            bare, known = camera.without_pose(), options.fixed
            start = posed(bare, known) if calibration is None else posed(calibration, known)
            found = locate(views, target, start, fixed=held, priors=priors or None, **steps)
        elif free:
            held = tuple(name for name in Parametrisation.of(camera).names if name not in free)
            steps |= {"fixed": held, "tied_focal": tied, "priors": priors or None}
            found = refine(views, target, camera.without_pose(), **steps)
        else:
            found = locate(views, target, camera if calibration is None else calibration, **steps)
    except (ValueError, CalibrationError) as error:
        text = _in_words(failure(error), surveyed)
        raise ValueError(text if text.startswith("--") else f"{path}: {text}") from error
    return found


def _adjusted(
    options: argparse.Namespace,
    camera: Camera,
    calibration: Calibration | None,
    surveyed: Surveyed,
    views: Views,
    sigma: Tensor | float | None,
    free: tuple[str, ...],
    tied: bool,
) -> Calibration:
    """The camera from landmarks and what is known of both its place and its lens, or from fewer than four of them.

    Raises:
        ValueError: options that do not go together.
        CalibrationError: they do not determine it.
    """
    if sigma is None:
        raise ValueError(
            "--fixed: want --pixel-sigma beside it where there are fewer than 4 landmarks, or --free, got none"
        )
    if options.reject_outliers:
        raise ValueError(
            "--reject-outliers: want 4 landmarks at least, and either what is known of the place or --free, got both"
        )
    start = camera.without_pose()
    if int(views.visible.sum()) >= FEWEST:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            start = locate(views, surveyed.landmarks, camera, throw=False).cameras[0]
    if not bool(start.t.isfinite().all()) or not bool((start.center != 0).any()):
        start = standing_near(camera, surveyed.landmarks.points)
    start = posed(start, [*options.prior, *options.fixed])
    freed = (*(name for name in free if name not in FOCAL[1:] or not tied), *(("focal",) if tied else ()))
    taken = {one.name for one in options.prior}
    adjusted = adjust(
        start if calibration is None else replace(calibration, camera=start),
        Seen(surveyed.landmarks, surveyed.pixels, pixel_sigma=sigma),
        priors={one.name: (one.value, one.deviation) for one in options.prior},
        fixed=tuple(one.name for one in options.fixed),
        free=tuple(name for name in freed if name not in taken),
        tied_focal=tied,
    )
    found = of_view(adjusted, views, surveyed.landmarks, sigma, calibration, held=not free)
    for remark in found.findings[0]:
        if remark.kind in TOLD:
            warn_caller(remark.sentence, TOLD[remark.kind])
    return found


def _check_count(options: argparse.Namespace, count: int) -> None:
    """Check that there are landmarks enough.

    Raises:
        ValueError: there are not.
    """
    least = 1 if any(one.name in POSE for one in (*options.prior, *options.fixed)) else FEWEST
    if count < least:
        fewer = "; fewer are enough with --prior or --fixed, such as height=6+-0.1" * (least > 1)
        raise ValueError(f"--landmarks: want at least {least} with a pixel, got {count} in {options.landmarks}{fewer}")


def _in_words(text: str, surveyed: Surveyed) -> str:
    """What the library says of the landmarks, with their names and the command's options."""
    text = re.sub("^(target|views): |^(refine|adjust): ", "", text)
    text = re.sub("^(priors|fixed|pixel_sigma): ", lambda m: f"{OPTIONS[m[1]]}: ", text)
    text = re.sub(r"; fix (\w+|some of them) or give a prior, as .*$", r"; tell \1 by --fixed or --prior", text)
    text = re.sub(
        r"; fix (\w+|some of them) or give (a narrower) prior, as .*$", r"; tell \1 by --fixed or \2 --prior", text
    )
    text = re.sub(r"; fixed=\(.*$", "; or less in --free", text)
    text = re.sub(r": start closer, or ", ": check the camera, or ", text)
    text = re.sub(r": fit --distortion .*$", ": tell more of the lens, as by --prior k1=-0.1+-0.05", text)
    names = surveyed.landmarks.names
    return re.sub(
        r"with (\d+) and (\d+) alike", lambda m: f"with {names[int(m[1])]!r} and {names[int(m[2])]!r} alike", text
    )


def _free(options: argparse.Namespace, camera: Camera) -> tuple[str, ...]:
    """The names of the intrinsics that are found along with the pose."""
    parameters = Parametrisation.of(camera)
    named = [*options.free, *(one.name for one in options.prior if one.name not in POSE)]
    named += ["focal"] if one_focal_length(options.free, options.prior) else []
    places = {place for name in named for place in parameters.positions("--free", name)}
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
