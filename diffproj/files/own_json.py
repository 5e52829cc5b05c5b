"""This package's own JSON: any batch of cameras, a whole calibration with its corners and its covariance, or a rig.

    {"format": "diffproj camera", "version": 2,
     "camera": {"dtype", "size", "K", "R", "t", "lens": {"model", "coefficients"}},
     "calibration": {"rms", "R", "t", "points", "pixels", "visible", "used", ..., "covariance", "other_poses"}}

`calibration` is there only where a whole calibration was saved. A rig is of the format "diffproj rig", with `cameras`
by name, each at its place, and all else in `rig`. Numbers are written so that they come back exactly; `null` stands for
one that is not finite. Where a list would have thousands of numbers, they stand packed in it, as

    {"shape": [1000, 54, 2], "float64": "..."}          or "bool": base64 of little-endian numbers, row by row

which a thousand views load from in a fifth of the time. Version 1, without packed numbers, is read too. JSON lines
(`.jsonl`), as `diffproj calibrate --fleet` writes them, have such a document a line, with the `name` of its camera;
lines without a camera say why there is none. What a file says is checked: shapes against each other, ranges, and the
RMS against the corners.
"""

import base64
import binascii
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.files.document import Document
from diffproj.files.found import Found, NotOneCameraError
from diffproj.files.numbers import image_size
from diffproj.geometry.camera import Camera
from diffproj.lens.models import KINDS, coefficients_of

KIND, VERSION = "diffproj camera", 2
RIG = "diffproj rig"
"""What every file says of itself."""

MANY = 4096
"""Numbers in a list from which on they are packed."""

PACKED = {"float64": np.dtype("<f8"), "bool": np.dtype("bool")}
DAMAGE = (AttributeError, KeyError, OverflowError, TypeError, ValueError)
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def recognises(document: Document) -> bool:
    """Whether it calls itself a camera file of diffproj, a rig's, or a fleet's."""
    return document.mapping.get("format") in (KIND, RIG) or holds_fleet(document)


def holds_fleet(document: Document) -> bool:
    """Whether it has a camera a line, by name."""
    return bool(_fleet(document))


def holds_whole(document: Document) -> bool:
    """Whether it calls itself a calibration, a rig, or those of a fleet, and so has more than cameras; not read yet."""
    fields = document.mapping if recognises(document) else {}
    return holds_fleet(document) or fields.get("format") == RIG or fields.get("calibration") is not None


def write(path: Path, item: Camera | Calibration | RigCalibration) -> dict[Path, str]:
    """A camera, a calibration or a rig.

    Raises:
        ValueError: a lens of another library.
    """
    if isinstance(item, RigCalibration):
        cameras = {name: _camera_fields(camera) for name, camera in item.cameras.items()}
        whole = {"format": RIG, "version": VERSION, "cameras": cameras, "rig": item.to_fields()}
        return {path: _readable(json.dumps(_plain(whole), indent=1, allow_nan=False))}
    return {path: _readable(json.dumps(_plain(_fields(item)), indent=1, allow_nan=False))}


def plain_fields(item: Camera | Calibration, **more: Any) -> dict[str, Any]:
    """A camera or a calibration as plain numbers, texts, lists and dictionaries, with more keys in front."""
    return _plain(more | _fields(item))


def _fields(item: Camera | Calibration) -> dict[str, Any]:
    camera = item.camera if isinstance(item, Calibration) else item
    document = {"format": KIND, "version": VERSION, "camera": _camera_fields(camera)}
    if isinstance(item, Calibration):
        document["calibration"] = item.to_fields()
    return document


def read(document: Document) -> Found:
    """The camera of a file, a batch where it is one; of a calibration, the one without a pose; all of a rig.

    Raises:
        ValueError: it is no camera file of this package, or damaged.
    """
    if fleet := _fleet(document):
        return Found({name: _camera(_known(line)["camera"]) for name, line in fleet.items()})
    fields = _checked(document)
    if fields["format"] == RIG:
        return Found({name: _camera(camera) for name, camera in fields["cameras"].items()})
    return Found({"camera": _camera(fields["camera"])})


def read_rig(document: Document) -> RigCalibration | None:
    """The rig in a file; `None` where it holds none.

    Raises:
        ValueError: it is no file of this package, or damaged.
    """
    fields = {} if holds_fleet(document) else _checked(document)
    if fields.get("format") != RIG:
        return None
    try:
        cameras = {name: _camera(camera) for name, camera in fields["cameras"].items()}
        return RigCalibration.from_fields(_unpacked(fields["rig"]), cameras)
    except DAMAGE as error:
        raise ValueError(f"the rig in this file is damaged ({_said(error)})") from error


def read_calibration(document: Document, camera: str | None = None) -> Calibration | None:
    """The calibration in a file; `None` where it holds a camera alone.

    Args:
        document: the file.
        camera: the name of one camera of a fleet.

    Raises:
        ValueError: it is no camera file of this package, is damaged, or holds no such camera, or several.
    """
    fields = _chosen(document, camera)
    if fields["format"] == RIG or fields.get("calibration") is None:
        return None
    found = _camera(fields["camera"])
    try:
        return Calibration.from_fields(_unpacked(fields["calibration"]), found)
    except DAMAGE as error:
        raise ValueError(f"the calibration in this file is damaged ({_said(error)})") from error


def _said(error: Exception) -> str:
    return f"want the key {error.args[0]}, got none" if isinstance(error, KeyError) else str(error)


