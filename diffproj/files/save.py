"""`save_camera`: cameras and calibrations to files."""

from kornia.geometry.camera import PinholeCamera

from diffproj._core.arguments import file_path
from diffproj._core.atomic import write_all_whole
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.files import rigs
from diffproj.files.formats import FormatName, PathLike, format_to_write
from diffproj.geometry.camera import Camera, as_camera


def save_camera(
    path: PathLike,
    camera: Camera | PinholeCamera | Calibration | RigCalibration,
    format: FormatName | None = None,  # noqa: A002
) -> None:
    """Save a camera, a calibration or a rig.

    A file is written whole or not at all. What a format cannot hold is refused, not dropped: a pose, a batch, skew, the
    last coefficients of a lens. This package's own JSON holds all, and whole calibrations and rigs. Of a calibration,
    the other formats hold the camera alone, without the world's unit and the error bars; OpenCV's also get the poses,
    with the unit as `world_unit`, and the RMS errors, for other programs: `load_camera` reads the camera. Of a rig,
    OpenCV's formats hold a pair, Kalibr's a chain of cameras, COLMAP's `rigs.txt` or `rigs.bin` a rig with its frames.

    Args:
        path: the file to write; its folder must exist.
        camera: what to save.
        format: one of those that `diffproj.files` lists as written; by the suffix if left out, `.json` for this
            package's own, `.yaml`, `.yml` and `.xml` for OpenCV's.

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
    if not isinstance(camera, Camera | PinholeCamera | Calibration | RigCalibration):
        raise TypeError(f"camera: want dp.Camera, dp.Calibration or a rig, got {type(camera).__name__}")
    if isinstance(camera, PinholeCamera):
        camera = as_camera(camera)
    one = camera.camera if isinstance(camera, Calibration) else camera
    if isinstance(one, Camera) and any(part.is_meta for part in one.tensors()):
        raise ValueError("camera: want values to write, got tensors on the device meta")
    path = file_path("path", path)
    try:
        contents = (
            rigs.write(path, camera, format)
            if isinstance(camera, RigCalibration)
            else (format_to_write(path, format).write(path, camera))
        )
    except ValueError as error:
        said = str(error)
        raise ValueError(said if said.startswith("format:") else f"{path}: {said}") from error
    write_all_whole(contents)
