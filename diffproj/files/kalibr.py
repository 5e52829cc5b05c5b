"""Kalibr's `camchain.yaml`, and the `sensor.yaml` of EuRoC, which has one camera in the same terms.

`pinhole` with `radtan` (k1 k2 p1 p2) or `equidistant` (Kannala-Brandt); integer pixel centres; `resolution` is width,
height. `T_cam_imu` takes IMU to camera, so the world is the IMU; without it, `T_cn_cnm1` takes the camera before to
this one, and the world is the first camera. `T_imu_cam`, `T_BS` and `body_T_cam0` run the other way. Cameras are in
the order of their numbers; Kalibr writes them in that of the alphabet, cam10 before cam2.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from diffproj.calibration.results.calibration import Calibration
from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.lenses import KINDS_BY_NAME, coefficients, first_brown, is_fisheye, kind_of, lens_of
from diffproj.files.named import check_no_lens_key
from diffproj.files.numbers import camera_of, focal_lengths, image_size, inverse, matrix, rigid, vector
from diffproj.files.poses_beside import unread as unread_poses
from diffproj.files.writing import cameras_of, number_text, numbers_text
from diffproj.geometry.camera import Camera

Pose = tuple[np.ndarray, np.ndarray]
INTO_CAMERA = ("T_cam_imu",)
FROM_CAMERA = ("T_imu_cam", "T_BS")
_NUMBERED = re.compile(r"cam(\d+)").fullmatch


def recognises(document: Document) -> bool:
    """Whether `cam0` or the file itself has `intrinsics` with a model of camera or lens."""
    return bool(_cameras(document.mapping))


def read(document: Document) -> Found:
    """The cameras, each at its pose.

    Raises:
        ValueError: a camera that is neither `pinhole` nor ours, or poses of only some.
    """
    cameras = _cameras(document.mapping)
    for name, fields in document.mapping.items():
        if isinstance(fields, dict) and _NUMBERED(str(name)) and name not in cameras:
            raise ValueError(f"{name}: want intrinsics, with a camera_model or distortion_model, got none")
    poses = _poses(cameras)
    found = {name: _camera(name, fields, poses.get(name)) for name, fields in cameras.items()}
    unread = [
        f"{name}.{key}" for name, fields in cameras.items() if name not in poses for key in unread_poses(fields, set())
    ]
    return Found(found, unread=tuple(unread))


def write(path: Path, item: Camera | Calibration) -> dict[Path, str]:
    """Cameras with their poses, the world in the place of the IMU.

    Raises:
        ValueError: a lens that Kalibr does not have, skew, or no size.
    """
    lines: list[str] = []
    for i, camera in enumerate(cameras_of(item, "Kalibr")):
        pose = np.column_stack([camera.R.numpy(), camera.t.numpy()]).tolist()
        lines += [*camera_lines(i, camera, pose, "T_cam_imu"), f"  timeshift_cam_imu: {number_text(0.0)}"]
    return {path: "\n".join(lines) + "\n"}


def camera_lines(number: int, camera: Camera, pose: list[list[float]], key: str) -> list[str]:
    """The lines of one camera, with three rows of its pose under a key; without a pose where the key is empty.

    Raises:
        ValueError: a lens that Kalibr does not have, skew, or no size.
    """
    if camera.size is None:
        raise ValueError("size: want the size of the image, which Kalibr needs; Camera(..., size=(width, height))")
    if bool(camera.K[0, 1] != 0):
        raise ValueError(f"K: want no skew, which Kalibr does not hold, got {float(camera.K[0, 1]):.3g} px; use .json")
    model = "equidistant" if is_fisheye(camera) else "none" if camera.distortion is None else "radtan"
    lens = coefficients(camera) if model != "radtan" else first_brown(camera, 4, "Kalibr's radtan")
    (f_x, _, c_x), (_, f_y, c_y), _ = camera.K.tolist()
    lines = [f"cam{number}:"]
    if key:
        lines += [f"  {key}:", *(f"  - {numbers_text(row)}" for row in [*pose, [0.0, 0.0, 0.0, 1.0]])]
    lines += ["  cam_overlaps: []", "  camera_model: pinhole", f"  distortion_coeffs: {numbers_text(lens)}"]
    lines += [f"  distortion_model: {model}", f"  intrinsics: {numbers_text([f_x, f_y, c_x, c_y])}"]
    lines += [f"  resolution: [{camera.size[0]}, {camera.size[1]}]", f"  rostopic: /cam{number}/image_raw"]
    return lines


def _cameras(tree: dict[str, Any]) -> dict[str, dict[str, Any]]:
    def fits(fields: Any) -> bool:
        return (
            isinstance(fields, dict)
            and isinstance(fields.get("intrinsics"), list)
            and ("camera_model" in fields or "distortion_model" in fields)
        )

    if fits(tree):
        return {"cam0": tree}
    held = {name: fields for name, fields in tree.items() if fits(fields)}
    return dict(sorted(held.items(), key=lambda item: _number(item[0]) or 0)) if all(map(_NUMBERED, held)) else held


def _number(name: str) -> int | None:
    """The number of a camera that is called `cam10` or the like."""
    found = _NUMBERED(name)
    return None if found is None else int(found[1])


def _camera(name: str, fields: dict[str, Any], pose: Pose | None) -> Camera:
    model = fields.get("camera_model", "pinhole")
    if model != "pinhole" and str(model) in KINDS_BY_NAME:
        raise ValueError(
            f"{name}, camera_model: want pinhole, got the lens {model!r}; write camera_model: pinhole, and this as "
            "distortion_model"
        )
    if model != "pinhole":
        raise ValueError(
            f"{name}, camera_model: want pinhole, got {model!r}, whose equations no lens of this package has; "
            "calibrate with pinhole-radtan or pinhole-equi"
        )
    if "distortion_model" not in fields:
        raise ValueError(f"{name}: want a distortion_model, got none")
    kind = kind_of(f"{name}, distortion_model", fields["distortion_model"])
    key = "distortion_coeffs" if "distortion_coeffs" in fields else "distortion_coefficients"
    for other, value in fields.items():
        if other not in (key, "distortion_model"):
            check_no_lens_key(other, value)
    if key not in fields and kind != "none":
        raise ValueError(f"{name}: want distortion_coeffs, got none")
    lens = matrix(f"{name}, {key}", fields.get(key, [])).ravel().tolist()
    if kind is None or (kind == "brown" and len(lens) not in (4, 5)) or (kind == "fisheye" and len(lens) != 4):
        raise ValueError(f"{name}, {key}: want 4 coefficients of {fields['distortion_model']}, got {len(lens)}")
    f_x, f_y, c_x, c_y = vector(f"{name}, intrinsics", fields["intrinsics"], (4,))
    width, height = None, None
    if fields.get("resolution") is not None:
        width, height = vector(f"{name}, resolution", fields["resolution"], (2,))
    size = image_size(width, height, f"{name}, resolution")
    return camera_of(focal_lengths(f_x, f_y, c_x, c_y), lens_of(kind, lens), size, pose)


def _poses(cameras: dict[str, dict[str, Any]]) -> dict[str, Pose]:
    """The poses by name; empty where the file has none."""
    poses: dict[str, Pose] = {}
    before: Pose | None = None
    names = list(cameras)
    for i, (name, fields) in enumerate(cameras.items()):
        own = _own_pose(name, fields)
        if own is None and fields.get("T_cn_cnm1") is not None:
            if i == 0:
                raise ValueError(f"{name}, T_cn_cnm1: want a camera before the first one, got none")
            number = _number(name)
            if number is not None and _number(names[i - 1]) not in (None, number - 1):
                raise ValueError(f"{name}, T_cn_cnm1: want cam{number - 1}, from which it leads, got none")
            R, t = rigid(f"{name}, T_cn_cnm1", fields["T_cn_cnm1"])
            R_before, t_before = (np.eye(3), np.zeros(3)) if before is None else before
            if before is None and i > 1:
                raise ValueError(f"{name}, T_cn_cnm1: want a pose of the camera before, got none")
            if before is None:
                poses[next(iter(cameras))] = np.eye(3), np.zeros(3)
            own = R @ R_before, R @ t_before + t
        if own is not None:
            poses[name] = own
        before = own
    if poses and len(poses) < len(cameras):
        bare = ", ".join(name for name in cameras if name not in poses)
        raise ValueError(f"{bare}: want T_cam_imu or T_cn_cnm1 as the other cameras have, got neither")
    return poses


def _own_pose(name: str, fields: dict[str, Any]) -> Pose | None:
    for key, value in fields.items():
        if value is None or key == "T_cn_cnm1" or not (key.startswith("T_") or "_T_" in key):
            continue
        if key in INTO_CAMERA:
            return rigid(f"{name}, {key}", value)
        if key in FROM_CAMERA or key.startswith("body_T_cam"):
            return inverse(rigid(f"{name}, {key}", value))
        raise ValueError(
            f"{name}, {key}: want T_cam_imu or T_imu_cam as the pose, got a transformation of another name"
        )
    return None
