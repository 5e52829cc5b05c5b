"""`write_measuring_page`: one file in which anyone clicks lengths and areas in a photograph, with their deviations."""

import os

import numpy as np
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import file_path
from diffproj._core.atomic import write_whole
from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.camera import Camera
from diffproj.geometry.plane import Plane
from diffproj.measurement.choices import HAND_PX
from diffproj.targets.images import Orientation


def write_measuring_page(
    path: str | os.PathLike[str],
    photograph: str | os.PathLike[str] | np.ndarray | Tensor,
    calibration: Calibration | Camera | PinholeCamera,
    plane: Plane | None = None,
    view: int | str | None = None,
    pixel_sigma: float | str = HAND_PX,
    *,
    unit: str | None = None,
    orientation: Orientation = "sensor",
) -> None:
    """Write an HTML page in which anyone measures in a photograph, with the numbers of `measure`.

    The page is one file that needs no network and no Python: the camera, the inverse of its lens and the covariance are
    in its own script. Lengths, areas and angles come with deviations and 95 % intervals; a top view is beside them; the
    plane can be moved parallel to itself; all works by keys, too.

    A photograph with more than 2400 px on its longer side is reduced for display. Coordinates stay those of the
    original.

    Args:
        path: of the page; an existing one is replaced.
        photograph: a file, an array or a tensor, as `detect` takes them, of the size of the camera's images.
        calibration: as `measure` takes it: a calibration and the view whose photograph this is, what `locate` found, or
            a camera at its pose, whose own uncertainty is then not included.
        plane: to measure on at first; the board's face, z = 0, if left out.
        view: the number or the name of the view; may be left out where there is one only.
        pixel_sigma: how far off clicks are, in px, which the reader can change; or `"detector"`.
        unit: of the world, such as `"mm"`; the calibration's if left out.
        orientation: how the photograph's pixels are counted, as in `detect`.

    Raises:
        TypeError: an argument is of the wrong kind, or the lens of another package.
        ValueError: several photographs, cameras or planes, another size than the camera's, or no such view.
        OSError: a file cannot be read or written.

    Example:
        >>> import pathlib, tempfile
        >>> import diffproj as dp
        >>> board = dp.Chessboard()
        >>> calibration = dp.calibrate(dp.example_views("left"), board)
        >>> photograph = dp.synthetic.photograph(calibration.cameras[0], board)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     page = pathlib.Path(folder, "measure.html")
        ...     dp.write_measuring_page(page, photograph, calibration, view=0, unit="mm")
        ...     page.stat().st_size < 1_000_000
        True
    """
    where = file_path("path", path)
    from diffproj.report.document import document  # here, for they load Jinja2
    from diffproj.report.measuring import measuring_part

    part = measuring_part(photograph, calibration, plane, view, pixel_sigma, unit=unit, orientation=orientation)
    write_whole(where, document(part.title, [part]))
