"""Rigs, written: to this package's own JSON all of it, to other formats the cameras at their places.

* OpenCV's stereo file, for a pair: `M1 D1 M2 D2`, and `R`, `T` from the first camera to the second.
* Kalibr's `camchain.yaml`: `cam0`, `cam1`, ... in the rig's order, with `T_cn_cnm1` from the camera before.
* COLMAP's `rigs.txt` or `rigs.bin` (since its version 3.12), with the files beside that make a model which it reads:
  the cameras, in the rig's order with ids from 1; a frame for each moment, whose world is the target; and the images
  by their cameras' names, `left/left01.jpg`.

`load_camera(path, camera=...)` reads the cameras of all of them.
"""

from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import torch

from diffproj._core.arguments import choice
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.files import colmap, colmap_records, colmap_rig_records, kalibr, own_json
from diffproj.files.colmap_records import ImageRecord
from diffproj.files.colmap_rig_records import FrameRecord, RigRecord, SensorRecord
from diffproj.files.names import FormatName
from diffproj.geometry.camera import Camera
from diffproj.lens.kannala_brandt import KannalaBrandt

WRITTEN = ("json", "opencv", "kalibr", "colmap")
SUFFIXES = {".json": "json", ".txt": "colmap", ".bin": "colmap"} | dict.fromkeys((".yaml", ".yml", ".xml"), "opencv")


def write(path: Path, rig: RigCalibration, name: FormatName | None) -> dict[Path, str] | dict[Path, bytes]:
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
    if found == "colmap":
        return _model(path, rig)
    cameras = [camera.detach().to("cpu", torch.float64) for camera in rig.cameras.values()]
    return _stereo(path, cameras) if found == "opencv" else _chain(path, cameras)


def _model(path: Path, rig: RigCalibration) -> dict[Path, str] | dict[Path, bytes]:
    """COLMAP's model: the rig, its frames, and what they refer to."""
    if path.name not in ("rigs.txt", "rigs.bin"):
        raise ValueError(f"want rigs.txt or rigs.bin for a rig, as COLMAP calls them, got {path.name}")
    ids = {name: str(number) for number, name in enumerate(rig.names, 1)}
    cameras, sensors, taken = [], [], {}
    images: list[ImageRecord] = []
    for name, camera in rig.cameras.items():
        camera = camera.detach().to("cpu", torch.float64)
        cameras.append(colmap.record_of(camera)._replace(id_=ids[name]))
        place = None if name == rig.names[0] else colmap.pose_of(camera.R, camera.t)
        sensors.append(SensorRecord("CAMERA", ids[name], place))
        one = rig.calibrations[name]
        posed = one.cameras.detach().to("cpu", torch.float64)
        for view in one.used.any(-1).nonzero().flatten().tolist():
            called = f"{name}/{one.views.names[view].removeprefix(f'{name}/')}"
            if len(called.splitlines()) != 1:
                raise ValueError(f"want names of images on one line, which COLMAP needs, got {called!r}")
            images.append(ImageRecord(called, colmap.pose_of(posed.R[view], posed.t[view]), ids[name]))
            taken.setdefault(int(rig.where[name][view]), []).append((ids[name], str(len(images))))
    R, t = (part.detach().to("cpu", torch.float64) for part in (rig.R_target, rig.t_target))
    frames = [FrameRecord("1", colmap.pose_of(R[moment], t[moment]), taken[moment]) for moment in sorted(taken)]
    rigs = [RigRecord("1", sensors)]
    if path.suffix == ".txt":
        return colmap.model_of(
            path,
            colmap_records.cameras_to_text(cameras),
            colmap_rig_records.rigs_to_text(rigs),
            frames=colmap_rig_records.frames_to_text(frames),
            images=colmap_records.images_to_text(images),
        )
    return colmap.model_of(
        path,
        colmap_records.cameras_to_bytes(cameras),
        colmap_rig_records.rigs_to_bytes(rigs),
        frames=colmap_rig_records.frames_to_bytes(frames),
        images=colmap_records.images_to_bytes(images),
    )


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
