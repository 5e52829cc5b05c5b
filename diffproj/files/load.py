"""`load_camera` and `load_calibration`: cameras and calibrations from files."""

from pathlib import Path

from diffproj.calibration.result import Calibration
from diffproj.files import opencv, own_json
from diffproj.files.formats import Format, PathLike, named
from diffproj.geometry.camera import Camera


def load_camera(path: PathLike, format: Format | None = None) -> Camera:  # noqa: A002
    """Load a camera; of a calibration, the camera without a pose.

    Args:
        path: the file to read.
        format: as for `save_camera`.

    Returns:
        The camera; in float64 from OpenCV's formats, in the dtype it was saved in from JSON.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: unknown suffix or format, or the file is not what it should be.
    """
    path = Path(path)
    return (own_json if named(path, format) == "json" else opencv).read_camera(path)


def load_calibration(path: PathLike) -> Calibration:
    """Load a whole calibration from the own JSON.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no JSON of this package, or holds a camera alone.
    """
    path = Path(path)
    if named(path, None) != "json":
        raise ValueError(f"{path}: want a .json file, for OpenCV's formats hold no corners; load_camera reads them")
    return own_json.read_calibration(path)
