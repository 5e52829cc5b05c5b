"""`load`, `load_camera` and `load_calibration`: cameras and calibrations from files."""

from pathlib import Path

from diffproj.calibration.result import Calibration
from diffproj.files import own_json
from diffproj.files.formats import FormatName, PathLike, format_of
from diffproj.geometry.camera import Camera


def load_camera(path: PathLike, format: FormatName | None = None) -> Camera:  # noqa: A002
    """Load a camera; of a calibration, the camera without a pose.

    Args:
        path: the file to read.
        format: as for `save_camera`.

    Returns:
        The camera; in float64 from OpenCV's formats, in the dtype it was saved in from JSON.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: unknown suffix or format, or the file is not what it should be.

    Example:
        >>> import tempfile, torch, diffproj as dp
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dp.save_camera(f"{folder}/camera.yaml", dp.Camera(torch.eye(3), size=(640, 480)))
        ...     dp.load_camera(f"{folder}/camera.yaml")
        Camera(f 1.0, 1.0 px, c 0.0, 0.0 px, pinhole, 640 x 480 px, no pose, torch.float64)
    """
    path = Path(path)
    return format_of(path, format).read_camera(path)


def load_calibration(path: PathLike) -> Calibration:
    """Load a whole calibration from this package's own JSON; see `save_camera`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no JSON of this package, or holds a camera alone.

    Example:
        >>> import tempfile, diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dp.save_camera(f"{folder}/camera.json", calibration)
        ...     again = dp.load_calibration(f"{folder}/camera.json")
        >>> again.summary() == calibration.summary()
        True
    """
    path = Path(path)
    if format_of(path) is not own_json:
        raise ValueError(f"{path}: want a .json file, for OpenCV's formats hold no corners; load_camera reads them")
    calibration = own_json.read_calibration(path)
    if calibration is None:
        raise ValueError(f"{path}: want a calibration, got a camera alone; load_camera reads it")
    return calibration


def load(path: PathLike) -> Camera | Calibration:
    """Load what a file holds: the whole calibration where there is one, the camera otherwise.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: unknown suffix, or the file is not what it should be.
    """
    path = Path(path)
    calibration = own_json.read_calibration(path) if format_of(path) is own_json else None
    return load_camera(path) if calibration is None else calibration
