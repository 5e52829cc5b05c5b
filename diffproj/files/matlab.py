"""MATLAB's camera parameters: `save` and `jsonencode` of `toStruct(cameraParams)`; Bouguet's toolbox, `.mat` and `.m`.

`IntrinsicMatrix` is transposed, `K` is not; both are one-based: 1 is taken off the principal point. `RadialDistortion`
is k1 k2 and perhaps k3, `TangentialDistortion` p1 p2, `ImageSize` height, width. Bouguet's `fc cc kc alpha_c nx ny` are
zero-based, with OpenCV's coefficients; `om` and `T` place the right camera beside the left one. Those of
`toStruct(stereoParams)` are `RotationOfCamera2`, which is transposed too, and `TranslationOfCamera2`.
"""

import re
from typing import Any

import cv2
import numpy as np

from diffproj.files import mat5
from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.lenses import brown
from diffproj.files.numbers import camera_of, focal_lengths, image_size, intrinsics, matrix, rigid, square, vector
from diffproj.geometry.camera import Camera

HDF5 = b"\x89HDF"
PAIR = ("CameraParameters1", "CameraParameters2")
"""The cameras of `toStruct(stereoParams)`."""

TURN, SHIFT = "RotationOfCamera2", "TranslationOfCamera2"
"""The place of the second one, for rows of points times the rotation: it is transposed."""

UNPLACED = (
    f"the second camera stands where the first one does, for there is no {TURN} and {SHIFT}, and a PoseCamera2 is not "
    "read; in MATLAB, [~, ~, ~, ~, R, t] = stereoParametersToOpenCV(stereoParams) tells what camera.at(R, t) takes"
)

TO_STRUCT = "s = toStruct(cameraParams); save('camera.mat', '-struct', 's', '-v7')"


def recognises(document: Document) -> bool:
    """Whether it is a `.mat` file, or has MATLAB's or Bouguet's names."""
    if document.data.startswith((b"MATLAB", HDF5)):
        return True
    tree = document.mapping
    found = any(_is_struct(value) or _is_stereo(value) for value in (tree, *tree.values()))
    return found or _is_bouguet_text(document)


def read(document: Document) -> Found:
    """The camera, or the stereo pair.

    Raises:
        ValueError: it holds MATLAB's objects, or something is missing or not understood.
    """
    if document.data.startswith(HDF5) or (b"MAT-file" in document.data[:30] and b"7.3" in document.data[:30]):
        raise ValueError(f"want a .mat file of version 7, got one of 7.3 (HDF5); in MATLAB: {TO_STRUCT}")
    if document.data.startswith(b"MATLAB"):
        fields = mat5.variables(document.data)
    elif _is_bouguet_text(document):
        fields = _assignments(document.text or "")
    else:
        fields = document.mapping
    if "fc" in fields or "fc_left" in fields:
        return _bouguet(fields)
    stereo = next((holder for holder in (fields, *fields.values()) if _is_stereo(holder)), None)
    if stereo is not None:
        return Found(_pair(stereo), remarks=() if TURN in stereo else (UNPLACED,))
    structs = {name: value for name, value in {"": fields, **fields}.items() if _is_struct(value)}
    if not structs:
        if any(isinstance(value, mat5.Unreadable) for value in fields.values()):
            raise ValueError(f"want numbers, got an object, which only MATLAB opens; there: {TO_STRUCT}")
        listed = ", ".join(list(fields)[:6]) + " and more" * (len(fields) > 6)
        raise ValueError(f"want K or IntrinsicMatrix, or Bouguet's fc and cc, got {listed or 'nothing'}")
    return Found({name or "camera": _camera(value) for name, value in structs.items()})


def _is_struct(fields: Any) -> bool:
    return isinstance(fields, dict) and "RadialDistortion" in fields


def _is_stereo(fields: Any) -> bool:
    return isinstance(fields, dict) and all(_is_struct(fields.get(name)) for name in PAIR)


def _pair(fields: dict[str, Any]) -> dict[str, Camera]:
    """The two cameras of `stereoParameters`, the second at its place beside the first where the file has it."""
    first, second = (_camera(fields[name]) for name in PAIR)
    missing = [key for key in (TURN, SHIFT) if key not in fields]
    if len(missing) == 1:
        raise ValueError(f"{missing[0]}: want it beside {TURN if missing[0] == SHIFT else SHIFT}, got none")
    if not missing:
        R, t = square(TURN, fields[TURN], 3, 3).T, vector(SHIFT, fields[SHIFT], (3,))
        pose = rigid(TURN, np.column_stack([R, t]))
        second = camera_of(second.K.numpy(), second.distortion, second.size, pose)
    return {PAIR[0]: first, PAIR[1]: second}