def _camera_fields(camera: Camera) -> dict[str, Any]:
    lens = camera.distortion
    try:
        coefficients = coefficients_of(lens, camera.t)
    except TypeError:
        raise ValueError(f"distortion: want one of {', '.join(KINDS)}, got {type(lens).__name__}") from None
    return {
        "dtype": str(camera.dtype).removeprefix("torch."),
        "size": camera.size,
        "K": camera.K.tolist(),
        "R": camera.R.tolist(),
        "t": camera.t.tolist(),
        "lens": None if lens is None else {"model": type(lens).__name__, "coefficients": coefficients.tolist()},
    }


def _camera(fields: Any) -> Camera:
    try:
        fields = _unpacked(fields)
        dtype = DTYPES[fields["dtype"]]
        K, R, t = (_tensor(fields, key, dtype) for key in ("K", "R", "t"))
        lens = fields["lens"]
        distortion = None if lens is None else KINDS[lens["model"]](_tensor(lens, "coefficients", dtype))
        size = None if fields["size"] is None else _size(fields["size"])
        camera = Camera(K, R, t, distortion)
        return Camera.unchecked(camera.K, camera.R, camera.t, camera.distortion, size)  # `load` looks at the sides
    except DAMAGE as error:
        raise ValueError(f"the camera in this file is damaged ({_said(error)})") from error


def _size(size: Any) -> tuple[int, int] | None:
    if not isinstance(size, list) or len(size) != 2:
        raise ValueError(f"size: want width and height, got {size!r}")
    return image_size(*size)


def _tensor(fields: dict[str, Any], name: str, dtype: torch.dtype) -> Tensor:
    array = np.array(fields[name])
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: want numbers, got something else")
    return torch.tensor(array, dtype=dtype, device="cpu")


def _fleet(document: Document) -> dict[str, dict[str, Any]]:
    """The lines of a fleet that have a camera, by its name; of two of one name, the later counts, a failure's too."""
    if document.path.suffix.lower() != ".jsonl":
        return {}
    lines = {str(line["name"]): line for line in document.tree if isinstance(line, dict) and "name" in line}
    return {name: line for name, line in lines.items() if line.get("format") == KIND}


def _chosen(document: Document, camera: str | None) -> dict[str, Any]:
    """What is in a file, or of a fleet in the line of one camera."""
    fleet = _fleet(document)
    if not fleet:
        if camera is not None:
            raise ValueError(f"camera: want it left out, for the file holds one, got {camera!r}")
        return _checked(document)
    if camera is None and len(fleet) > 1:
        raise NotOneCameraError(
            f"camera: want the name of one of {len(fleet)}, such as {next(iter(fleet))!r}, got None"
        )
    name = next(iter(fleet)) if camera is None else camera
    if name not in fleet:
        raise ValueError(f"camera: want the name of one of {len(fleet)}, such as {next(iter(fleet))!r}, got {name!r}")
    return _known(fleet[name])


def _checked(document: Document) -> dict[str, Any]:
    """What is in a file, known to be one of this package and of a version that is read."""
    return _known(document.mapping)


def _known(fields: dict[str, Any]) -> dict[str, Any]:
    holds = {KIND: "camera", RIG: "cameras"}.get(str(fields.get("format")))
    if holds is None or holds not in fields or (holds == "cameras" and not isinstance(fields[holds], dict)):
        raise ValueError("want a camera file of diffproj, got another file")
    version = fields.get("version")
    if isinstance(version, bool) or version not in range(1, VERSION + 1):
        raise ValueError(f"want version {VERSION} or earlier, got {version!r}; a newer diffproj reads it")
    return fields


def _plain(value: Any) -> Any:
    """The same for JSON: long lists packed, `None` for numbers that are not finite, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        array = np.array(value, dtype=object) if not value or isinstance(value[0], str) else np.array(value)
        if array.size >= MANY and array.dtype in (np.dtype(np.float64), np.dtype(np.bool_)):
            return _packed(array)
        if array.dtype.kind in "fib" and bool(np.isfinite(array).all()):
            return value if isinstance(value, list) else list(value)  # nothing in it has to be looked at, one by one
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _packed(array: np.ndarray) -> dict[str, Any]:
    """Many numbers or booleans, packed."""
    name = "bool" if array.dtype == np.bool_ else "float64"
    return {"shape": list(array.shape), name: base64.b64encode(array.astype(PACKED[name]).tobytes()).decode()}


def _unpacked(value: Any) -> Any:
    """The same with arrays for packed numbers."""
    if not isinstance(value, dict):
        return value
    if "shape" not in value:
        return {key: _unpacked(item) for key, item in value.items()}
    (kind, text), *others = ((key, text) for key, text in value.items() if key != "shape")
    shape = value["shape"]
    if others or kind not in PACKED or not isinstance(text, str) or not isinstance(shape, list):
        raise ValueError("packed numbers: want shape and float64 or bool, got something else")
    if not all(type(side) is int and side >= 0 for side in shape):
        raise ValueError(f"packed numbers: want whole numbers as shape, got {shape}")
    try:
        data = base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise ValueError(f"packed numbers: want base64, got something else ({error})") from None
    if math.prod(shape) * PACKED[kind].itemsize != len(data):
        raise ValueError(f"packed numbers: want {shape} of {kind}, got {len(data)} bytes")
    if kind == "bool" and data.translate(None, b"\x00\x01"):
        raise ValueError("packed numbers: want 0 and 1 as booleans, got others")
    return np.frombuffer(data, PACKED[kind]).reshape(shape)


def _readable(text: str) -> str:
    """Indented JSON with each innermost list on one line; a line break never stands inside a JSON string."""
    return re.sub(r"\[[^\[\]{}]*\]", lambda match: re.sub(r"\s*\n\s*", " ", match[0]), text) + "\n"
