"""mrcal's `.cameramodel`: a Python literal with `lensmodel`, `intrinsics`, `extrinsics` and `imagersize`.

`intrinsics` are f_x f_y c_x c_y and OpenCV's coefficients in their order; `extrinsics`, now `rt_cam_ref`, are a
rotation vector and a translation from the reference frame, the world, to the camera. Integer pixel centres. Splined
models, CAHVOR and stereographic ones are other lenses.
"""

import ast
import re
import warnings

import cv2
import numpy as np

from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.lenses import brown
from diffproj.files.numbers import camera_of, focal_lengths, image_size, vector

COUNTS = {f"LENSMODEL_{name}": count for name, count in (("PINHOLE", 0), *((f"OPENCV{n}", n) for n in (4, 5, 8, 12)))}
MOST_CHARACTERS = 2**24


def recognises(document: Document) -> bool:
    """Whether it is a Python literal with a `lensmodel`."""
    return re.search(r"['\"]lensmodel['\"]\s*:", document.text or "") is not None


def read(document: Document) -> Found:
    """The camera at its pose.

    Raises:
        ValueError: another lens, or damage.
    """
    text = document.text or ""
    if len(text) > MOST_CHARACTERS or re.search(r"([\[({]\s*){20}", text):
        raise ValueError("want a .cameramodel, got a text that is too long, or too deeply nested")
    try:
        with warnings.catch_warnings():  # of odd literals, which the checks below see
            warnings.simplefilter("ignore")
            fields = ast.literal_eval(text.strip())
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError(f"want a Python literal, got something else ({type(error).__name__})") from None
    if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
        raise ValueError("want a dictionary, got another literal")
    for key in ("lensmodel", "intrinsics", "imagersize"):
        if len(re.findall(rf"['\"]{key}['\"]\s*:", re.sub("#.*", "", text))) != 1:
            raise ValueError(f"{key}: want the key once, got it never or twice")
    model = fields["lensmodel"]
    if model not in COUNTS:
        raise ValueError(
            f"lensmodel: want one of {', '.join(COUNTS)}, got {model!r}; mrcal-convert-lensmodel makes one of another"
        )
    poses = [key for key in ("rt_cam_ref", "extrinsics") if key in fields]
    if len(poses) != 1:
        raise ValueError(f"want rt_cam_ref, called extrinsics in older files, got {' and '.join(poses) or 'none'}")
    f_x, f_y, c_x, c_y, *lens = vector("intrinsics", _lists(fields["intrinsics"]), (4 + COUNTS[model],))
    width, height = vector("imagersize", _lists(fields["imagersize"]), (2,))
    rt = np.array(vector(poses[0], _lists(fields[poses[0]]), (6,)))
    pose = cv2.Rodrigues(rt[:3])[0], rt[3:]
    K = focal_lengths(f_x, f_y, c_x, c_y)
    return Found({"camera": camera_of(K, brown(lens) if lens else None, image_size(width, height), pose)})


def _lists(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value
