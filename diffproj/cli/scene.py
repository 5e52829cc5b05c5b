"""Where the camera stood: at a view that it was calibrated with, or before a board in a new photograph."""

import argparse
from dataclasses import dataclass
from pathlib import Path

import torch

from diffproj._core.warn import warn_caller
from diffproj.calibration.locate import locate
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.cli.photographs import one_photograph, search
from diffproj.cli.terminal import detail, progress_bars
from diffproj.cli.units import Length, agreed, heading
from diffproj.cli.which_board import given_board
from diffproj.files.found import NotOneCameraError
from diffproj.files.load import load
from diffproj.geometry.camera import Camera
from diffproj.targets.images import Photograph


@dataclass(frozen=True)
class Scene:
    """The camera at its pose.

    Attributes:
        camera_file: the camera's file.
        photograph: the photograph, where a new one was given, with its pixels.
        calibration: whose view it is.
        view: the number of the view.
        includes: whose uncertainty the standard deviations include: pixels, pose, camera.
        title: where the pose comes from, and how well it fits.
        square: the side of the board's squares; its unit is the world's. Without a board the unit alone counts.
        unit_in_words: the world's unit for headings, also where it is not known.
    """

    camera_file: Path
    photograph: Photograph | None
    calibration: Calibration
    view: int
    includes: tuple[str, ...]
    title: str
    square: Length
    unit_in_words: str

    @property
    def camera(self) -> Camera:
        """The camera at its pose."""
        return self.calibration.cameras[self.view]

    @property
    def has_landmarks(self) -> bool:
        """Whether the pose was found from landmarks and not from a board."""
        return self.calibration.landmarks is not None


def scene_of(options: argparse.Namespace) -> Scene:
    """Where the camera stood, as the options say.

    Raises:
        ValueError: as `stored_view` and `new_photograph`.
        OSError: a file cannot be read.
    """
    if options.view is not None:
        return stored_view(options)
    # A page shows it in colour: decoded so once, in which the detector's grey is at most one level off the file's own.
    in_colour = options.page is not None
    return new_photograph(options, one_photograph(options.photograph, options.orientation, in_colour))


def stored_view(options: argparse.Namespace) -> Scene:
    """The pose of a view that the camera was calibrated with.

    Raises:
        ValueError: the file holds no such view, or more than one, or no pose of it.
    """
    path, name = options.camera, options.view
    _, calibration = loaded(path)
    if calibration is None:
        raise ValueError(
            f"--view: want a .json with a whole calibration, got a camera without views in {path}; give a photograph "
            "with --board and --square"
        )
    number = posed_view(path, calibration, name, "give the photograph with --board and --square")
    includes = ("pixels", "pose") if calibration.has_covariance else ("pixels",)
    title = f"{path}: view {name}\nRMS {float(calibration.view_rms[number]):.4f} px"
    includes += ("camera",) if calibration.knows_intrinsics else ()
    square = _calibrated_square(calibration)
    return Scene(
        path, None, calibration, number, includes, title, square, heading(square.unit) or "the calibration's unit"
    )


def posed_view(path: Path, calibration: Calibration, name: str, otherwise: str = "write it in Python") -> int:
    """The number of the view of that name.

    Args:
        path: of the calibration's file.
        calibration: with its views.
        name: of one of them.
        otherwise: what to do where several have that name.

    Raises:
        ValueError: there is no such view, or more than one, or no pose of it.
    """
    names = calibration.views.names
    if name not in names:
        listed = ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")
        raise ValueError(f"--view: want a view of {path}, got {name!r}; it has {listed}")
    if names.count(name) > 1:
        raise ValueError(
            f"--view: want a name of one view, got {name!r}, which {names.count(name)} views of {path} have; "
            f"{otherwise}"
        )
    number = names.index(name)
    if not bool(calibration.used[number].any()):
        raise ValueError(f"--view: {name!r} was left out of the calibration in {path}, so its pose is not known")
    return number


