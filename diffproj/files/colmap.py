"""COLMAP: `cameras` for lenses, `images` for poses, and `rigs` for places in a rig, each as `.txt` and as `.bin`.

The first pixel's centre is at 0.5: `c_here = c_colmap - 0.5`. Poses are world to camera, in OpenCV's axes. Of the
models those that equal OpenCV's are read; THIN_PRISM_FISHEYE is not OpenCV's prism, FOV and others are other lenses.

Of `cameras` the names are the ids, and the cameras have no pose; of `images`, the file names of the images. Of `rigs`
they are the ids, or where `images` beside has the images of each camera in a folder of its own, these folders. `images`
and `rigs` need `cameras` beside. Saved as `images`, cameras bring their `cameras` and an empty `points3D` along, which
make a model that COLMAP reads; how a rig is saved, `rigs.py` says.
"""

import re
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from torch import Tensor

from diffproj.calibration.results.calibration import Calibration
from diffproj.files import colmap_records, colmap_rig_records
from diffproj.files.colmap_records import MODELS, NOTICE, CameraRecord, ImageRecord
from diffproj.files.document import Document
from diffproj.files.found import Found, one_or_more
from diffproj.files.lenses import brown, coefficients, first_brown, fisheye, is_fisheye
from diffproj.files.numbers import camera_of, focal_lengths, from_quaternion, image_size, number
from diffproj.files.writing import cameras_of, has_pose
from diffproj.geometry.camera import Camera

Content = TypeVar("Content", str, bytes)

OURS = frozenset(name for name, _ in MODELS) - {"FOV", "THIN_PRISM_FISHEYE"}
_CAMERA = re.compile(r"\d+\s+[A-Z][A-Z0-9_]+(\s+[-+.\w]+)+\s*")
_RIG = re.compile(r"\d+\s+\d+\s+(CAMERA|IMU)\s+\d+(\s.*)?")
_IMAGE = re.compile(r"\d+(\s+[-+.\deE]+){7}\s+\d+\s+\S.*")


def recognises(document: Document) -> bool:
    """Whether it is one of them, by its name where it is binary, by its first line of content otherwise."""
    if document.text is None:
        return document.path.suffix.lower() == ".bin"
    if re.match(r"# (Camera list with one line|Image list with two lines|Rig calib list|Frame list)", document.text):
        return True
    line = _first_line(document.text)
    return any(bool(pattern.fullmatch(line)) for pattern in (_CAMERA, _IMAGE, _RIG))


def read(document: Document) -> Found:
    """The cameras of `cameras`, without pose, or the posed ones of `images`.

    Raises:
        ValueError: a lens that is none of this package's, the file of the cameras is not beside `images`, or damage.
    """
    if _is_frames(document):
        suffix = document.path.suffix
        raise ValueError(
            f"want cameras, got where a rig stood; images{suffix} has their poses, rigs{suffix} the places"
        )
    if _is_rigs(document):
        return one_or_more(_rig(document), "want at least one rig, got none")
    if not _is_images(document):
        return one_or_more(_cameras(document), "want at least one camera, got none")
    name, cameras, posed = *_cameras_beside(document), {}
    for record in _images(document):
        if record.camera not in cameras:
            raise ValueError(f"{record.name}: want a camera of {name}, got the id {record.camera}")
        if record.name in posed:
            raise ValueError(f"{record.name}: want each image once, got it twice")
        intrinsic = cameras[record.camera]
        posed[record.name] = camera_of(intrinsic.K.numpy(), intrinsic.distortion, intrinsic.size, _pose(record))
    return one_or_more(posed, "want at least one image, got none")


