"""Open3D's pinhole cameras: `PinholeCameraIntrinsic`, `PinholeCameraParameters` and trajectories of these.

Matrices run column by column: `intrinsic_matrix` is f_x 0 0 0 f_y 0 c_x c_y 1. `extrinsic` is world to camera. Integer
pixel centres; there is no lens.
"""

from typing import Any

import numpy as np

from diffproj.files.document import Document
from diffproj.files.found import Found, one_or_more
from diffproj.files.named import check_without_lens
from diffproj.files.numbers import camera_of, image_size, intrinsics, rigid, vector
from diffproj.geometry.camera import Camera

KEYS = ("width", "height", "intrinsic_matrix", "class_name")


def recognises(document: Document) -> bool:
    """Whether it says so in `class_name`, or has nine numbers as `intrinsic_matrix` beside `width` and `height`."""
    tree = document.mapping
    known = str(tree.get("class_name", "")).startswith("PinholeCamera")
    return known or (_is_intrinsic(tree) and not set(tree) - {"width", "height", "intrinsic_matrix"})


def read(document: Document) -> Found:
    """The camera, or those of a trajectory by their numbers.

    Raises:
        ValueError: something is missing or not understood.
    """
    tree = document.mapping
    if _is_intrinsic(tree):
        return Found({"camera": _camera(tree, None)})
    several = tree.get("parameters", [tree])
    if not isinstance(several, list):
        raise ValueError("parameters: want a list of cameras, got something else")
    cameras = {str(i): _camera(fields["intrinsic"], fields["extrinsic"]) for i, fields in enumerate(several)}
    return one_or_more(cameras, "parameters: want at least one camera, got none")


def _is_intrinsic(fields: Any) -> bool:
    return isinstance(fields, dict) and isinstance(fields.get("intrinsic_matrix"), list) and "width" in fields


def _camera(fields: dict[str, Any], extrinsic: Any) -> Camera:
    check_without_lens(fields, KEYS, "Open3D")
    K = np.array(vector("intrinsic_matrix", fields["intrinsic_matrix"], (9,))).reshape(3, 3).T
    pose = None
    if extrinsic is not None:
        pose = rigid("extrinsic", np.array(vector("extrinsic", extrinsic, (16,))).reshape(4, 4).T)
    size = image_size(fields.get("width"), fields.get("height"))
    return camera_of(intrinsics("intrinsic_matrix", K), None, size, pose)
