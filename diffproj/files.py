"""Camera files: OpenCV's YAML, and an own JSON that holds a whole calibration.

| format | suffix | holds |
|---|---|---|
| `"opencv"` | `.yml`, `.yaml`, `.xml` | one camera: K, lens, size; of a calibration also the views' poses and errors |
| `"json"` | `.json` | any batch of cameras with pose, dtype and lens; of a calibration also the corners and the board |

The YAML has the keys that OpenCV's own calibration program writes (`camera_matrix`, `distortion_coefficients`,
`image_width`, `extrinsic_parameters`, ...), and files from there are read. What a format cannot hold is refused, and a
file is written whole or not at all.
"""

import json
import math
import os
import re
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._atomic import write_whole
from diffproj.board import Views
from diffproj.calibration import Calibration, Covariance
from diffproj.camera import Camera, as_camera
from diffproj.lens import BrownConrady, KannalaBrandt

Format = Literal["opencv", "json"]

JSON_FORMAT = "diffproj camera"
JSON_VERSION = 1

_SUFFIXES: dict[str, Format] = {".yml": "opencv", ".yaml": "opencv", ".xml": "opencv", ".json": "json"}
_LENSES = {"BrownConrady": BrownConrady, "KannalaBrandt": KannalaBrandt}

PathLike = str | os.PathLike[str]


def save_camera(path: PathLike, camera: Camera | PinholeCamera | Calibration, format: Format | None = None) -> None:  # noqa: A002
    """Save a camera or a calibration.

    Args:
        path: the file to write; its folder must exist.
        camera: what to save.
        format: `"opencv"` or `"json"`; by the suffix if left out.

    Raises:
        TypeError: it is neither a camera nor a calibration.
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
    path = Path(path)
    if _format(path, format) == "json":
        content = _readable(json.dumps(_without_nan(_json_document(camera)), indent=1, allow_nan=False))
    else:
        content = _opencv_document(path, camera)
    write_whole(path, content)


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
    if _format(path, format) == "json":
        return _camera_from_json(path, _read_json(path)["camera"])
    return _camera_from_opencv(path)


def load_calibration(path: PathLike) -> Calibration:
    """Load a whole calibration from the own JSON.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no JSON of this package, or holds a camera alone.
    """
    path = Path(path)
    if _format(path, None) != "json":
        raise ValueError(f"{path}: want a .json file, for OpenCV's formats hold no corners; load_camera reads them")
    document = _read_json(path)
    if "calibration" not in document:
        raise ValueError(f"{path}: want a calibration, got a camera alone; load_camera reads it")
    camera = _camera_from_json(path, document["camera"])
    try:
        found = document["calibration"]
        R, t, points, pixels = (_tensor(found[key], torch.float64) for key in ("R", "t", "points", "pixels"))
        visible = torch.tensor(found["visible"], dtype=torch.bool)
        views = Views(pixels, visible, found["names"], _size(found["size"]))
        used, rejected = (torch.tensor(found[key], dtype=torch.bool) for key in ("used", "rejected"))
        status, iterations = (torch.tensor(found[key]) for key in ("status", "iterations"))
        bow = None if found["bow"] is None else _tensor(found["bow"], torch.float64)
        posed = camera if not camera.batch_shape else camera[..., None]
        covariance = _covariance_from_fields(found["covariance"])
        return Calibration(
            camera,
            posed.at(R, t),
            views,
            points,
            used,
            rejected,
            status,
            iterations,
            bow,
            found["objective"],
            tuple(found["causes"]),
            None if found["pixel_sigma"] is None else _tensor(_with_nan(found["pixel_sigma"]), torch.float64),
            None if covariance is None else partial(_same, covariance),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: the calibration in this file is damaged ({error})") from error


def _format(path: Path, format: str | None) -> Format:  # noqa: A002
    if format is None:
        if path.suffix.lower() not in _SUFFIXES:
            raise ValueError(f"{path}: want a suffix of {', '.join(_SUFFIXES)}, or format='opencv' or 'json'")
        return _SUFFIXES[path.suffix.lower()]
    if format not in ("opencv", "json"):
        raise ValueError(f"format: want 'opencv' or 'json', got {format!r}")
    return format


# ------------------------------------------------------------------------------------------------------------- JSON


def _json_document(item: Camera | Calibration) -> dict[str, Any]:
    camera = item.camera if isinstance(item, Calibration) else item
    lens = camera.distortion
    if not (lens is None or (isinstance(lens, BrownConrady | KannalaBrandt) and type(lens).__name__ in _LENSES)):
        raise ValueError(f"distortion: want one of {', '.join(_LENSES)}, got {type(lens).__name__}")
    document: dict[str, Any] = {
        "format": JSON_FORMAT,
        "version": JSON_VERSION,
        "camera": {
            "dtype": str(camera.dtype).removeprefix("torch."),
            "size": camera.size,
            "K": camera.K.tolist(),
            "R": camera.R.tolist(),
            "t": camera.t.tolist(),
            "lens": None
            if lens is None
            else {"model": type(lens).__name__, "coefficients": lens.coefficients.tolist()},
        },
    }
    if isinstance(item, Calibration):
        document["calibration"] = {
            "rms": item.rms.tolist(),
            "status": item.status.tolist(),
            "iterations": item.iterations.tolist(),
            "objective": item.objective,
            "bow": None if item.bow is None else item.bow.tolist(),
            "R": item.cameras.R.tolist(),
            "t": item.cameras.t.tolist(),
            "points": item.points.tolist(),
            "names": item.views.names,
            "size": item.views.size,
            "pixels": item.views.pixels.tolist(),
            "visible": item.views.visible.tolist(),
            "used": item.used.tolist(),
            "rejected": item.rejected.tolist(),
            "causes": item.causes,
            "pixel_sigma": None if item.pixel_sigma is None else item.pixel_sigma.tolist(),
            "covariance": _covariance_fields(item),
        }
    return document


def _same(covariance: Covariance) -> Covariance:
    return covariance


def _covariance_fields(item: Calibration) -> dict[str, Any] | None:
    """The blocks of the covariance; what is infinite is 0 here and known by the masks, for JSON has no infinity."""
    if not item.has_covariance:
        return None
    known = item.covariance
    fields = {key: getattr(known, f"_{key}").tolist() for key in ("follow", "mixed", "alone")}
    fields |= {key: getattr(known, key).tolist() for key in ("undetermined", "undetermined_views")}
    shared = torch.where(known.shared.isfinite(), known.shared, 0.0)
    return {"names": known.names, "shared": shared.tolist(), **fields}


def _covariance_from_fields(fields: dict[str, Any] | None) -> Covariance | None:
    if fields is None:
        return None
    unknown, unknown_views = (
        torch.tensor(fields[key], dtype=torch.bool) for key in ("undetermined", "undetermined_views")
    )
    shared, *blocks = (_tensor(fields[key], torch.float64) for key in ("shared", "follow", "mixed", "alone"))
    infinite = torch.diag_embed(torch.where(unknown, torch.inf, 0.0).to(shared))
    return Covariance(tuple(fields["names"]), shared + infinite, unknown, unknown_views, *blocks)


def _without_nan(value: Any) -> Any:
    """The same with `None` for what is no finite number, for JSON has only those."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _with_nan(value: Any) -> Any:
    """The same with NaN for `None`."""
    return [_with_nan(item) for item in value] if isinstance(value, list) else math.nan if value is None else value


