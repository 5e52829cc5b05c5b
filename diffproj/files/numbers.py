"""What the readers ask of numbers in files: that they are numbers, are finite, and come in the shape that is meant."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffproj.geometry.camera import Camera
from diffproj.lens.protocol import Lens

LONGEST_SIDE = 1_000_000
"""Pixels along a side of an image, at most."""

HUGE = 1e100
"""Entries of a matrix whose squares are still numbers."""
ROUNDED, WRONG = 1e-6, 1e-3
"""How far a file's `R^T R` may be from the identity, entry by entry: up to the first, it is taken as it is; up to the
second, it was rounded, and the nearest rotation is taken; beyond, it is no rotation."""


def number(name: str, value: Any) -> float:
    """A finite number.

    Raises:
        ValueError: it is none, or text.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ValueError(f"{name}: want a number, got {described(value)}")
    try:
        found = float(value)  # type: ignore[arg-type]
    except (OverflowError, TypeError):
        found = math.inf
    if not math.isfinite(found):
        raise ValueError(f"{name}: want a finite number, got {value}")
    return found


def whole(name: str, value: Any, most: int) -> int:
    """A whole number from 1 to `most`, also one that is written `640.0`.

    Raises:
        ValueError: it is none.
    """
    found = number(name, value)
    if found != int(found) or not 1 <= found <= most:
        raise ValueError(f"{name}: want a whole number from 1 to {most}, got {found:g}")
    return int(found)


def image_size(width: Any, height: Any, name: str = "size") -> tuple[int, int] | None:
    """The size of an image; `None` where both sides are missing, or 0, which stands for it in many files.

    Raises:
        ValueError: one of them is missing, or no number of pixels.
    """
    if width is None and height is None:
        return None
    if width is None or height is None:
        raise ValueError(f"{name}: want width and height, got only one of them")
    if not isinstance(width, bool) and not isinstance(height, bool) and width == 0 and height == 0:
        return None
    return whole(f"{name}, width", width, LONGEST_SIDE), whole(f"{name}, height", height, LONGEST_SIDE)


def matrix(name: str, value: Any) -> np.ndarray:
    """Finite numbers of a matrix or a list, in the shape that the file gives them, in float64.

    Args:
        name: for the message.
        value: nested lists, an array, or a mapping with `rows`, `cols` and `data` as OpenCV and ROS write.

    Raises:
        ValueError: it is something else, `data` has another count than rows times columns, or a number is not finite.
    """
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "fiu":
            raise ValueError(f"{name}: want real numbers, got an array of {value.dtype}")
        found = value.astype(np.float64)
        if not np.isfinite(found).all():
            raise ValueError(f"{name}: want finite numbers, got NaN or infinity")
        return found
    if isinstance(value, dict):
        return _with_rows(name, value)
    if not isinstance(value, list):
        raise ValueError(f"{name}: want a list of numbers, got {described(value)}")
    return _nested(name, value)


def vector(name: str, value: Any, counts: tuple[int, ...]) -> list[float]:
    """So many finite numbers, as a list, a row or a column.

    Raises:
        ValueError: they are something else.
    """
    found = matrix(name, value)
    if found.size != max(found.shape, default=1) or found.size not in counts:
        wanted = " or ".join(map(str, counts))
        raise ValueError(f"{name}: want {wanted} numbers, got {shape_of(found)}")
    return found.ravel().tolist()


def square(name: str, value: Any, rows: int, columns: int) -> np.ndarray:
    """A matrix of that shape, which a file may also give as one list, row by row.

    Raises:
        ValueError: it is something else.
    """
    found = matrix(name, value)
    if found.shape == (rows * columns,):
        found = found.reshape(rows, columns)
    if found.shape != (rows, columns):
        raise ValueError(f"{name}: want {rows} x {columns} numbers, got {shape_of(found)}")
    return found


def intrinsics(name: str, value: Any, skew: bool = False) -> np.ndarray:
    """K, upper triangular with positive focal lengths.

    Args:
        name: for the message.
        value: the matrix.
        skew: whether the file's format has skew; OpenCV would ignore it.

    Raises:
        ValueError: it is something else.
    """
    K = square(name, value, 3, 3)
    if K[2].tolist() != [0, 0, 1]:
        turned = ", as if rows and columns were exchanged" if K[:, 2].tolist() == [0, 0, 1] else ""
        raise ValueError(f"{name}: want the last row 0 0 1, got {K[2].tolist()}{turned}")
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        uncalibrated = "; the camera is not calibrated" if not K[:2].any() else ""
        raise ValueError(f"{name}: want positive focal lengths, got {K[0, 0]:g} and {K[1, 1]:g}{uncalibrated}")
    if K[1, 0] or (K[0, 1] and not skew):
        raise ValueError(
            f"{name}: want 0 beside the focal lengths, got {K[0, 1]:g} and {K[1, 0]:g}, which OpenCV ignores; "
            "dp.Camera(K, ...) takes skew"
        )
    return K


def focal_lengths(f_x: Any, f_y: Any, c_x: Any, c_y: Any, skew: Any = 0.0) -> np.ndarray:
    """K from its numbers.

    Raises:
        ValueError: they are not finite numbers, or a focal length is not positive.
    """
    names = ("f_x", "f_y", "c_x", "c_y", "skew")
    a, d, x, y, b = map(number, names, (f_x, f_y, c_x, c_y, skew))
    return intrinsics("focal lengths", np.array([[a, b, x], [0, d, y], [0, 0, 1]]), skew=True)


