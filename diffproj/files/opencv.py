"""OpenCV's YAML, XML and JSON, and the same without OpenCV's tags: K, lens and size under the names of `named.py`.

Written are the keys that OpenCV's own calibration program writes. Read are also those of its stereo program, whose `R`
and `T` place the second camera beside the first, and of files that hold cameras in mappings of their own, or in a list
of them. Integer pixel centres; coefficients in OpenCV's order; a fisheye lens only where the file says so.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from diffproj.calibration.results.calibration import Calibration
from diffproj.files import named, poses_beside
from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.writing import check_not_mirrored
from diffproj.geometry.camera import Camera
from diffproj.lens.kannala_brandt import KannalaBrandt


def recognises(document: Document) -> bool:
    """Whether K stands in it, or in a mapping of it, under a known name."""
    try:
        return bool(_holders(document.tree))
    except ValueError:
        return False


def read(document: Document) -> Found:
    """The cameras of the file.

    Raises:
        ValueError: there is none, or something about it is not understood.
    """
    holders = _holders(document.tree)
    if list(holders) == [""] or not holders:
        tree = document.tree
        return named.read(tree if isinstance(tree, dict) else {})
    named.check_no_lens(document.tree, list(holders.values()))
    cameras: dict[str, Camera] = {}
    unread: list[str] = []
    remarks: list[str] = []
    placed = False
    for name, holder in holders.items():
        found = named.read(holder)
        for inner, camera in found.cameras.items():
            cameras[name if inner == "camera" else f"{name} {inner}"] = camera
        unread += [f"{name}.{key}" for key in found.unread]
        remarks += [f"{name}, {remark}" for remark in found.remarks]
        placed |= poses_beside.of(len(found.cameras), holder)[0] is not None
    if isinstance(document.tree, dict):
        # A pose of the file's own would overwrite those of its cameras, whose common frame it does not tell.
        cameras, keys = (cameras, set()) if placed else named.posed(cameras, document.tree, apart=True)
        unread += poses_beside.unread(document.tree, keys | {*holders, "cameras"})
    return Found(cameras, unread=tuple(unread), remarks=tuple(remarks))


def _holders(tree: Any) -> dict[str, dict[str, Any]]:
    """The mappings that hold a K: the file's own, by the name `""`, or those in it by their names."""
    if isinstance(tree, dict):
        if named.holds_matrix(tree):
            return {"": tree}
        held = {str(key): value for key, value in tree.items() if isinstance(value, dict) and named.holds_matrix(value)}
        if held or not isinstance(tree.get("cameras"), list):
            return held
        tree = tree["cameras"]
    items = enumerate(tree) if isinstance(tree, list) else ()
    found = ((str(item.get("name", item.get("id", i))), item) for i, item in items if isinstance(item, dict))
    holders: dict[str, dict[str, Any]] = {}
    for name, item in found:
        if named.holds_matrix(item):
            if name in holders:
                raise ValueError(f"{name}: want each camera once, got two of the name")
            holders[name] = item
    return holders


def write(path: Path, item: Camera | Calibration) -> dict[Path, str]:
    """One camera, as XML or JSON where the suffix says so; of a calibration also poses, their unit and errors.

    Raises:
        ValueError: a batch of cameras, a pose, skew or a lens that OpenCV does not have.
    """
    camera = item.camera if isinstance(item, Calibration) else item
    if camera.batch_shape:
        raise ValueError(
            f"OpenCV's formats hold one camera, got batch shape {tuple(camera.batch_shape)}; "
            "use .json, or save them one by one"
        )
    K, dist, rvec, tvec = camera.to_opencv()
    if rvec.any() or tvec.any():
        remedy = "camera.without_pose()"
        if not np.array_equal(K, camera.K.numpy(force=True)):  # of a turned image: OpenCV's camera is turned instead
            remedy = "camera.upright().without_pose(), whose axes are those of the turned image"
        raise ValueError(f"OpenCV's formats hold no pose; use .json, or save {remedy}")
    check_not_mirrored(camera.detach().upright(), "OpenCV")
    suffix = path.suffix.lower() if path.suffix.lower() in (".xml", ".json") else ".yml"
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    if camera.size is not None:
        storage.write("image_width", camera.size[0])
        storage.write("image_height", camera.size[1])
    storage.write("camera_matrix", K)
    storage.write("fisheye_model", int(isinstance(camera.distortion, KannalaBrandt)))
    if dist.size:
        storage.write("distortion_coefficients", dist.reshape(-1, 1))
    if isinstance(item, Calibration):
        _, _, rvecs, tvecs = item.cameras.to_opencv()
        storage.write("nframes", len(item.views))
        if item.unit is not None:  # of the translations
            storage.write("world_unit", item.unit)
        storage.write("extrinsic_parameters", np.concatenate([rvecs, tvecs], axis=-1))
        storage.write("avg_reprojection_error", float(item.rms))
        storage.write("per_view_reprojection_errors", item.view_rms.numpy().reshape(-1, 1))
    return {path: storage.releaseAndGetString()}
