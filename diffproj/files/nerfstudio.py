"""nerfstudio's and instant-ngp's `transforms.json`.

`transform_matrix` is camera to world in OpenGL's axes (x right, y up, z backward), so that world to camera is
`inv(M diag(1, -1, -1, 1))`. The first pixel's centre is at 0.5: `c_here = c - 0.5`. `k1 k2 p1 p2 k3` as in OpenCV; the
perspective `k4` is a factor of r^8, which OpenCV's model lacks. Keys of a frame override those of the file. The names
are the `file_path`s. The world is that of the file; `applied_transform` tells what was done to COLMAP's to get it.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from diffproj.calibration.results.calibration import Calibration
from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.lenses import brown, coefficients, first_brown, fisheye, is_fisheye, told, unused
from diffproj.files.named import check_no_lens_key, other_focal_lengths
from diffproj.files.numbers import camera_of, focal_lengths, image_size, inverse, number, rigid
from diffproj.files.writing import cameras_of
from diffproj.geometry.camera import Camera
from diffproj.lens.protocol import Lens

FLIP = np.diag([1.0, -1.0, -1.0])
"""From OpenGL's axes of a camera to OpenCV's, and back."""

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
KEYS = ("k1", "k2", "p1", "p2", "k3")
OTHERS = ("ftheta", "latlong", "equirect", "ortho", "omni")
"""In the names of instant-ngp's keys for other cameras."""

KNOWN = frozenset(KEYS) | {"k4", "k5", "k6", "distortion_params", "camera_model", "is_fisheye"}


def recognises(document: Document) -> bool:
    """Whether it has frames with a `transform_matrix`, or `fl_x`, or `camera_angle_x`."""
    tree, frames = document.mapping, document.mapping.get("frames")
    posed = isinstance(frames, list) and any(
        isinstance(frame, dict) and "transform_matrix" in frame for frame in frames
    )
    return posed or "fl_x" in tree or "camera_angle_x" in tree


def read(document: Document) -> Found:
    """The cameras of the frames; without frames, the camera of the file.

    Raises:
        ValueError: something is missing or not understood.
    """
    tree = document.mapping
    frames = tree.get("frames", [])
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise ValueError("frames: want a list of frames, got something else")
    if not frames:
        camera = _camera(tree, None)
        return Found({"camera": camera}, remarks=other_focal_lengths(tree, camera))
    cameras: dict[str, Camera] = {}
    remarks: list[str] = []
    for i, frame in enumerate(frames):
        name = str(frame.get("file_path", i))
        if name in cameras:
            raise ValueError(f"file_path: want each file once, got {name} twice")
        if "transform_matrix" not in frame:
            raise ValueError(f"frame {name}: want a transform_matrix, got none")
        R, t = rigid("transform_matrix", frame["transform_matrix"])
        cameras[name] = _camera(tree | frame, inverse((R @ FLIP, t)))
        remarks += other_focal_lengths(tree | frame, cameras[name])
    return Found(cameras, remarks=tuple(remarks[:1]))


def write(path: Path, item: Camera | Calibration) -> dict[Path, str]:
    """Cameras as frames.

    Raises:
        ValueError: a lens that nerfstudio does not have, skew, or no size.
    """
    cameras = cameras_of(item, "nerfstudio")
    fields = [_fields(camera) for camera in cameras]
    shared = {key: value for key, value in fields[0].items() if all(other.get(key) == value for other in fields)}
    frames: list[dict[str, Any]] = []
    for i, (camera, own) in enumerate(zip(cameras, fields, strict=True)):
        R, t = inverse((camera.R.numpy(), camera.t.numpy()))
        rows = np.vstack([np.column_stack([R @ FLIP, t]), [0, 0, 0, 1]])
        frame: dict[str, Any] = {"file_path": f"images/{i:06d}.png"}
        frame |= {key: value for key, value in own.items() if key not in shared}
        frames.append(frame | {"transform_matrix": (rows + 0.0).tolist()})
    return {path: json.dumps(shared | {"frames": frames}, indent=1, allow_nan=False) + "\n"}


