"""Rigs, written: to this package's own JSON all of it, to other formats the cameras at their places.

* OpenCV's stereo file, for a pair: `M1 D1 M2 D2`, and `R`, `T` from the first camera to the second.
* Kalibr's `camchain.yaml`: `cam0`, `cam1`, ... in the rig's order, with `T_cn_cnm1` from the camera before.

`load_camera(path, camera=...)` reads the cameras of all of them.
"""

from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import torch

from diffproj._core.arguments import choice
from diffproj.calibration.rig_result import RigCalibration
from diffproj.files import kalibr, own_json
from diffproj.files.names import FormatName
from diffproj.geometry.camera import Camera
from diffproj.lens.kannala_brandt import KannalaBrandt

WRITTEN = ("json", "opencv", "kalibr")
SUFFIXES = {".json": "json", ".yaml": "opencv", ".yml": "opencv", ".xml": "opencv"}


def write(path: Path, rig: RigCalibration, name: FormatName | None) -> dict[Path, str]:
    """The content of each file that is to be written.

    Raises:
        ValueError: the format holds no rigs, or not this one.
    """
    if name is not None:
        name = choice("format", name, get_args(FormatName))  # type: ignore[assignment]
    found = SUFFIXES.get(path.suffix.lower()) if name is None else name
    if found not in WRITTEN:
        raise ValueError(f"format: want {' or '.join(map(repr, WRITTEN))} for a rig, got {name or path.suffix!r}")
    if found == "json":
        return own_json.write(path, rig)
    cameras = [camera.detach().to("cpu", torch.float64) for camera in rig.cameras.values()]
    return _stereo(path, cameras) if found == "opencv" else _chain(path, cameras)


def _chain(path: Path, cameras: list[Camera]) -> dict[Path, str]:
    """Kalibr's chain, each camera from the one before."""
    lines: list[str] = []
    for i, camera in enumerate(cameras):
        before = cameras[i - 1] if i else None
        R = camera.R if before is None else camera.R @ before.R.T
        t = camera.t if before is None else camera.t - R @ before.t
        pose = [[*row, shift] for row, shift in zip(R.tolist(), t.tolist(), strict=True)]
        lines += kalibr.camera_lines(i, camera, pose, "T_cn_cnm1" if i else "")
    return {path: "\n".join(lines) + "\n"}


def _stereo(path: Path, cameras: list[Camera]) -> dict[Path, str]:
    """OpenCV's file of a pair."""
    if len(cameras) != 2:
        raise ValueError(f"OpenCV's stereo file holds two cameras, got {len(cameras)}; use .json or format='kalibr'")
    first, second = cameras
    if first.size != second.size:
        raise ValueError(f"OpenCV's stereo file holds one image size, got {first.size} and {second.size}; use .json")
    fisheye = [isinstance(camera.distortion, KannalaBrandt) for camera in cameras]
    if fisheye[0] != fisheye[1]:
        raise ValueError("OpenCV's stereo file holds one kind of lens, got a fisheye and another; use .json")
    suffix = path.suffix.lower() if path.suffix.lower() in (".xml", ".json") else ".yml"
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    if first.size is not None:
        storage.write("image_width", first.size[0])
        storage.write("image_height", first.size[1])
    storage.write("fisheye_model", int(fisheye[0]))
    for number, camera in enumerate(cameras, start=1):
        K, dist, _, _ = camera.without_pose().to_opencv()
        storage.write(f"M{number}", K)
        storage.write(f"D{number}", dist.reshape(1, -1) if dist.size else np.zeros((1, 4)))
    storage.write("R", (second.R @ first.R.T).numpy())
    storage.write("T", (second.t - second.R @ first.R.T @ first.t).numpy().reshape(3, 1))
    return {path: storage.releaseAndGetString()}
