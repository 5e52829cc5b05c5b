"""ROS's `camera_info`, as YAML, as `ost.txt` or `.ini`, and as the printed message.

`K` and `D` hold for raw images: they are the camera that is found. `P` holds for rectified images, which have no lens:
asked for by the name `"rectified"`, its left 3 x 3 numbers are K, and its last column is K t, from the left camera of a
stereo pair. `rectification_matrix` is no pose. Integer pixel centres. Without a `distortion_model`, five
coefficients are those of plumb_bob, as ROS's own reader has it.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from diffproj.calibration.results.calibration import Calibration
from diffproj.files import named, poses_beside
from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.lenses import coefficients, is_fisheye, kind_of, lens_of
from diffproj.files.numbers import camera_of, image_size, intrinsics, matrix, square
from diffproj.files.writing import numbers_text, one_camera, without_pose
from diffproj.geometry.camera import Camera

MATRIX, LENS, RECTIFIED = (
    ("camera_matrix", "K", "k"),
    ("distortion_coefficients", "D", "d", "distortion_coefficents"),
    ("projection_matrix", "P", "p"),
)
COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,), "fisheye": (4,)}


def recognises(document: Document) -> bool:
    """Whether it has a `distortion_model` or `projection_matrix` beside K without OpenCV's tags, or is an `ost.txt`.

    `P` stands beside K and a lens of another name too, in files of `cv2.stereoRectify`.
    """
    if _is_ini(document):
        return True
    fields = document.mapping
    plain = not any(isinstance(value, dict) and "type_id" in value for value in fields.values())
    told = "distortion_model" in fields or any(key in fields for key in RECTIFIED[:2])
    own = "distortion_model" in fields or any(key in fields for key in LENS) or not named.holds_lens(fields)
    return plain and told and own and any(key in fields for key in MATRIX) and "<root>" not in fields


def read(document: Document) -> Found:
    """The raw camera, and the rectified one aside.

    Raises:
        ValueError: something is missing, not understood, or the image was cropped or binned.
    """
    if not _is_ini(document):
        return _camera(document.mapping)
    raw, aside = {}, {}
    sections = _sections(document.text or "")
    for name, fields in sections.items():
        found = _camera(fields)
        raw[name] = found.cameras["camera"]
        aside |= {key if len(sections) == 1 else f"{name} {key}": one for key, one in found.aside.items()}
    return Found(raw, aside)


def write(path: Path, item: Camera | Calibration) -> dict[Path, str]:
    """One camera without a pose, with its size.

    Raises:
        ValueError: it has something that the format cannot hold.
    """
    camera = without_pose(one_camera(item, "ROS's camera_info"), "ROS's camera_info")
    if camera.size is None:
        raise ValueError("size: want the size of the image, which ROS's camera_info needs; Camera(..., size=(w, h))")
    K, found = camera.K.tolist(), coefficients(camera)
    if len(found) > 8:
        raise ValueError(f"distortion: want at most the 8 coefficients of rational_polynomial, got {len(found)}")
    model = "equidistant" if is_fisheye(camera) else "rational_polynomial" if len(found) == 8 else "plumb_bob"
    found = found if model != "plumb_bob" else [*found, *[0.0] * (5 - len(found))]
    flat = [number for row in K for number in row]
    blocks = {
        "camera_matrix": (3, 3, flat),
        "distortion_coefficients": (1, len(found), found),
        "rectification_matrix": (3, 3, np.eye(3).ravel().tolist()),
        "projection_matrix": (3, 4, [number for row in K for number in (*row, 0.0)]),
    }
    lines = [f"image_width: {camera.size[0]}", f"image_height: {camera.size[1]}", "camera_name: camera"]
    for name, (rows, columns, numbers) in blocks.items():
        if name == "distortion_coefficients":
            lines.append(f"distortion_model: {model}")
        lines += [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {numbers_text(numbers)}"]
    return {path: "\n".join(lines) + "\n"}


def _camera(fields: dict[str, Any]) -> Found:
    if "distortion_model" not in fields and _of_old(fields):
        fields = {**fields, "distortion_model": "plumb_bob"}
    wanted = (MATRIX, LENS, ("distortion_model",))
    missing = [names[0] for names in wanted if _first(fields, names) in (None, ("distortion_model", ""))]
    if missing:
        models = "; its model is plumb_bob (5 coefficients), rational_polynomial (8) or equidistant (4)"
        remedy = models if missing == ["distortion_model"] else ""
        raise ValueError(f"want {' and '.join(missing)} in a camera_info, got none{remedy}")
    for part in named.parts_of_an_image(fields):
        raise ValueError(part)
    width, height = (fields.get(f"image_{side}", fields.get(side)) for side in ("width", "height"))
    size = image_size(width, height)
    K = intrinsics(*_first(fields, MATRIX))
    name, value = _first(fields, LENS)
    found, model = matrix(name, value).ravel().tolist(), str(fields["distortion_model"]).strip()
    kind = kind_of("distortion_model", model)
    if kind is None or len(found) not in COUNTS.get(model, (len(found),)):
        counts = " or ".join(map(str, COUNTS.get(model, ())))
        raise ValueError(f"{name}: want {counts} coefficients for distortion_model {model}, got {len(found)}")
    aside = {}
    if _first(fields, RECTIFIED) is not None:
        name, value = _first(fields, RECTIFIED)
        P = square(name, value, 3, 4)
        if P[0, 0] > 0:
            K_rectified = intrinsics("projection_matrix", P[:, :3])
            aside["rectified"] = camera_of(K_rectified, None, size, (np.eye(3), np.linalg.solve(K_rectified, P[:, 3])))
    unread = tuple(poses_beside.unread(fields, set()))
    return Found({"camera": camera_of(K, lens_of(kind, found), size)}, aside, unread)


def _of_old(fields: dict[str, Any]) -> bool:
    """Whether the lens has the five numbers of plumb_bob, which files had before models were named."""
    found = _first(fields, LENS)
    return found is not None and matrix(*found).size == 5


def _first(fields: dict[str, Any], names: tuple[str, ...]) -> Any:
    """The first of the names that holds something, with what it holds; `None` where none does."""
    return next(((name, fields[name]) for name in names if fields.get(name) is not None), None)


def _is_ini(document: Document) -> bool:
    text = document.text or ""
    return "camera matrix" in text and re.search(r"^\[image\]\s*$", text, re.MULTILINE) is not None


def _sections(text: str) -> dict[str, dict[str, Any]]:
    """The cameras of an `ost.txt`, each as the fields that the YAML has."""
    lines = [line.strip() for line in text.splitlines()]
    lines = [line for line in lines if line and line[0] not in "#;"]
    sections: dict[str, dict[str, list[str]]] = {}
    section: dict[str, list[str]] = {}
    rows: list[str] = []
    for line in lines:
        if line[0] == "[":
            if line in sections:
                raise ValueError(f"{line}: want the section once, got it twice; split the file by cameras")
            section = sections[line] = {}
        elif re.fullmatch(r"[a-z ]+", line):
            if line in section:
                raise ValueError(f"{line}: want the key once, got it twice")
            rows = section[line] = []
        else:
            rows.append(line)
    image = sections.pop("[image]")
    width, height = (_numbers(image.get(side, [])) for side in ("width", "height"))
    if len(width) != 1 or len(height) != 1:
        raise ValueError("[image]: want a width and a height")
    cameras = {}
    for name, fields in sections.items():
        if "camera matrix" not in fields:
            continue
        D = _numbers(fields.get("distortion", []))
        if len(_numbers(fields.get("projection", []))) != 12:
            raise ValueError(f"{name}: want a projection of 12 numbers at its end, got another; the file was cut off")
        cameras[name.strip("[]")] = {
            "image_width": width[0],
            "image_height": height[0],
            "camera_matrix": _numbers(fields["camera matrix"]),
            "distortion_coefficients": D or None,
            "distortion_model": {5: "plumb_bob", 4: "plumb_bob", 8: "rational_polynomial"}.get(len(D), f"of {len(D)}"),
            "projection_matrix": _numbers(fields["projection"]),
        }
    if not cameras:
        raise ValueError("want a camera matrix in a section, got none")
    return cameras


def _numbers(rows: list[str]) -> list[float]:
    try:
        return [float(word) for row in rows for word in row.split()]
    except ValueError as error:
        raise ValueError(f"want numbers, got something else ({error})") from None