def _fields(camera: Camera) -> dict[str, Any]:
    if camera.size is None:
        raise ValueError("size: want the size of the image, which nerfstudio needs; Camera(..., size=(width, height))")
    (f_x, _, c_x), (_, f_y, c_y), _ = camera.K.tolist()
    if f_x <= 0 or f_y <= 0:
        raise ValueError("K: want positive focal lengths, which nerfstudio needs, got a mirrored image")
    if is_fisheye(camera):
        model, lens = "OPENCV_FISHEYE", dict(zip(("k1", "k2", "k3", "k4"), coefficients(camera), strict=True))
    else:
        model, lens = "OPENCV", dict(zip(KEYS, first_brown(camera, 5, "nerfstudio"), strict=True))
        model, lens = (model, lens) if camera.distortion is not None else ("PINHOLE", {})
    width, height = camera.size
    K = {"fl_x": f_x, "fl_y": f_y, "cx": c_x + 0.5, "cy": c_y + 0.5}
    return {"camera_model": model, "w": width, "h": height} | K | lens


def _camera(fields: dict[str, Any], pose: Any) -> Camera:
    size = image_size(fields.get("w"), fields.get("h"), "w, h")
    if size is None and not all(key in fields for key in ("fl_x", "cx", "cy")):
        raise ValueError(
            "want w and h, the size of the image, or fl_x, cx and cy, got neither; add w and h to the file"
        )
    width, height = size or (0, 0)
    f_x = _focal(fields, "x", width)
    f_y = _focal(fields, "y", height)
    if f_x is None and f_y is None:
        raise ValueError("want fl_x or camera_angle_x, got neither")
    K = focal_lengths(
        f_y if f_x is None else f_x,
        f_x if f_y is None else f_y,
        number("cx", fields.get("cx", width / 2)) - 0.5,
        number("cy", fields.get("cy", height / 2)) - 0.5,
    )
    return camera_of(K, _lens(fields), size, pose)


def _focal(fields: dict[str, Any], axis: str, side: int) -> float | None:
    if f"fl_{axis}" in fields:
        return number(f"fl_{axis}", fields[f"fl_{axis}"])
    angle = fields.get(f"camera_angle_{axis}")
    if angle is None and f"{axis}_fov" in fields:
        angle = math.radians(number(f"{axis}_fov", fields[f"{axis}_fov"]))
    if angle is None:
        return None
    if not 0 < number(f"camera_angle_{axis}", angle) < math.pi or not side:
        raise ValueError(f"camera_angle_{axis}: want an angle between 0 and pi, and w and h beside it, got {angle}")
    return side / 2 / math.tan(angle / 2)


def _lens(fields: dict[str, Any]) -> Lens | None:
    for key, value in fields.items():
        if any(word in key.lower() for word in OTHERS) and value:
            raise ValueError(f"{key}: want a perspective or fisheye lens of OpenCV, got one of other equations")
        if key not in KNOWN:
            check_no_lens_key(key, value)
    model = fields.get("camera_model", "OPENCV")
    given = {key: number(key, fields[key]) for key in ("k1", "k2", "k3", "k4", "p1", "p2") if key in fields}
    for key in ("k5", "k6", "distortion_params"):
        value = fields.get(key)
        if value is not None and not (value == 0 or (isinstance(value, list) and not any(value))):
            raise ValueError(f"{key}: want 0 or none, got {value}: no camera of this package has it")
    own = model == "OPENCV_FISHEYE" or fields.get("is_fisheye") in (True, 1)
    elsewhere = told(fields, ("camera_model", "is_fisheye")).get("fisheye")
    if elsewhere and not own:
        raise ValueError(f"{elsewhere}: want OPENCV_FISHEYE as camera_model of a fisheye lens, got {model!r}")
    if own:
        for key in ("p1", "p2"):
            unused(key, given.get(key), "OpenCV's fisheye lens has no tangential part")
        missing = [key for key in ("k1", "k2", "k3", "k4") if key not in given]
        if len(missing) == 4:
            raise ValueError("want k1 to k4 of the fisheye lens that the file names, got none")
        return fisheye([given.get(key, 0.0) for key in ("k1", "k2", "k3", "k4")])
    if model not in PERSPECTIVE:
        raise ValueError(f"camera_model: want OPENCV, PINHOLE or OPENCV_FISHEYE, got {model!r}")
    unused("k4", given.pop("k4", None), "here it is a factor of r^8, which no lens of this package has")
    if not given:
        return None
    return brown([given.get(key, 0.0) for key in (KEYS if "k3" in given else KEYS[:4])])