def _is_bouguet_text(document: Document) -> bool:
    return re.search(r"^\s*fc(_left)?\s*=\s*\[", document.text or "", re.MULTILINE) is not None


def _camera(fields: dict[str, Any]) -> Camera:
    if "IntrinsicMatrix" not in fields and "K" not in fields and "FocalLength" in fields:
        (f_x, f_y), (c_x, c_y) = (vector(key, fields[key], (2,)) for key in ("FocalLength", "PrincipalPoint"))
        K = focal_lengths(f_x, f_y, c_x, c_y, _scalar("Skew", fields.get("Skew", 0.0)))
    elif "K" in fields:
        K = intrinsics("K", fields["K"], skew=True).copy()
    elif "IntrinsicMatrix" in fields:
        K = intrinsics("IntrinsicMatrix", matrix("IntrinsicMatrix", fields["IntrinsicMatrix"]).T, skew=True).copy()
    else:
        raise ValueError("want K, IntrinsicMatrix or FocalLength beside RadialDistortion, got none")
    K[:2, 2] -= 1
    radial = vector("RadialDistortion", fields["RadialDistortion"], (2, 3))
    if "TangentialDistortion" not in fields:
        raise ValueError("want TangentialDistortion beside RadialDistortion, got none")
    tangential = vector("TangentialDistortion", fields["TangentialDistortion"], (2,))
    size = None
    if "ImageSize" in fields and np.size(matrix("ImageSize", fields["ImageSize"])):
        height, width = vector("ImageSize", fields["ImageSize"], (2,))
        size = image_size(width, height)
    return camera_of(K, brown([*radial[:2], *tangential, *radial[2:]]), size)


def _bouguet(fields: dict[str, Any]) -> Found:
    sides = ("_left", "_right") if "fc_left" in fields else ("",)
    cameras = {side.strip("_") or "camera": _bouguet_camera(fields, side, None) for side in sides}
    if len(sides) == 2:
        if "om" not in fields or "T" not in fields:
            raise ValueError("want om and T from the left camera to the right one, got none")
        om, t = (np.array(vector(key, fields[key], (3,))) for key in ("om", "T"))
        cameras["right"] = _bouguet_camera(fields, "_right", (cv2.Rodrigues(om)[0], t))
    return Found(cameras)


def _bouguet_camera(fields: dict[str, Any], side: str, pose: Any) -> Camera:
    for key in ("fc", "cc", "kc"):
        if key + side not in fields:
            raise ValueError(f"want {key + side}, got none")
    (f_x, f_y), (c_x, c_y) = (vector(key, fields[key + side], (2,)) for key in ("fc", "cc"))
    skew = _scalar("alpha_c", fields.get("alpha_c" + side, 0.0)) * f_x
    width, height = (None if key not in fields else _scalar(key, fields[key]) for key in ("nx", "ny"))
    size = image_size(width, height)
    kc = vector("kc" + side, fields["kc" + side], (4, 5))
    if len(kc) == 4 and any(kc):
        raise ValueError(
            f"kc{side}: want 5 coefficients, got 4, which may be those of the toolbox's fisheye model, or k1 k2 p1 p2 "
            "of an early version: if they are k1 k2 p1 p2, append a 0; if the fisheye's, build "
            "dp.Camera(K, distortion=dp.KannalaBrandt(kc))"
        )
    return camera_of(focal_lengths(f_x, f_y, c_x, c_y, skew), brown(kc), size, pose)


def _scalar(name: str, value: Any) -> float:
    array = matrix(name, value if isinstance(value, list | np.ndarray) else [value])
    if array.size != 1:
        raise ValueError(f"{name}: want one number, got {array.size}")
    return float(array.ravel()[0])


def _assignments(text: str) -> dict[str, Any]:
    """The numbers of lines such as `fc = [ 657.3 ; 657.7 ];`, without those that are computed."""
    fields: dict[str, Any] = {}
    for name, inside, alone in re.findall(r"^\s*(\w+)\s*=\s*(?:\[([^\]]*)\]|([-+.\deE]+))\s*;", text, re.MULTILINE):
        try:
            numbers = [float(word) for word in re.split(r"[\s;,]+", (inside or alone).strip()) if word]
        except ValueError:
            continue
        if name in fields:
            raise ValueError(f"{name}: want the variable once, got it twice")
        fields[name] = numbers
    return fields