def _readable(text: str) -> str:
    """Indented JSON with each innermost list on one line; a line break never stands inside a JSON string."""
    return re.sub(r"\[[^\[\]{}]*\]", lambda match: re.sub(r"\s*\n\s*", " ", match[0]), text) + "\n"


def _read_json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: want a JSON file, got something else ({error})") from error
    if not isinstance(document, dict) or document.get("format") != JSON_FORMAT or "camera" not in document:
        raise ValueError(f"{path}: want a camera file of diffproj, got another JSON file")
    if document.get("version") != JSON_VERSION:
        raise ValueError(
            f"{path}: want version {JSON_VERSION}, got {document.get('version')}; a newer diffproj reads it"
        )
    return document


def _camera_from_json(path: Path, fields: dict[str, Any]) -> Camera:
    try:
        dtype = {"float32": torch.float32, "float64": torch.float64}[fields["dtype"]]
        K, R, t = (_tensor(fields[key], dtype) for key in ("K", "R", "t"))
        lens = fields["lens"]
        distortion = lens and _LENSES[lens["model"]](_tensor(lens["coefficients"], dtype))
        return Camera(K, R, t, distortion, _size(fields["size"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: the camera in this file is damaged ({error})") from error


def _size(size: list[int] | None) -> tuple[int, int] | None:
    return None if size is None else (size[0], size[1])


def _tensor(numbers: Any, dtype: torch.dtype) -> Tensor:
    return torch.tensor(numbers, dtype=dtype)


# ----------------------------------------------------------------------------------------------------- OpenCV's YAML


def _opencv_document(path: Path, item: Camera | Calibration) -> str:
    camera = item.camera if isinstance(item, Calibration) else item
    if camera.batch_shape:
        raise ValueError(
            f"{path}: OpenCV's formats hold one camera, got batch shape {tuple(camera.batch_shape)}; use .json"
        )
    K, dist, rvec, tvec = camera.to_opencv()
    if rvec.any() or tvec.any():
        raise ValueError(f"{path}: OpenCV's formats hold no pose; use .json, or save camera.without_pose()")
    suffix = path.suffix.lower() if path.suffix.lower() in (".xml", ".yml", ".yaml") else ".yml"
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    if camera.size is not None:
        storage.write("image_width", camera.size[0])
        storage.write("image_height", camera.size[1])
    storage.write("camera_matrix", K)
    storage.write("fisheye_model", int(isinstance(camera.distortion, KannalaBrandt)))
    if dist.size:
        storage.write("distortion_coefficients", dist.reshape(-1, 1))
    if isinstance(item, Calibration):
        _, _, rvecs, tvecs = item.cameras.to_opencv()
        storage.write("nframes", len(item.views))
        storage.write("extrinsic_parameters", np.concatenate([rvecs, tvecs], axis=-1))
        storage.write("avg_reprojection_error", float(item.rms))
        storage.write("per_view_reprojection_errors", item.view_rms.numpy().reshape(-1, 1))
    return storage.releaseAndGetString()


def _camera_from_opencv(path: Path) -> Camera:
    text = path.read_text(encoding="utf-8", errors="replace")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise ValueError(f"{path}: want a YAML or XML file that OpenCV reads, got something else") from error
    try:
        K, dist = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
        width, height = (int(storage.getNode(key).real()) for key in ("image_width", "image_height"))
        fisheye = bool(storage.getNode("fisheye_model").real())
    finally:
        storage.release()
    if K is None:
        raise ValueError(f"{path}: want the key camera_matrix, got a file without it")
    try:
        return Camera.from_opencv(K, dist, size=(width, height) if width and height else None, fisheye=fisheye)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
