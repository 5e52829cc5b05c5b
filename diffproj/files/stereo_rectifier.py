"""The raw cameras of a stereo pair, which settings have beside the rectified one: of ORB-SLAM2 and of stella.

`LEFT.K`, `LEFT.D`, `LEFT.R` and `RIGHT.K`, ... in the former; `K_left`, `D_left`, `R_left`, ... in the latter's mapping
`StereoRectifier`, whose `model` is that of the raw lenses. `R` turns a raw camera into its rectified one. The right
rectified camera stands beside the left one, along x, by `bf` (`Camera.bf`, `focal_x_baseline`) over the focal length.
"""

from typing import Any

import numpy as np

from diffproj.files.lenses import kind_of, lens_of
from diffproj.files.numbers import camera_of, image_size, intrinsics, matrix, number, rotation, square
from diffproj.geometry.camera import Camera

BASELINES = ("Camera.bf", "bf", "focal_x_baseline")


def raw_sides(tree: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """K, D, R and what else there is of `left` and `right`; empty where the settings have no such pair."""
    found: dict[str, dict[str, Any]] = {}
    rectifier = tree.get("StereoRectifier")
    for side in ("left", "right"):
        fields = {}
        for key in ("K", "D", "R", "width", "height"):
            if f"{side.upper()}.{key}" in tree:
                fields[key] = tree[f"{side.upper()}.{key}"]
            elif isinstance(rectifier, dict) and f"{key}_{side}" in rectifier:
                fields[key] = rectifier[f"{key}_{side}"]
        if "K" in fields:
            found[side] = fields
    return found


def raw_cameras(tree: dict[str, Any], fields: dict[str, Any], rectified: Camera) -> dict[str, Camera]:
    """The raw cameras by their sides, the right one at its place beside the left one.

    Args:
        tree: of the settings.
        fields: those of the rectified camera, with the baseline.
        rectified: the camera of the rectified images, whose size the raw ones have where they have none of their own.

    Raises:
        ValueError: something is missing, or not understood.
    """
    sides = raw_sides(tree)
    for side in ("left", "right"):
        missing = [key for key in ("K", "D", "R") if key not in sides.get(side, {})]
        if missing:
            raise ValueError(f"{side} camera: want K, D and R before rectification, got no {' and no '.join(missing)}")
    baselines = [number(key, holder[key]) for holder in (tree, fields) for key in BASELINES if key in holder]
    if not baselines:
        raise ValueError("want bf, baseline times focal length, beside the cameras before rectification, got none")
    shift = np.array([-baselines[0] / rectified.K[0, 0].item(), 0.0, 0.0])
    turns = {side: rotation(f"{side} R", square(f"{side} R", sides[side]["R"], 3, 3)) for side in sides}
    pose = turns["right"].T @ turns["left"], turns["right"].T @ shift
    rectifier = tree.get("StereoRectifier")
    model = rectifier.get("model") if isinstance(rectifier, dict) else None
    kind = (None if model is None else kind_of("StereoRectifier, model", model)) or "brown"
    cameras = {}
    for side, own in sides.items():
        lens = lens_of(kind, matrix(f"{side} D", own["D"]).ravel().tolist())
        size = image_size(own.get("width"), own.get("height"), f"{side} size") or rectified.size
        K = intrinsics(f"{side} K", square(f"{side} K", own["K"], 3, 3))
        cameras[side] = camera_of(K, lens, size, pose if side == "right" else None)
    return cameras
