"""Settings of ORB-SLAM, stella and VINS, and other files with `fx fy cx cy` and `k1 k2 p1 p2 [k3]` one by one.

ORB-SLAM writes them flat (`Camera.fx`, `Camera1.fx`; of some pairs `Camera.fx` and `Camera2.fx`), stella in a mapping
`Camera`, VINS in `projection_parameters` and `distortion_parameters`. Integer pixel centres. A fisheye only where the
file says so: `KannalaBrandt8`, `fisheye`, VINS's `KANNALA_BRANDT` with k2 to k5. `Stereo.T_c1_c2` and `Tlr` take the
second camera to the first, the world; so does `Stereo.b`, along x, where both are rectified. Poses in a body are not
taken. A pinhole without coefficients has no lens, but in SLAM's settings, which have them always. Where the file also
has the two cameras before rectification (`stereo_rectifier`), these are read, and the rectified one by its name
`"rectified"`.
"""

import re
from typing import Any

import numpy as np

from diffproj.files import poses_beside
from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.lenses import brown, fisheye, kind_of, told
from diffproj.files.named import check_no_lens, check_no_lens_key, holds_lens, holds_matrix, parts_of_an_image
from diffproj.files.named import read as read_named
from diffproj.files.numbers import camera_of, focal_lengths, image_size, inverse, number, rigid
from diffproj.files.stereo_rectifier import raw_cameras, raw_sides
from diffproj.geometry.camera import Camera
from diffproj.lens.protocol import Lens

FOCAL = ("fx", "fy", "cx", "cy")
VINS_FISHEYE: dict[str, str] = {
    "mu": "fx",
    "mv": "fy",
    "u0": "cx",
    "v0": "cy",
    "k2": "k1",
    "k3": "k2",
    "k4": "k3",
    "k5": "k4",
}
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
SIZES = (("width", "height"), ("image_width", "image_height"), ("cols", "rows"))
TYPES = ("type", "model", "model_type", "camera_model")
PERSPECTIVE = ("pinhole", "perspective", "rectified")
SECOND_TO_FIRST = ("Stereo.T_c1_c2", "Tlr")
BASELINE = "Stereo.b"
"""Of a rectified pair, to the right."""


def recognises(document: Document) -> bool:
    """Whether it has focal lengths and principal point one by one."""
    tree = document.mapping
    return bool(_cameras(tree)) and (bool(raw_sides(tree)) or not holds_matrix(tree))


def read(document: Document) -> Found:
    """The cameras, the second of a stereo pair beside the first; those before rectification where there are any.

    Raises:
        ValueError: something is missing or not understood.
    """
    tree = document.mapping
    fields = _cameras(tree)
    plain = list(fields) == ["camera"] and fields["camera"] is tree
    if plain and _is_whole(tree) and holds_lens(tree):
        return _with_vector(tree)
    common = _common(fields)
    cameras = {name: _camera(common | own, None, plain) for name, own in fields.items()}
    if raw_sides(tree) and len(cameras) == 1:
        ((name, rectified),) = cameras.items()
        return Found(raw_cameras(tree, fields[name], rectified), {"rectified": rectified})
    poses = [key for key in SECOND_TO_FIRST if key in tree]
    if len(cameras) == 2 and (poses or BASELINE in tree):
        second = list(cameras)[1]
        pose = inverse(rigid(poses[0], tree[poses[0]])) if poses else (np.eye(3), _along_x(tree[BASELINE]))
        cameras[second] = _camera(common | fields[second], pose)
    unread = tuple(poses_beside.unread(tree, set())) if plain else ()
    return Found(cameras, unread=unread, remarks=parts_of_an_image(tree))


