"""nuScenes' `calibrated_sensor.json`, and Argoverse's `vehicle_calibration_info.json`.

Rotation (w x y z) and translation are sensor to vehicle, so that the world is the vehicle. nuScenes' images are
undistorted, and 1600 x 900, which the file does not say; other sensors have no `camera_intrinsic`. nuImages, whose
images are as they were taken, adds `camera_distortion`: k1 k2 p1 p2 k3, and of fisheyes a sixth, a factor of r^8, which
OpenCV's lens lacks. Argoverse's lens has three radial coefficients; its image size is not in the file either.
"""

from typing import Any

import numpy as np

from diffproj.files.document import Document
from diffproj.files.found import Found, one_or_more
from diffproj.files.lenses import brown, unused
from diffproj.files.named import check_without_lens
from diffproj.files.numbers import camera_of, focal_lengths, from_quaternion, intrinsics, inverse, vector
from diffproj.geometry.camera import Camera


def recognises(document: Document) -> bool:
    """Whether it is a list of sensors with `camera_intrinsic`, or one at its pose, or Argoverse's `camera_data_`."""
    try:
        tree = document.tree
    except ValueError:
        return False
    return bool(_sensors(tree)) or (isinstance(tree, dict) and isinstance(tree.get("camera_data_"), list))


def read(document: Document) -> Found:
    """The cameras, by token or by name.

    Raises:
        ValueError: a sensor is damaged, or there is no camera.
    """
    tree = document.tree
    cameras: dict[str, Camera] = {}
    sensors = _sensors(tree)
    for i, fields in enumerate(sensors or tree["camera_data_"]):
        if sensors and fields.get("camera_intrinsic") == []:
            continue
        name = str(fields.get("token", fields.get("channel", i)) if sensors else fields["key"])
        if name in cameras:
            raise ValueError(f"{name}: want each sensor once, got it twice")
        cameras[name] = _nuscenes(name, fields) if sensors else _argoverse(fields["value"])
    return one_or_more(cameras, "want a sensor with a camera_intrinsic, got none")


def _sensors(tree: Any) -> list[dict[str, Any]]:
    alone = isinstance(tree, dict) and ("rotation" in tree or "translation" in tree)
    items = [tree] if alone else tree if isinstance(tree, list) else []
    fits = [item for item in items if isinstance(item, dict) and "camera_intrinsic" in item]
    return fits if len(fits) == len(items) else []


def _nuscenes(name: str, fields: dict[str, Any]) -> Camera:
    for key in ("rotation", "translation"):
        if key not in fields:
            raise ValueError(f"{name}: want {key}, got none")
    pose = _pose(fields["rotation"], fields["translation"])
    check_without_lens(fields, ("camera_intrinsic", "camera_distortion"), "nuScenes")
    lens = None
    if fields.get("camera_distortion"):
        found = vector("camera_distortion", fields["camera_distortion"], (5, 6))
        unused(
            "camera_distortion, k4", found[5] if len(found) == 6 else None, "it is a factor of r^8, as no lens here has"
        )
        lens = brown(found[:5])
    return camera_of(intrinsics("camera_intrinsic", fields["camera_intrinsic"], skew=True), lens, None, pose)


def _argoverse(fields: dict[str, Any]) -> Camera:
    x, y = (f"focal_length_{axis}_px_" for axis in "xy")
    c_x, c_y = (f"focal_center_{axis}_px_" for axis in "xy")
    K = focal_lengths(fields[x], fields[y], fields[c_x], fields[c_y], fields["skew_"])
    k1, k2, k3 = vector("distortion_coefficients_", fields["distortion_coefficients_"], (3,))
    place = fields["vehicle_SE3_camera_"]
    pose = _pose(place["rotation"]["coefficients"], place["translation"])
    return camera_of(K, brown([k1, k2, 0.0, 0.0, k3]), None, pose)


def _pose(rotation: Any, translation: Any) -> tuple[np.ndarray, np.ndarray]:
    R = from_quaternion("rotation", *vector("rotation", rotation, (4,)))
    return inverse((R, np.array(vector("translation", translation, (3,)))))