def rotation(name: str, R: np.ndarray) -> np.ndarray:
    """A rotation; the nearest one where it was rounded to few digits.

    Raises:
        ValueError: it is none.
    """
    size = np.abs(R).max()
    far = np.abs(R.T @ R - np.eye(3)).max() if size < HUGE else math.inf
    if far > WRONG:
        scale = math.sqrt(np.trace(R.T @ R) / 3) if 1 / HUGE < size < HUGE else 0.0
        if scale and np.abs(R.T @ R / scale**2 - np.eye(3)).max() < WRONG:
            raise ValueError(f"{name}: want a rotation, got one times {scale:.6g}: take the scale out of the pose")
        raise ValueError(f"{name}: want a rotation, got a matrix whose R^T R is {far:.2g} off the identity")
    if np.linalg.det(R) < 0:
        raise ValueError(f"{name}: want a rotation, got a mirror image of one: the frame is left-handed")
    if far <= ROUNDED:
        return R
    U, _, V = np.linalg.svd(R)
    return U @ V


def rigid(name: str, value: Any) -> tuple[np.ndarray, np.ndarray]:
    """R and t of a transformation as 4 x 4 or 3 x 4 numbers, or as one list of them.

    Raises:
        ValueError: it is something else.
    """
    found = matrix(name, value)
    if found.ndim == 1 and found.size in (12, 16):
        found = found.reshape(-1, 4)
    if found.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"{name}: want 4 x 4 or 3 x 4 numbers, got {shape_of(found)}")
    if len(found) == 4 and found[3].tolist() != [0, 0, 0, 1]:
        raise ValueError(f"{name}: want the last row 0 0 0 1, got {found[3].tolist()}")
    return rotation(name, found[:3, :3]), found[:3, 3]


def inverse(pose: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The transformation the other way."""
    R, t = pose
    return R.T, -R.T @ t


def from_quaternion(name: str, w: Any, x: Any, y: Any, z: Any) -> np.ndarray:
    """The rotation of a quaternion, scaled to length 1.

    Raises:
        ValueError: its length is not 1 to three digits.
    """
    q = np.array([number(name, part) for part in (w, x, y, z)])
    if not abs(np.linalg.norm(q) - 1) <= WRONG:
        raise ValueError(f"{name}: want a quaternion of length 1, got {np.linalg.norm(q):.4g}")
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def camera_of(
    K: np.ndarray,
    lens: Lens | None,
    size: tuple[int, int] | None,
    pose: tuple[np.ndarray, np.ndarray] | None = None,
) -> Camera:
    """A camera from what was read, in float64.

    Raises:
        ValueError: the numbers are no camera.
    """
    R, t = (None, None) if pose is None else map(as_tensor, pose)
    camera = Camera(as_tensor(K), R, t, lens)
    return Camera.unchecked(camera.K, camera.R, camera.t, camera.distortion, size)  # `load` looks at the sides


def as_tensor(numbers: Any) -> Tensor:
    """A float64 tensor of its own."""
    return torch.tensor(np.asarray(numbers, dtype=np.float64), device="cpu")


def described(value: Any) -> str:
    """A value in a message, kept short."""
    if value is None:
        return "nothing"
    if isinstance(value, dict | list):
        return f"a {'mapping' if isinstance(value, dict) else 'list'} of {len(value)}"
    text = repr(value)
    return f"{text[:60]}{'...' * (len(text) > 60)}" + " in quotes" * isinstance(value, str)


def shape_of(array: np.ndarray) -> str:
    """A shape in a message."""
    return " x ".join(map(str, array.shape)) or "a single number"


def _with_rows(name: str, value: dict[str, Any]) -> np.ndarray:
    """A matrix of `rows`, `cols` and `data`, with all three checked against each other."""
    missing = [key for key in ("rows", "cols", "data") if key not in value]
    if missing:
        raise ValueError(f"{name}: want a matrix with rows, cols and data, got one without {' and '.join(missing)}")
    kind, data = value.get("dt", "d"), value["data"]
    if data == [] and 0 in (value["rows"], value["cols"]):  # as OpenCV writes an empty matrix
        return np.zeros(0)
    rows, columns = (whole(f"{name}, {key}", value[key], 10**7) for key in ("rows", "cols"))
    if isinstance(kind, str) and kind[:1].isdigit() and kind[:1] != "1":
        raise ValueError(f"{name}: want one number an entry, got {kind[:1]} (dt: {kind})")
    if isinstance(data, str) and data.startswith("$base64$"):
        raise ValueError(f"{name}: want numbers as text, got OpenCV's base64; write it without FileStorage::BASE64")
    found = _nested(name, data if isinstance(data, list) else [data])
    if found.shape != (rows * columns,):
        raise ValueError(f"{name}: want {rows} x {columns} numbers as rows and cols say, got {shape_of(found)} in data")
    return found.reshape(rows, columns)


def _nested(name: str, value: list[Any], depth: int = 0) -> np.ndarray:
    if depth < 3 and value and all(isinstance(item, list) for item in value):
        parts = [_nested(name, item, depth + 1) for item in value]
        if len({part.shape for part in parts}) > 1:
            raise ValueError(f"{name}: want rows of equal length, got {', '.join(map(shape_of, parts[:4]))}")
        return np.stack(parts)
    return np.array([number(name, item) for item in value], dtype=np.float64)