def new_photograph(options: argparse.Namespace, photograph: Photograph) -> Scene:
    """The pose before the board in a new photograph.

    Args:
        options: of the command.
        photograph: with its pixels.

    Raises:
        ValueError: no board in it, another size than the camera's, or no pose that fits.
    """
    camera, calibration = loaded(options.camera)
    board, side, option = given_board(options)
    square = Length(_first_step(board.points), side.unit)
    if calibration is not None:
        square, doubt = agreed(square, _calibrated_square(calibration), options.camera, option)
        if doubt is not None:
            warn_caller(doubt)
    with progress_bars() as bars:
        views = search([photograph], board, bars, orientation=options.orientation).views
    check_size(camera, views.size, options)
    try:
        found = locate(views, board, camera if calibration is None else calibration)
    except CalibrationError as error:
        raise ValueError(
            f"{options.photograph}: no pose of the board explains its corners; check --camera and the board's options"
        ) from error
    includes = ("pixels", "pose")
    title = f"{options.photograph}: board found\nRMS {float(found.rms):.4f} px over {int(found.used.sum())} corners"
    if calibration is not None:
        title += f" ({float(calibration.rms):.4f} px in the calibration)"
        includes += ("camera",) if calibration.knows_intrinsics else ()
    unit = heading(square.unit) or f"the unit of {option}"
    return Scene(options.camera, photograph, found, 0, includes, title, square, unit)


def loaded(path: Path) -> tuple[Camera, Calibration | None]:
    """The one camera in a file, and the calibration where the file holds one.

    Raises:
        OSError: the file cannot be read.
        ValueError: it holds no camera, or several.
    """
    try:
        found = load(path)
    except NotOneCameraError as error:
        raise ValueError(
            f"--camera: want one camera, got a fleet in {path}; 'diffproj convert {path} one.json --camera NAME' "
            "takes one of them out, error bars and all"
        ) from error
    detail(f"{path}: read")
    if isinstance(found, RigCalibration):
        raise ValueError(  # noqa: TRY004
            f"--camera: want one camera, got a rig of {', '.join(found.names)} in {path}; diffproj convert "
            "--camera NAME takes one of them out, without error bars"
        )
    camera, calibration = (found.camera, found) if isinstance(found, Calibration) else (found, None)
    if camera.batch_shape:
        raise ValueError(f"--camera: want one camera, got {camera.batch_shape.numel()} side by side in {path}")
    return camera, calibration


def check_size(camera: Camera, size: tuple[int, int] | None, options: argparse.Namespace) -> None:
    """Check that a photograph has the size of the camera's images.

    Raises:
        ValueError: it has not.
    """
    if camera.size is None or camera.size == size:
        return
    (w, h), (width, height) = size or (0, 0), camera.size
    remedy = "take it with the camera as it was calibrated, and do not resize or crop it"
    if (h, w) == camera.size and options.orientation == "upright":
        remedy = (
            "the camera was calibrated on photographs as the sensor recorded them: leave out --orientation upright, "
            "with which EXIF data turn this one, or calibrate with it as well"
        )
    elif (h, w) == camera.size:
        remedy = (
            "it is turned against those that the camera was calibrated on: take one that is not, or give "
            "--orientation upright if EXIF data are what turned those"
        )
    raise ValueError(
        f"PHOTO: want {width} x {height} px as in {options.camera}, got {w} x {h} px in {options.photograph}; {remedy}"
    )


def _calibrated_square(calibration: Calibration) -> Length:
    """The side of the squares of the board that a camera was calibrated with: from its first corner to its second.

    Landmarks have no such side: only the unit counts.
    """
    return Length(_first_step(calibration.points), calibration.unit)


def _first_step(points: torch.Tensor) -> float:
    """The distance from the first point to the second."""
    return float(torch.linalg.vector_norm(points[1] - points[0]))
