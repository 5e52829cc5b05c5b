"""What a camera says of itself: its focal lengths, principal point, lens, size, and whether it has a pose."""

from typing import Any

import torch
from torch import Tensor

from diffproj._core.numerics import has_values
from diffproj._core.shown import counted, in_pixels, number
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.models import MODELS
from diffproj.lens.protocol import Lens


def facts(K: Tensor, R: Tensor, t: Tensor, lens: Lens | None, size: tuple[int, int] | None) -> list[str]:
    """For one line; of many cameras the range of each number."""
    focal, middle = K[..., :2, :2].norm(dim=-1), K[..., :2, 2]  # the norm also tells it of an image that is turned
    return [
        counted(K.shape[:-2], "camera"),
        f"f {number(focal[..., 0])}, {number(focal[..., 1])} px",
        f"c {number(middle[..., 0])}, {number(middle[..., 1])} px",
        "pinhole" if lens is None else type(lens).__name__,
        in_pixels(size),
        "no pose" if has_values(R, t) and without_pose(R, t) else "",
        str(K.dtype),
        str(K.device) if K.device.type != "cpu" else "",
    ]


def without_pose(R: Tensor, t: Tensor) -> bool:
    """Whether the world's frame is the camera's own, of all cameras."""
    return not bool(t.any()) and bool((torch.eye(3, dtype=R.dtype, device=R.device) == R).all())


def columns(K: Tensor, lens: Lens | None) -> dict[str, list[Any]]:
    """For a table of one camera: the names and the values of intrinsics and lens."""
    if K.ndim > 2 or not has_values(K):
        return {}
    (f_x, skew, c_x), (_, f_y, c_y), _ = K.tolist()
    values = {"f_x": f_x, "f_y": f_y, "c_x": c_x, "c_y": c_y} | ({"skew": skew} if skew else {})
    if isinstance(lens, CoefficientLens) and lens.coefficients.ndim == 1:
        coefficients = lens.coefficients.tolist()
        names = next(
            model.coefficient_names
            for model in MODELS.values()
            if model.kind is type(lens) and model.count == len(coefficients)
        )
        values |= dict(zip(names, coefficients, strict=True))
    return {"parameter": list(values), "value": list(values.values())}
