"""This package's own JSON: any batch of cameras, or a whole calibration with its corners and its covariance.

    {"format": "diffproj camera", "version": 1,
     "camera": {"dtype", "size", "K", "R", "t", "lens": {"model", "coefficients"}},
     "calibration": {"R", "t", "points", "pixels", "visible", "used", ..., "covariance", "other_poses"}}

`calibration` is there only where a whole calibration was saved. Numbers are written so that they come back exactly.
JSON has neither NaN nor infinity: `null` stands for NaN.
"""

import json
import math
import re
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from diffproj.calibration.ambiguity import OtherPoses
from diffproj.calibration.covariance import Covariance
from diffproj.calibration.result import Calibration
from diffproj.geometry.camera import Camera
from diffproj.lens.models import KINDS, coefficients_of
from diffproj.targets.views import Views

T = TypeVar("T")
SUFFIXES: tuple[str, ...] = (".json",)
KIND, VERSION = "diffproj camera", 1
"""What every file says of itself."""


def dumps(path: Path, item: Camera | Calibration) -> str:
    """A camera or a calibration as the text of a file.

    Raises:
        ValueError: a lens of another library.
    """
    camera = item.camera if isinstance(item, Calibration) else item
    document = {"format": KIND, "version": VERSION, "camera": _camera_fields(path, camera)}
    if isinstance(item, Calibration):
        document["calibration"] = _calibration_fields(item)
    return _readable(json.dumps(_without_nan(document), indent=1, allow_nan=False))


def read_camera(path: Path) -> Camera:
    """The camera of a file; of a calibration, the one without a pose.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no camera file of this package, or damaged.
    """
    return _camera(path, _document(path)["camera"])


def read_calibration(path: Path) -> Calibration | None:
    """The calibration in a file; `None` where it holds a camera alone.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no camera file of this package, or damaged.
    """
    document = _document(path)
    if "calibration" not in document:
        return None
    camera = _camera(path, document["camera"])
    try:
        found = document["calibration"]
        R, t, points, pixels = (_tensor(found[key], torch.float64) for key in ("R", "t", "points", "pixels"))
        visible = torch.tensor(found["visible"], dtype=torch.bool, device="cpu")
        views = Views(pixels, visible, found["names"], _size(found["size"]))
        used, rejected = (torch.tensor(found[key], dtype=torch.bool, device="cpu") for key in ("used", "rejected"))
        status, iterations = (torch.tensor(found[key], device="cpu") for key in ("status", "iterations"))
        bow = None if found["bow"] is None else _tensor(found["bow"], torch.float64)
        posed = camera if not camera.batch_shape else camera[..., None]
        covariance = None if found["covariance"] is None else Covariance.from_fields(found["covariance"])
        others = _other_poses(found.get("other_poses"))  # unknown in a file of an earlier version
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
            skew=found.get("skew", False),
            shares=_later(found.get("shares")),
            degrees_of_freedom=_later(found.get("degrees_of_freedom")),
            lens_region=_later(found.get("lens_region")),
            _covariance=None if covariance is None else partial(_same, covariance),
            _others=None if others is None else partial(_same, others),
            _remarks=partial(_same, tuple(found["remarks"])) if "remarks" in found else None,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: the calibration in this file is damaged ({error})") from error


def _camera_fields(path: Path, camera: Camera) -> dict[str, Any]:
    lens = camera.distortion
    try:
        coefficients = coefficients_of(lens, camera.t)
    except TypeError:
        raise ValueError(f"{path}: distortion: want one of {', '.join(KINDS)}, got {type(lens).__name__}") from None
    return {
        "dtype": str(camera.dtype).removeprefix("torch."),
        "size": camera.size,
        "K": camera.K.tolist(),
        "R": camera.R.tolist(),
        "t": camera.t.tolist(),
        "lens": None if lens is None else {"model": type(lens).__name__, "coefficients": coefficients.tolist()},
    }


def _calibration_fields(item: Calibration) -> dict[str, Any]:
    return {
        "rms": item.rms.tolist(),
        "status": item.status.tolist(),
        "iterations": item.iterations.tolist(),
        "objective": item.objective,
        "skew": item.skew,
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
        "remarks": item.remarks,
        "pixel_sigma": None if item.pixel_sigma is None else item.pixel_sigma.tolist(),
        "shares": None if item.shares is None else item.shares.tolist(),
        "covariance": item.covariance_of_kept_poses.to_fields() if item.has_covariance else None,
        "other_poses": _other_fields(item.other_poses) if item.has_alternatives else None,
        "degrees_of_freedom": None if item.degrees_of_freedom is None else item.degrees_of_freedom.tolist(),
        "lens_region": None if item.lens_region is None else item.lens_region.tolist(),
    }


def _other_fields(others: OtherPoses) -> dict[str, Any]:
    """The other poses, `null` for an infinite ratio."""
    return {"likelihood_ratio": others.ratio.tolist(), "R": others.R.tolist(), "t": others.t.tolist()}


def _other_poses(fields: dict[str, Any] | None) -> OtherPoses | None:
    if fields is None:
        return None
    R, t, ratio = (_tensor(_with_nan(fields[key]), torch.float64) for key in ("R", "t", "likelihood_ratio"))
    return OtherPoses(R, t, torch.where(ratio.isnan(), torch.inf, ratio))


def _later(values: Any) -> Tensor | None:
    """A field that files of earlier releases lack."""
    return None if values is None else _tensor(_with_nan(values), torch.float64)


def _same(known: T) -> T:
    """What a calibration calls for what it computes late; a function of the module, so that it can be pickled."""
    return known


def _without_nan(value: Any) -> Any:
    """The same with `None` for numbers that are not finite, which JSON does not have."""
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


def _document(path: Path) -> dict[str, Any]:
    """What is in a file, known to be one of this package and of this version."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: want a JSON file, got something else ({error})") from error
    if not isinstance(document, dict) or document.get("format") != KIND or "camera" not in document:
        raise ValueError(f"{path}: want a camera file of diffproj, got another JSON file")
    if document.get("version") != VERSION:
        raise ValueError(f"{path}: want version {VERSION}, got {document.get('version')}; a newer diffproj reads it")
    return document


def _camera(path: Path, fields: dict[str, Any]) -> Camera:
    try:
        dtype = {"float32": torch.float32, "float64": torch.float64}[fields["dtype"]]
        K, R, t = (_tensor(fields[key], dtype) for key in ("K", "R", "t"))
        lens = fields["lens"]
        distortion = lens and KINDS[lens["model"]](_tensor(lens["coefficients"], dtype))
        return Camera(K, R, t, distortion, _size(fields["size"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: the camera in this file is damaged ({error})") from error


def _size(size: list[int] | None) -> tuple[int, int] | None:
    return None if size is None else (size[0], size[1])


def _tensor(numbers: Any, dtype: torch.dtype) -> Tensor:
    return torch.tensor(numbers, dtype=dtype, device="cpu")
