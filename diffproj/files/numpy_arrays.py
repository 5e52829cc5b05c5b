"""NumPy's `.npz` and `.npy`: arrays under the names of `named.py`, as `cv2.calibrateCamera`'s results are stored.

Pickles in them are never opened. `rvecs` and `tvecs` are many views and no pose; `newcameramtx` is of another image.
4 coefficients need the model beside them, `camera_model`, for they may be those of `cv2.fisheye`. Written are
`camera_matrix`, `dist_coeffs`, `camera_model`, `image_size` (width, height), and of a posed camera `R` and `t`, world
to camera.
"""

import io
import re
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from diffproj.calibration.results.calibration import Calibration
from diffproj.files import named
from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.lenses import COUNTS, coefficients, is_fisheye
from diffproj.files.numbers import camera_of, intrinsics, shape_of
from diffproj.files.writing import has_pose, one_camera
from diffproj.geometry.camera import Camera

NPY, NPZ = b"\x93NUMPY", b"PK\x03\x04"
MOST_BYTES = 2**26
"""Of one array; larger ones hold photographs or corners, and are not looked at."""
MOST_BYTES_OF_A_LENS = 1024
"""With the header before its numbers."""

HEADER_DAMAGE = (KeyError, TypeError, SyntaxError, ValueError, tokenize.TokenError, MemoryError, RecursionError)
"""What numpy raises where the header of an array, a Python literal, is none."""


def recognises(document: Document) -> bool:
    """Whether it begins as these files do."""
    return document.data.startswith((NPY, NPZ))


def read(document: Document) -> Found:
    """The camera of the arrays.

    Raises:
        ValueError: there is none, or something about it is not understood.
    """
    if document.data.startswith(NPY):
        return _alone(document)
    try:
        return named.read(_arrays(document.data), four_is_brown=False)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, OSError, RuntimeError) as error:
        raise ValueError(f"want a .npz file, got a damaged one ({error})") from None


def write(path: Path, item: Camera | Calibration) -> dict[Path, bytes]:
    """One camera.

    Raises:
        ValueError: it is a batch, has skew or a lens of another package.
    """
    camera = one_camera(item, "numpy's files")
    arrays = {
        "camera_matrix": camera.K.numpy(),
        "dist_coeffs": np.array(coefficients(camera)),
        "camera_model": np.array("fisheye" if is_fisheye(camera) else "brown"),
    }
    if camera.size is not None:
        arrays["image_size"] = np.array(camera.size)
    if has_pose(camera):
        arrays |= {"R": camera.R.numpy(), "t": camera.t.numpy()}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return {path: buffer.getvalue()}


def _alone(document: Document) -> Found:
    """K alone in a `.npy`; a lens may be in another one beside it."""
    array = _array("the array", document.data)
    if not isinstance(array, np.ndarray) or array.shape != (3, 3):
        shape = shape_of(array) if isinstance(array, np.ndarray) else "something else"
        llff = ", the poses of LLFF" if isinstance(array, np.ndarray) and array.shape[1:] == (17,) else ""
        raise ValueError(f"want a camera matrix of 3 x 3, got {shape}{llff}; name the file of the camera matrix")
    for neighbour in sorted(document.path.parent.glob("*.npy")):
        if neighbour.name != document.path.name and (named.names_lens(neighbour.stem) or _holds_lens(neighbour)):
            raise ValueError(
                f"want the lens with its camera matrix, got it in {neighbour.name} beside it, as it seems; "
                "build dp.Camera.from_opencv(np.load(...), np.load(...))"
            )
    return Found({"camera": camera_of(intrinsics("camera matrix", array), None, None)})


def _holds_lens(path: Path) -> bool:
    """Whether a file holds as many numbers as a lens has; 4 may be anything, as a rectangle."""
    try:
        if path.stat().st_size > MOST_BYTES_OF_A_LENS:
            return False
        array = _array(path.name, path.read_bytes())
    except (OSError, ValueError):
        return False
    return (
        isinstance(array, np.ndarray)
        and array.dtype.kind == "f"
        and array.size == max(array.shape)
        and array.size in COUNTS[1:]
    )


def _arrays(data: bytes) -> dict[str, Any]:
    arrays: dict[str, Any] = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            if name in arrays:
                raise ValueError(f"{name}: want the array once, got it twice")
            arrays[name] = None
            if info.file_size <= MOST_BYTES:
                with archive.open(info) as member:
                    content = member.read(MOST_BYTES + 1)
                arrays[name] = _array(name, content) if content.startswith(NPY) else None
    return arrays


def _array(name: str, data: bytes) -> Any:
    """An array, whose header has to say the length that it has; a text or number alone as such; `None` of a pickle."""
    stream = io.BytesIO(data)
    try:
        version = npy.read_magic(stream)
        header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        with warnings.catch_warnings():  # of headers that Python 2 wrote
            warnings.simplefilter("ignore")
            shape, by_columns, dtype = header(stream)
    except HEADER_DAMAGE as error:
        raise ValueError(f"{name}: want an array as numpy.save writes it, got a damaged one ({error})") from None
    if dtype.hasobject:
        if re.search("mtx|matrix|dist|coef|intrinsic", name.lower()):
            raise ValueError(f"{name}: want an array of numbers, got a pickle, which is never opened")
        return None
    rest, count = data[stream.tell() :], 1
    for side in shape:
        count *= side
    if any(side < 0 for side in shape) or count * dtype.itemsize != len(rest):
        raise ValueError(f"{name}: want {count} numbers as its header says, got {len(rest)} bytes")
    array = np.frombuffer(rest, dtype).reshape(shape, order="F" if by_columns else "C") if count else np.zeros(shape)
    return array.item() if array.shape == () else array
