"""`save_camera`: cameras and calibrations to files."""

from kornia.geometry.camera import PinholeCamera

from diffproj._core.arguments import file_path
from diffproj._core.atomic import write_whole
from diffproj.calibration.result import Calibration
from diffproj.files.formats import FormatName, PathLike, format_of
from diffproj.geometry.camera import Camera, as_camera


def save_camera(path: PathLike, camera: Camera | PinholeCamera | Calibration, format: FormatName | None = None) -> None:  # noqa: A002
    """Save a camera or a calibration.

    Args:
        path: the file to write; its folder must exist.
        camera: what to save.
        format: `"opencv"` or `"json"`; by the suffix if left out.

    Raises:
        TypeError: it is neither a camera nor a calibration, the path is none, or the format is no string.
        ValueError: unknown suffix or format, or something that the format cannot hold.
        OSError: the file cannot be written.

    Example:
        >>> import tempfile, diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dp.save_camera(f"{folder}/camera.json", calibration)
        ...     again = dp.load_calibration(f"{folder}/camera.json")
        >>> bool(again.rms == calibration.rms)
        True
    """
    if not isinstance(camera, Camera | PinholeCamera | Calibration):
        raise TypeError(f"camera: want dp.Camera or dp.Calibration, got {type(camera).__name__}")
    if isinstance(camera, PinholeCamera):
        camera = as_camera(camera)
    path = file_path("path", path)
    write_whole(path, format_of(path, format).dumps(path, camera))
