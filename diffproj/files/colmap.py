"""COLMAP: `cameras.txt` and `cameras.bin` for lenses, `images.txt` and `images.bin` for poses with the cameras beside.

The first pixel's centre is at 0.5: `c_here = c_colmap - 0.5`. Poses are world to camera, in OpenCV's axes. Of the
models those that equal OpenCV's are read; THIN_PRISM_FISHEYE is not OpenCV's prism, FOV and others are other lenses.

Of `cameras` the names are the ids, and the cameras have no pose; of `images`, the file names of the images. Saved as
`images`, cameras bring their `cameras` and an empty `points3D` along, which make a model that COLMAP reads.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from kornia.geometry.conversions import rotation_matrix_to_quaternion

from diffproj.calibration.result import Calibration
from diffproj.files import colmap_records
from diffproj.files.colmap_records import MODELS, NOTICE, CameraRecord, ImageRecord
from diffproj.files.document import Document
from diffproj.files.found import Found, one_or_more
from diffproj.files.lenses import brown, coefficients, first_brown, fisheye, is_fisheye
from diffproj.files.numbers import camera_of, focal_lengths, from_quaternion, image_size, number
from diffproj.files.writing import cameras_of, has_pose
from diffproj.geometry.camera import Camera

OURS = frozenset(name for name, _ in MODELS) - {"FOV", "THIN_PRISM_FISHEYE"}
_CAMERA = re.compile(r"\d+\s+[A-Z][A-Z0-9_]+(\s+[-+.\w]+)+\s*")
_IMAGE = re.compile(r"\d+(\s+[-+.\deE]+){7}\s+\d+\s+\S.*")


def recognises(document: Document) -> bool:
    """Whether it is one of the four, by its name where it is binary, by its first line of content otherwise."""
    if document.text is None:
        return document.path.suffix.lower() == ".bin"
    if re.match(r"# (Camera list with one line|Image list with two lines)", document.text):
        return True
    line = next((line for line in document.text.splitlines() if line.strip() and line[0] != "#"), "")
    return bool(_CAMERA.fullmatch(line) or _IMAGE.fullmatch(line))


def read(document: Document) -> Found:
    """The cameras of `cameras`, without pose, or the posed ones of `images`.

    Raises:
        ValueError: a lens that is none of this package's, the file of the cameras is not beside `images`, or damage.
    """
    if not _is_images(document):
        return one_or_more(_cameras(document), "want at least one camera, got none")
    name = f"cameras{document.path.suffix}"
    beside = document.beside(name)
    if beside is None:
        raise ValueError(f"want {name} beside it, which holds K and the lenses, got none")
    cameras, posed = _cameras(beside), {}
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
    found = [_record(camera) for camera in cameras]
    listed = [one for i, one in enumerate(found) if not posed or one not in found[:i]]
    numbered = [one._replace(id_=str(i)) for i, one in enumerate(listed, 1)]
    images = []
    for i, (camera, record) in enumerate(zip(cameras, found, strict=True)):
        q = rotation_matrix_to_quaternion(camera.R)
        pose = [*(q / q.norm()).tolist(), *camera.t.tolist()]
        images.append(ImageRecord(f"{i:06d}.png", pose, str(listed.index(record) + 1)))
    return (
        _text_files(path, numbered, images, posed) if suffix == ".txt" else _binary_files(path, numbered, images, posed)
    )


def _text_files(path: Path, cameras: list[CameraRecord], images: list[ImageRecord], posed: bool) -> dict[Path, str]:
    """`cameras.txt`, or `images.txt` with the two files beside it that make a model."""
    text = colmap_records.cameras_to_text(cameras)
    if not posed:
        return {path: text}
    files = {path.with_name("cameras.txt"): text, path.with_name("points3D.txt"): f"# 3D point list\n{NOTICE}\n"}
    for file in files:
        if file.exists() and NOTICE not in file.read_text(encoding="utf-8", errors="replace")[:200]:
            raise ValueError(f"want a folder without the {file.name} of another model, got one; choose another folder")
    return {**files, path: colmap_records.images_to_text(images)}


def _binary_files(path: Path, cameras: list[CameraRecord], images: list[ImageRecord], posed: bool) -> dict[Path, bytes]:
    """The same in bytes, which have no place for a notice: nothing that is beside it is written over."""
    data = colmap_records.cameras_to_bytes(cameras)
    if not posed:
        return {path: data}
    files = {path.with_name("cameras.bin"): data, path.with_name("points3D.bin"): bytes(8)}
    for file, content in files.items():
        if file.exists() and file.read_bytes() != content:
            raise ValueError(f"want a folder without the {file.name} of another model, got one; choose another folder")
    return {**files, path: colmap_records.images_to_bytes(images)}


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


def _record(camera: Camera) -> CameraRecord:
    """Model, size and parameters, without an id."""
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
    line = next((line for line in document.text.splitlines() if line.strip() and line[0] != "#"), "")
    return not _CAMERA.fullmatch(line) and (bool(_IMAGE.fullmatch(line)) or "images" in document.path.name.lower())


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
