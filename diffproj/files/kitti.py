"""KITTI: `calib.txt` of the odometry, object and tracking sets, and `calib_cam_to_cam.txt` of the raw ones.

`P0` to `P3` are of rectified images: K is the left 3 x 3 numbers, there is no lens, and `t = K^-1 P[:, 3]` from the
rectified camera 0, the world. In the raw sets `K_0x` and `D_0x` hold for raw images, with the pose `R_0x T_0x` from
camera 0; the rectified ones are to be asked for, by `camera="P_rect_02"`. A `calib.txt` does not tell the size.
"""

import re

import numpy as np

from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.lenses import brown
from diffproj.files.numbers import camera_of, image_size, intrinsics, rigid, square, vector
from diffproj.geometry.camera import Camera

_LINE = re.compile(r"([A-Za-z][\w ]*?)\s*:\s*(.*)|([A-Za-z]\w*)((?:\s+[-+.\deE]+)+)")
"""A name, a colon and what follows, or as in the tracking set's `R_rect` and `Tr_velo_cam`, numbers without a colon."""


def recognises(document: Document) -> bool:
    """Whether it has lines `P0:` or `P_rect_00:` of 12 numbers."""
    return re.search(r"^(P[0-3]|P_rect_\d\d):([ \t]+[-+.\deE]+){3}", document.text or "", re.MULTILINE) is not None


def read(document: Document) -> Found:
    """The cameras by their names in the file.

    Raises:
        ValueError: a line is damaged.
    """
    fields: dict[str, list[float]] = {}
    for line in (document.text or "").splitlines():
        parts = _LINE.fullmatch(line.strip())
        if parts is None:
            if line.strip():
                raise ValueError(f"want lines of a name, a colon and numbers, got {line[:60]!r}")
            continue
        name, content = parts[1] or parts[3], parts[2] or parts[4] or ""
        if name in fields:
            raise ValueError(f"{name}: want the line once, got it twice")
        fields[name] = _floats(name, content)
    for name in fields:
        if re.fullmatch(r"[DRT]_\d\d", name) and f"K_{name[2:]}" not in fields:
            raise ValueError(f"K_{name[2:]}: want the camera matrix beside {name}, got none")
    rectified = {name: _rectified(name, fields) for name in fields if re.fullmatch(r"P\d|P_rect_\d\d", name)}
    raw = {name[2:]: _raw(name[2:], fields) for name in fields if re.fullmatch(r"K_\d\d", name)}
    return Found(raw, rectified) if raw else Found(rectified)


def _rectified(name: str, fields: dict[str, list[float]]) -> Camera:
    P = square(name, fields[name], 3, 4)
    K = intrinsics(name, P[:, :3])
    number = name.removeprefix("P_rect_")
    size = image_size(*_pair(f"S_rect_{number}", fields))
    return camera_of(K, None, size, (np.eye(3), np.linalg.solve(K, P[:, 3])))


def _raw(number: str, fields: dict[str, list[float]]) -> Camera:
    missing = [key for key in ("D", "R", "T", "S") if f"{key}_{number}" not in fields]
    if missing:
        raise ValueError(f"K_{number}: want {', '.join(f'{key}_{number}' for key in missing)} with it, got none")
    K = intrinsics(f"K_{number}", fields[f"K_{number}"])
    lens = brown(vector(f"D_{number}", fields[f"D_{number}"], (5,)))
    R = square(f"R_{number}", fields[f"R_{number}"], 3, 3)
    t = vector(f"T_{number}", fields[f"T_{number}"], (3,))
    return camera_of(K, lens, image_size(*_pair(f"S_{number}", fields)), rigid(f"R_{number}", np.column_stack([R, t])))


def _pair(name: str, fields: dict[str, list[float]]) -> tuple[float | None, float | None]:
    if name not in fields:
        return None, None
    width, height = vector(name, fields[name], (2,))
    return width, height


def _floats(name: str, text: str) -> list[float]:
    """The numbers of a line; empty where it is text, as of `calib_time`."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        if re.fullmatch(r"P\d|(P_rect|K|D|R|T|S|S_rect|R_rect)_\d\d", name):
            raise ValueError(f"{name}: want numbers, got {text[:40]!r}") from None
        return []
