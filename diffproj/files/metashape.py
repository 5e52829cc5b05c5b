"""Metashape's XML: the cameras of `Export Cameras`, and the calibration of one sensor.

The principal point is measured from the middle of the image, whose first pixel has its centre at 0.5:
`c_here = side / 2 + c - 0.5`. `p1` is OpenCV's p2 and `p2` its p1; `b1` widens f_x, `b2` is skew; `k4` has no
counterpart. A camera's `transform` is camera to chunk in OpenCV's axes; that of its component, or the chunk's own where
it has none, with its scale, leads to the world: the geocentric one where the chunk's reference is in degrees. The names
are the labels, with the id behind where several have one label. Only frame sensors have these equations. Cameras of a
rig that follow its first one are not read, which is said.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.lenses import brown, unused
from diffproj.files.numbers import (
    camera_of,
    focal_lengths,
    image_size,
    inverse,
    number,
    rigid,
    rotation,
    square,
    vector,
)
from diffproj.geometry.camera import Camera

KEYS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


def recognises(document: Document) -> bool:
    """Whether its root is a `document` with a `chunk`, or a `calibration` with a `projection`."""
    tree = document.mapping
    return (tree.get("<root>") == "document" and "chunk" in tree) or (
        tree.get("<root>") == "calibration" and "projection" in tree
    )


def read(document: Document) -> Found:
    """The aligned cameras by their labels, and the sensors aside; the sensors alone where no camera is aligned.

    Raises:
        ValueError: something is missing or not understood.
    """
    tree = document.mapping
    if tree["<root>"] == "calibration":
        return Found({"camera": _sensor(tree, image_size(tree.get("width"), tree.get("height")), tree["projection"])})
    chunk = tree["chunk"]
    if not isinstance(chunk, dict):
        raise ValueError("chunk: want one, got several; export them one by one")
    listed = _named(chunk.get("sensors"), "sensor")
    if not listed:
        raise ValueError("want sensors in the chunk, got none")
    by_id = {str(fields["id"]): (name, fields) for name, fields in listed.items()}
    calibrated = {name: _calibrated(name, fields) for name, fields in listed.items() if fields.get("calibration")}
    posed: dict[str, Camera] = {}
    followers: list[str] = []
    places = _Places(chunk)
    for name, fields in _named(chunk.get("cameras"), "camera").items():
        if fields.get("transform") is None:
            followers += [name] * ("master_id" in fields)
            continue
        if str(fields.get("sensor_id")) not in by_id:
            raise ValueError(f"camera {name}: want the sensor_id of a sensor, got {fields.get('sensor_id')}")
        label, of_sensor = by_id[str(fields["sensor_id"])]
        sensor = calibrated.get(label) or _calibrated(label, of_sensor)
        posed[name] = camera_of(
            sensor.K.numpy(), sensor.distortion, sensor.size, _pose(name, fields, places.of(fields))
        )
    if posed:
        return Found(posed, calibrated, remarks=_of_followers(followers))
    return Found(calibrated or {name: _calibrated(name, fields) for name, fields in listed.items()})


def _of_followers(names: list[str]) -> tuple[str, ...]:
    """What is said of cameras of a rig whose place follows from that of its first camera: it is not read."""
    if not names:
        return ()
    return (
        f"cameras: {len(names)} follow the first camera of a rig, such as {names[0]}, and are not read, for the file "
        "has no place of their own; their sensors are here by name, and camera.at(R, t) places them",
    )


def _named(tree: Any, tag: str) -> dict[str, dict[str, Any]]:
    """The elements of a tag by their labels, with their ids behind where they share one.

    Raises:
        ValueError: an element has no id, or that of another.
    """
    items = list(_all(tree, tag))
    labels = [str(fields.get("label", fields.get("id"))) for fields in items]
    shared = {label for label, count in Counter(labels).items() if count > 1}
    named: dict[str, dict[str, Any]] = {}
    ids: set[str] = set()
    for fields, label in zip(items, labels, strict=True):
        id_ = str(fields.get("id"))
        if "id" not in fields or id_ in ids:
            raise ValueError(f"{tag} {label}: want an id of its own, got {fields.get('id')}")
        ids.add(id_)
        named[f"{label} {id_}" if label in shared else label] = fields
    return named


def _all(tree: Any, tag: str) -> Iterator[dict[str, Any]]:
    """The elements of a tag, also those in groups."""
    if isinstance(tree, list):
        for item in tree:
            yield from _all(item, tag)
    elif isinstance(tree, dict):
        items = tree.get(tag, [])
        yield from (item for item in (items if isinstance(items, list) else [items]) if isinstance(item, dict))
        yield from _all(tree.get("group"), tag)


def _calibrated(label: str, fields: dict[str, Any]) -> Camera:
    found = fields.get("calibration")
    several = [item for item in (found if isinstance(found, list) else [found]) if isinstance(item, dict)]
    adjusted = [item for item in several if item.get("class") == "adjusted"] or several
    if not adjusted or "f" not in adjusted[0]:
        raise ValueError(
            f"sensor {label}: want a calibration with f, got none; align the photographs, and export again"
        )
    resolution = adjusted[0].get("resolution", fields.get("resolution"))
    if not isinstance(resolution, dict):
        raise ValueError(f"sensor {label}: want a resolution, got none")
    width, height = (_attribute(side, resolution.get(side)) for side in ("width", "height"))
    size = image_size(width, height)
    return _sensor(adjusted[0], size, adjusted[0].get("type", fields.get("type")))


def _sensor(fields: dict[str, Any], size: tuple[int, int] | None, kind: Any) -> Camera:
    if kind != "frame":
        raise ValueError(f"type: want a frame sensor, got {kind!r}, whose equations are others than OpenCV's")
    if size is None:
        raise ValueError("want the size of the image, from whose middle cx and cy are measured, got none")
    if "fx" in fields or "f" not in fields:
        raise ValueError("want f, got none; export with Metashape 1.3 or later")
    named = {key: number(key, fields[key]) if key in fields else 0.0 for key in KEYS}
    for key in ("k4", "p3", "p4"):
        unused(key, named[key], "OpenCV's lens has no such part; estimate again with this coefficient switched off")
    c_x, c_y = (side / 2 + named[key] - 0.5 for side, key in zip(size, ("cx", "cy"), strict=True))
    K = focal_lengths(named["f"] + named["b1"], named["f"], c_x, c_y, named["b2"])
    return camera_of(K, brown([named[key] for key in ("k1", "k2", "p2", "p1", "k3")]), size)


def _attribute(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: want a number, got {value!r}") from None


class _Places:
    """Where the frames of the components of a chunk are in the world."""

    def __init__(self, chunk: dict[str, Any]) -> None:
        self._whole = _place(chunk.get("transform"))
        components = _named(chunk.get("components"), "component").values()
        self._parts = {str(fields["id"]): _place(fields["transform"]) for fields in components if "transform" in fields}

    def of(self, camera: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, float]:
        """Rotation, translation and scale for a camera's component; the chunk's where it has none."""
        return self._parts.get(str(camera.get("component_id")), self._whole)


def _place(transform: Any) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation, translation and scale from the chunk to the world."""
    if not isinstance(transform, dict):
        return np.eye(3), np.zeros(3), 1.0
    parts = {key: _content(transform.get(key)) for key in ("rotation", "translation", "scale")}
    R = np.eye(3) if parts["rotation"] is None else rotation("rotation", square("rotation", parts["rotation"], 3, 3))
    t = np.zeros(3) if parts["translation"] is None else np.array(vector("translation", parts["translation"], (3,)))
    scale = 1.0 if parts["scale"] is None else number("scale", parts["scale"])
    if scale <= 0:
        raise ValueError(f"scale: want a positive number, got {scale}")
    return R, t, scale


def _content(value: Any) -> Any:
    return value.get("<text>") if isinstance(value, dict) else value


def _pose(label: str, fields: dict[str, Any], place: tuple[np.ndarray, np.ndarray, float]) -> Any:
    R, t = rigid(f"camera {label}, transform", _content(fields["transform"]))
    R_chunk, t_chunk, scale = place
    return inverse((R_chunk @ R, scale * (R_chunk @ t) + t_chunk))
