"""The measuring page as a part of a document: fixed HTML, style and script, the photograph, the camera's numbers."""

import os
from pathlib import Path
from typing import Any, cast, get_args

import cv2
import numpy as np
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import called, choice
from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.camera import Camera
from diffproj.geometry.plane import Plane
from diffproj.measurement.choices import HAND_PX
from diffproj.measurement.default_plane import warn_if_far_from_landmarks
from diffproj.report.document import Part, asset, data_uri, json_block, shortened
from diffproj.report.measuring_model import as_one, measuring_model
from diffproj.targets.images import Orientation, Photograph, as_8_bit, decoded, grey, listed

SCRIPTS = ("lens", "camera", "statistics", "errors", "tools", "view", "plan", "panel", "page", "hands", "start")
"""The files of the page's script, in their order; the first four are its mathematics."""
SIDE = 2400
"""Pixels of the longer side of the embedded photograph; a larger one is reduced, its coordinates stay."""
QUALITY = 90
"""Of the embedded JPEG, of 100."""


def measuring_part(
    photograph: str | os.PathLike[str] | np.ndarray | Tensor,
    calibration: Calibration | Camera | PinholeCamera,
    plane: Plane | None = None,
    view: int | str | None = None,
    pixel_sigma: float | str = HAND_PX,
    *,
    unit: str | None = None,
    orientation: Orientation = "sensor",
    name: str | None = None,
) -> Part:
    """The page as a part of a document, which can have one of it.

    Args:
        photograph: as `write_measuring_page` takes it, and so are those that follow.
        calibration: see there.
        plane: see there.
        view: see there.
        pixel_sigma: see there.
        unit: see there.
        orientation: see there.
        name: what the photograph is called; the file's name, or the view's, if left out.
    """
    one, number = as_one(calibration, view)
    if plane is None and isinstance(one, Calibration):
        warn_if_far_from_landmarks(one, number)
    if unit is not None and not isinstance(unit, str):
        raise TypeError(f"unit: want a name such as 'mm', got {called(unit)}")
    found = _one(photograph)
    image = colour(found, cast(Orientation, choice("orientation", orientation, get_args(Orientation))))
    size = image.shape[1], image.shape[0]
    camera = one.camera if isinstance(one, Calibration) else one
    if camera.size is not None and camera.size != size:
        (w, h), (width, height) = size, camera.size
        raise ValueError(f"photograph: want {width} x {height} px, as the camera's images, got {w} x {h} px")
    jpeg, shown = embedded(image)
    if name is None:
        is_file = isinstance(photograph, str | os.PathLike)
        of_view = one.views.names[number] if isinstance(one, Calibration) else "a photograph"
        name = found.name if is_file else of_view
    name = shortened(name.encode(errors="replace").decode())  # file names need not be UTF-8
    known_unit = one.unit if isinstance(one, Calibration) and unit is None else unit
    data = {
        "name": name,
        "unit": known_unit,
        "size": size,
        "shown": shown,
        "model": measuring_model(one, number, plane, pixel_sigma),
    }
    return Part(f"Measure in {name}", "measuring-page", _html(data, jpeg), asset("measuring_page/page.css"), script())


def _one(photograph: Any) -> Photograph:
    """The photograph, checked to be one."""
    if isinstance(photograph, str | os.PathLike):
        if not Path(photograph).is_file():
            raise FileNotFoundError(f"photograph: no such file: {os.fspath(photograph)}")
    elif not isinstance(photograph, np.ndarray | Tensor):
        raise TypeError(f"photograph: want a file name, an array or a tensor, got {called(photograph)}")
    elif photograph.ndim > 3:
        raise ValueError(f"photograph: want one, got shape {tuple(photograph.shape)}")
    found = listed(photograph)
    if len(found) > 1:
        raise ValueError(f"photograph: want one, got {len(found)}")
    return found[0] if isinstance(found[0].source, Path) else found[0]._replace(label="photograph")


def _html(data: dict[str, Any], jpeg: bytes) -> str:
    picture = f'<img id="m-image" alt="" hidden src="{data_uri(jpeg, "image/jpeg")}">'
    return "\n".join([asset("measuring_page/page.html"), picture, str(json_block("measuring-data", data))])


def script() -> str:
    """The page's whole script: its files one after the other, in a scope of their own."""
    files = "\n".join(asset(f"measuring_page/{name}.js") for name in SCRIPTS)
    return f'(() => {{\n"use strict";\n{files}\n}})();'


def embedded(image: np.ndarray) -> tuple[bytes, tuple[int, int]]:
    """A photograph as JPEG for the page, reduced where it is large; and its size there."""
    height, width = image.shape[:2]
    share = min(1.0, SIDE / max(width, height))
    shown = max(1, round(width * share)), max(1, round(height * share))
    if share < 1:
        image = cv2.resize(image, shown, interpolation=cv2.INTER_AREA)
    done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise ValueError(f"photograph: want one that can be written as JPEG, got {width} x {height} px")
    return jpeg.tobytes(), shown


def colour(photograph: Photograph, orientation: Orientation = "sensor") -> np.ndarray:
    """A photograph as 8-bit, `(H, W, 3)` in BGR where it has colours, else `(H, W)` as the detector sees it."""
    source = photograph.source
    if isinstance(source, Path):
        image = decoded(source, orientation, colour=True)
        if image.dtype == np.uint8:
            return image
    if isinstance(source, np.ndarray) and source.dtype == np.uint8 and source.ndim == 3 and source.shape[2] >= 3:
        return np.ascontiguousarray(source[..., :3])
    return as_8_bit(grey(photograph, orientation))