def _cameras(tree: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The fields of each camera; those that hold for all by the name `Camera`."""
    flat: dict[str, dict[str, Any]] = {}
    for key, value in tree.items():
        prefix, dot, name = key.partition(".")
        if dot and re.fullmatch(r"Camera\d?", prefix):
            flat.setdefault(prefix, {})[name] = value
    if any(_is_whole(fields) for fields in flat.values()):
        return {name: fields for name, fields in flat.items() if name == "Camera" or _is_whole(fields)}
    if isinstance(tree.get("Camera"), dict) and _is_whole(tree["Camera"]):
        return {"camera": tree["Camera"]}
    if isinstance(tree.get("projection_parameters"), dict) and "model_type" in tree:
        return {"camera": tree}
    return {"camera": tree} if _is_whole(tree) else {}


def _with_vector(tree: dict[str, Any]) -> Found:
    """The camera of focal lengths one by one, and its lens as a vector under one of the names of `named`."""
    K = focal_lengths(*(tree[key] for key in FOCAL))
    rest = {key: value for key, value in tree.items() if key not in FOCAL}
    return read_named({**rest, "camera_matrix": K}, four_is_brown=False)


def _along_x(baseline: Any) -> np.ndarray:
    """The translation to a right camera that stands so far to the right."""
    return np.array([-number(BASELINE, baseline), 0.0, 0.0])


def _common(fields: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What holds for every camera: all of `Camera` where it is none, and is taken out; else all but its K and lens."""
    if len(fields) == 1 or "Camera" not in fields:
        return {}
    if not _is_whole(fields["Camera"]):
        return fields.pop("Camera")
    return {key: value for key, value in fields["Camera"].items() if key not in (*FOCAL, *ORDER)}


def _is_whole(fields: dict[str, Any]) -> bool:
    return all(key in fields for key in FOCAL)


def _vins(tree: dict[str, Any]) -> dict[str, Any]:
    """The fields of VINS's sections under the names of the others."""
    fields: dict[str, Any] = tree["projection_parameters"]
    lens = tree.get("distortion_parameters", {})
    if tree["model_type"] == "KANNALA_BRANDT":
        fields = {VINS_FISHEYE.get(key, key): value for key, value in fields.items()}
    elif tree["model_type"] != "PINHOLE" or not isinstance(lens, dict):
        raise ValueError(f"model_type: want PINHOLE or KANNALA_BRANDT, got {tree['model_type']!r} of other equations")
    sides = {key: tree[key] for key in ("image_width", "image_height") if key in tree}
    return {"model_type": tree["model_type"]} | fields | lens | sides


def _camera(fields: dict[str, Any], pose: Any, may_be_bare: bool = False) -> Camera:
    if "projection_parameters" in fields:
        fields, may_be_bare = _vins(fields), False
    f_x, f_y, c_x, c_y = (_got(fields, key) for key in FOCAL)
    K = focal_lengths(f_x, f_y, c_x, c_y)
    size = None
    for width, height in SIZES:
        if width in fields or height in fields:
            size = image_size(fields.get(width), fields.get(height), f"{width}, {height}")
    return camera_of(K, _lens(fields, may_be_bare), size, pose)


def _lens(fields: dict[str, Any], may_be_bare: bool) -> Lens | None:
    kinds = {kind_of(key, fields[key]) for key in TYPES if key in fields and not _is_perspective(fields[key])}
    kinds |= told(fields, TYPES).keys()
    if {"brown", "fisheye"} <= kinds:
        raise ValueError("want one lens model, got the names of a fisheye and of another one")
    given = {key: number(key, fields[key]) for key in ORDER if key in fields}
    for key, value in fields.items():
        if key not in (*ORDER, *TYPES):
            check_no_lens_key(key, value)
            check_no_lens(value, [])
    if "fisheye" in kinds:
        if set(given) != {"k1", "k2", "k3", "k4"}:
            raise ValueError(f"want k1 to k4 of the fisheye lens that the file names, got {', '.join(given) or 'none'}")
        return fisheye([given[key] for key in ("k1", "k2", "k3", "k4")])
    types = [key for key in TYPES if key in fields and str(fields[key]).lower() != "rectified"]
    if not given and types and not (may_be_bare and all(_is_perspective(fields[key]) for key in types)):
        raise ValueError(f"want k1 k2 p1 p2 beside {types[0]}, got none")
    if not given:
        return None
    for count in (4, 5, 8):
        if set(given) == set(ORDER[:count]):
            return brown([given[key] for key in ORDER[:count]])
    raise ValueError(f"want k1 k2 p1 p2, then k3, then k4 to k6, got {', '.join(given)}")


def _is_perspective(value: object) -> bool:
    return isinstance(value, str) and value.lower() in PERSPECTIVE


def _got(fields: dict[str, Any], key: str) -> Any:
    if key not in fields:
        raise ValueError(f"want {key}, got none")
    return fields[key]
