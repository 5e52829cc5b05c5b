"""`load`, `load_camera` and `load_calibration`: cameras and calibrations from files."""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from diffproj._core.arguments import called, file_path
from diffproj._core.warn import warn_caller
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.files import own_json, poses_beside
from diffproj.files.document import Document
from diffproj.files.formats import FormatName, PathLike, format_of
from diffproj.files.found import Found, NotOneCameraError
from diffproj.files.image_sizes import exchanged_sides, other_image, parts_of_the_image
from diffproj.geometry.camera import Camera

T = TypeVar("T")

DAMAGE = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
"""What a reader meets in a file that is not what it says; all become one `ValueError` that names the file."""


def load_camera(path: PathLike, format: FormatName | None = None, camera: str | int | None = None) -> Camera:  # noqa: A002
    """Load a camera; of a calibration, the camera without a pose.

    The formats are told apart by what is in the file; `diffproj.files` lists them with their conventions, which are
    turned into those of `Camera`. What is not understood to the last coefficient of the lens is refused, and so is a
    size that looks like height and width; a K that looks like that of another resolution is warned of.

    Args:
        path: the file to read.
        format: the format, where it is not to be told by the content: `"opencv"`, `"ros"`, `"json"`, ...
        camera: which one of several, by its name in the file or its number, counted from 0. Left out, several cameras
            are a batch where they have one lens model and one size.

    Returns:
        The camera; in float64, from this package's own JSON in the dtype it was saved in.

    Raises:
        TypeError: the path is none, the format is no string, or `camera` is neither a name nor a number.
        OSError: there is no such file, or it cannot be read.
        ValueError: the file is of no known format, is damaged, holds a lens that is none of this package's, or holds
            several cameras that make no batch; the message names the file and what to do.

    Example:
        >>> import tempfile, torch, diffproj as dp
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        ...     dp.save_camera(f"{folder}/camera.yaml", dp.Camera(K, size=(640, 480)))
        ...     dp.load_camera(f"{folder}/camera.yaml")
        Camera(f 500.0, 500.0 px, c 320.0, 240.0 px, pinhole, 640 x 480 px, no pose, torch.float64)
    """
    return _chosen(Document.read(file_path("path", path)), format, camera)


def _chosen(document: Document, format: FormatName | None = None, camera: str | int | None = None) -> Camera:  # noqa: A002
    """The camera of a file that is asked for."""
    found = found_in(document, format)
    try:
        return found.chosen(camera)
    except ValueError as error:
        raise _refusal(document, error) from error


def found_in(document: Document, format: FormatName | None = None) -> Found:  # noqa: A002
    """All cameras of a file.

    Raises:
        ValueError: as for `load_camera`.
    """
    try:
        with np.errstate(all="ignore"):  # a camera that is not finite is refused where it is built
            found = format_of(document, format).read(document)
        for one in found.cameras.values():
            _check_size(one, own=own_json.recognises(document))
    except DAMAGE as error:
        raise _refusal(document, error) from error
    for remark in (*found.remarks, *([poses_beside.remark(found.unread)] if found.unread else [])):
        warn_caller(f"{document.path}: {remark}")
    return found


def _check_size(camera: Camera, own: bool) -> None:
    """Refuse sides in the wrong order and a normalised K, and warn of that of another image; of the own file, warn.

    The own file keeps all that a camera holds.

    Raises:
        ValueError: the size looks like height and width, or K like parts of the image.
    """
    exchanged = exchanged_sides(camera)
    if exchanged and not own:
        raise ValueError(f"size: want width and height, got {camera.size}, {exchanged}; exchange them in the file")
    normalised = parts_of_the_image(camera)
    if normalised and not own:
        raise ValueError(normalised)
    doubt = f"size: {camera.size}, {exchanged}" if exchanged else normalised or other_image(camera)
    if doubt:
        warn_caller(doubt)


def load_calibration(path: PathLike, camera: str | None = None) -> Calibration:
    """Load a whole calibration from this package's own JSON; see `save_camera`.

    Args:
        path: the file to read.
        camera: the name of one camera, of the lines that `diffproj calibrate --fleet` wrote.

    Raises:
        TypeError: the path is none, or `camera` is no name.
        OSError: there is no such file, or it cannot be read.
        ValueError: the file is no JSON of this package, is damaged, holds a camera alone, or several cameras of which
            none is named, or none of that name.

    Example:
        >>> import tempfile, diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dp.save_camera(f"{folder}/camera.json", calibration)
        ...     again = dp.load_calibration(f"{folder}/camera.json")
        >>> again.summary() == calibration.summary()
        True
    """
    document = Document.read(file_path("path", path))
    if not isinstance(camera, str | None):
        raise TypeError(f"camera: want the name of a camera, got {called(camera)}")
    calibration = _own(document, partial(own_json.read_calibration, camera=camera))
    if calibration is None:
        raise ValueError(
            f"{path}: want a calibration as save_camera writes it to .json, got a file with cameras alone or a rig; "
            "load reads it"
        )
    return calibration


def load(path: PathLike, camera: str | None = None) -> Camera | Calibration | RigCalibration:
    """Load what a file holds: the whole calibration or rig where there is one, the camera otherwise.

    Args:
        path: the file to read.
        camera: the name of one camera where there are several: see `load_calibration` and `load_camera`.

    Raises:
        TypeError: the path is none, or `camera` is no name.
        OSError: there is no such file, or it cannot be read.
        ValueError: as for `load_camera`.
    """
    return content_of(Document.read(file_path("path", path)), camera)


def content_of(document: Document, camera: str | None = None) -> Camera | Calibration | RigCalibration:
    """What a file in hand holds; see `load`."""
    if not isinstance(camera, str | None):
        raise TypeError(f"camera: want the name of a camera, got {called(camera)}")
    found = None
    if camera is None or own_json.holds_fleet(document):
        found = _own(document, own_json.read_rig)
        found = found or _own(document, partial(own_json.read_calibration, camera=camera))
    return _chosen(document, camera=camera) if found is None else found


def _own(document: Document, read: Callable[[Document], T | None]) -> T | None:
    try:
        found = read(document) if own_json.recognises(document) else None
    except DAMAGE as error:
        raise _refusal(document, error) from error
    if isinstance(found, Calibration):
        _check_size(found.camera, own=True)
    return found


def _refusal(document: Document, error: Exception) -> ValueError:
    """One line that names the file and what is wrong with it."""
    said = " ".join(str(error).split())
    if isinstance(error, KeyError):
        said = f"want the key {said.strip(chr(39))}, got a file without it"
    elif not isinstance(error, ValueError):
        said = f"the file is damaged ({error!r})"
    kind = NotOneCameraError if isinstance(error, NotOneCameraError) else ValueError
    return kind(f"{document.path}: {said}")