def write(path: Path, item: Camera | Calibration) -> dict[Path, str] | dict[Path, bytes]:
    """Cameras as `cameras`, or with their poses as `images`, in text or, with the suffix `.bin`, in bytes.

    Raises:
        ValueError: a pose to `cameras`, a lens that COLMAP does not have, no size, or files of another model that would
            be lost.
    """
    suffix = path.suffix.lower()
    if suffix not in (".txt", ".bin"):
        raise ValueError(f"want the suffix .txt or .bin of COLMAP's files, got {path.suffix or 'none'}")
    cameras, posed = cameras_of(item, "COLMAP"), "images" in path.stem
    if not posed and any(map(has_pose, cameras)):
        raise ValueError(
            f"want cameras without a pose, which cameras{suffix} does not hold; save images{suffix}, or without_pose()"
        )
    found = [record_of(camera) for camera in cameras]
    listed = [one for i, one in enumerate(found) if not posed or one not in found[:i]]
    numbered = [one._replace(id_=str(i)) for i, one in enumerate(listed, 1)]
    images = []
    for i, (camera, record) in enumerate(zip(cameras, found, strict=True)):
        images.append(ImageRecord(f"{i:06d}.png", pose_of(camera.R, camera.t), str(listed.index(record) + 1)))
    if posed:
        rigs = [file for name in ("rigs", "frames") if (file := path.with_name(f"{name}{suffix}")).exists()]
        if rigs:
            raise ValueError(
                f"want a folder without the {rigs[0].name} of another model, got one; choose another folder"
            )
    if suffix == ".txt":
        text = colmap_records.cameras_to_text(numbered)
        return model_of(path, text, colmap_records.images_to_text(images)) if posed else {path: text}
    data = colmap_records.cameras_to_bytes(numbered)
    return model_of(path, data, colmap_records.images_to_bytes(images)) if posed else {path: data}


def model_of(path: Path, cameras: Content, main: Content, **others: Content) -> dict[Path, Content]:
    """A model of `path`, which is written over, and the files beside it: cameras, an empty points3D, and others.

    Raises:
        ValueError: beside it are files of another model. Those in bytes have no place for a notice: none is written
            over unless it is the same.
    """
    points: Any = bytes(8) if isinstance(cameras, bytes) else f"# 3D point list\n{NOTICE}\n"
    beside = {"cameras": cameras, "points3D": points, **others}
    files = {path.with_name(f"{name}{path.suffix}"): content for name, content in beside.items()}
    for file, content in files.items():
        if not file.exists():
            continue
        if isinstance(content, bytes):
            own = file.read_bytes() == content
        else:
            own = NOTICE in file.read_text(encoding="utf-8", errors="replace")[:200]
        if not own:
            raise ValueError(f"want a folder without the {file.name} of another model, got one; choose another folder")
    return {**files, path: main}


def pose_of(R: Tensor, t: Tensor) -> list[float]:
    """A pose as COLMAP writes it: qw qx qy qz tx ty tz."""
    q = rotation_matrix_to_quaternion(R)
    return [*(q / q.norm()).tolist(), *t.tolist()]


def camera_from(model: str, width: Any, height: Any, parameters: list[float]) -> Camera:
    """A camera of COLMAP's model, without pose.

    Raises:
        ValueError: a model that is none of this package's, or another number of parameters.
    """
    if model not in OURS:
        raise ValueError(
            f"{model}: want one of COLMAP's models that equal OpenCV's, got another; undistort with colmap "
            "image_undistorter, or estimate again with --ImageReader.camera_model OPENCV"
        )
    count = dict(MODELS)[model]
    if len(parameters) != count:
        raise ValueError(f"{model}: want {count} parameters, got {len(parameters)}")
    one_focal = model.startswith(("SIMPLE", "RADIAL"))
    f_x, f_y, c_x, c_y, *rest = [parameters[0], *parameters] if one_focal else parameters
    K = focal_lengths(f_x, f_y, number("c_x", c_x) - 0.5, number("c_y", c_y) - 0.5)
    k = [number(f"{model}, parameter", part) for part in rest]
    if model == "OPENCV_FISHEYE":
        lens = fisheye(k)
    elif model.endswith("RADIAL_FISHEYE"):
        lens = fisheye([*k, 0, 0, 0][:4])
    elif model.endswith("PINHOLE"):
        lens = None
    else:
        lens = brown([*k, 0, 0, 0][:4] if model.endswith("RADIAL") else k)
    size = image_size(width, height)
    if size is None:
        raise ValueError("size: want the size of the image, got 0 x 0")
    return camera_of(K, lens, size)


def record_of(camera: Camera) -> CameraRecord:
    """Model, size and parameters, without an id.

    Raises:
        ValueError: a lens that COLMAP does not have, no size, or a mirrored image.
    """
    if camera.size is None:
        raise ValueError("size: want the size of the image, which COLMAP needs; Camera(..., size=(width, height))")
    (f_x, _, c_x), (_, f_y, c_y), _ = camera.K.tolist()
    parameters = [f_x, f_y, c_x + 0.5, c_y + 0.5]
    if f_x <= 0 or f_y <= 0:
        raise ValueError("K: want positive focal lengths, which COLMAP needs, got a mirrored image")
    if camera.distortion is None:
        model = "PINHOLE"
    elif is_fisheye(camera):
        model, parameters = "OPENCV_FISHEYE", [*parameters, *coefficients(camera)]
    elif any(coefficients(camera)[4:]):
        model, parameters = "FULL_OPENCV", [*parameters, *first_brown(camera, 8, "COLMAP")]
    else:
        model, parameters = "OPENCV", [*parameters, *first_brown(camera, 4, "COLMAP")]
    return CameraRecord("", model, *camera.size, parameters)


def _is_images(document: Document) -> bool:
    if document.text is None:
        return "images" in document.path.name.lower()
    if document.text.startswith("# Image list"):
        return True
    line = _first_line(document.text)
    return not _CAMERA.fullmatch(line) and (bool(_IMAGE.fullmatch(line)) or "images" in document.path.name.lower())


def _is_rigs(document: Document) -> bool:
    if document.text is None:
        return "rigs" in document.path.name.lower()
    return document.text.startswith("# Rig calib list") or bool(_RIG.fullmatch(_first_line(document.text)))


def _is_frames(document: Document) -> bool:
    if document.text is None:
        return "frames" in document.path.name.lower()
    return document.text.startswith("# Frame list")


def _first_line(text: str) -> str:
    return next((line for line in text.splitlines() if line.strip() and line[0] != "#"), "")


def _cameras_beside(document: Document) -> tuple[str, dict[str, Camera]]:
    """The file with the lenses, and what it holds."""
    name = f"cameras{document.path.suffix}"
    beside = document.beside(name)
    if beside is None:
        raise ValueError(f"want {name} beside it, which holds K and the lenses, got none")
    return name, _cameras(beside)


def _rig(document: Document) -> dict[str, Camera]:
    """The cameras of the one rig that has several, at their places."""
    if document.text is None:
        records = colmap_rig_records.rigs_from_bytes(document.data)
    else:
        records = colmap_rig_records.rigs_from_text(document.text)
    several = [one for one in records if sum(sensor.kind == "CAMERA" for sensor in one.sensors) > 1]
    if records and len(several) != 1:
        remedy = "keep one of them in the file" if several else f"cameras{document.path.suffix} has them without a pose"
        raise ValueError(f"want one rig of several cameras, got {len(several)}; {remedy}")
    name, cameras = _cameras_beside(document)
    folders, found = _folders(document), {}
    for place, sensor in enumerate(several[0].sensors if several else ()):
        if sensor.kind != "CAMERA":
            continue
        if sensor.id_ not in cameras:
            raise ValueError(f"rig {several[0].id_}: want a camera of {name}, got the id {sensor.id_}")
        if place and sensor.pose is None:
            raise ValueError(f"rig {several[0].id_}: want the place of camera {sensor.id_}, got none")
        one, pose = cameras[sensor.id_], None
        if sensor.pose is not None:
            pose = _pose(ImageRecord(f"camera {sensor.id_}", sensor.pose, sensor.id_))
        called = folders.get(sensor.id_, sensor.id_)
        if called in found:
            raise ValueError(f"rig {several[0].id_}: want each camera once, got {called} twice")
        found[called] = one if pose is None else camera_of(one.K.numpy(), one.distortion, one.size, pose)
    return found


def _folders(document: Document) -> dict[str, str]:
    """By the camera's id the folder that holds its images and no other camera's, if each has one."""
    beside = document.beside(f"images{document.path.suffix}")
    folders: dict[str, set[str]] = {}
    for record in [] if beside is None else _images(beside):
        folders.setdefault(record.camera, set()).add(record.name.rpartition("/")[0])
    every = [folder for own in folders.values() for folder in own]
    told = all(every) and len(every) == len(folders) == len(set(every))
    return {camera: next(iter(own)) for camera, own in folders.items()} if told else {}


def _cameras(document: Document) -> dict[str, Camera]:
    if document.text is None:
        records = colmap_records.cameras_from_bytes(document.data)
    else:
        records = colmap_records.cameras_from_text(document.text)
    cameras: dict[str, Camera] = {}
    for id_, model, width, height, parameters in records:
        if id_ in cameras:
            raise ValueError(f"camera {id_}: want each id once, got it twice")
        cameras[id_] = camera_from(model, width, height, parameters)
    return cameras


def _images(document: Document) -> list[ImageRecord]:
    if document.text is None:
        return colmap_records.images_from_bytes(document.data)
    return colmap_records.images_from_text(document.text)


def _pose(record: ImageRecord) -> tuple[np.ndarray, np.ndarray]:
    R = from_quaternion(record.name, *record.pose[:4])
    return R, np.array([number(record.name, part) for part in record.pose[4:]])
