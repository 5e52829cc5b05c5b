"""The extent of a top view on its plane: how many pixels fill it, where the first begins, and how large they are."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from diffproj._core.arguments import Array, flag, number, numbers
from diffproj._core.numerics import check_tensor, has_values
from diffproj.geometry.grid import checked_size

MOST_PIXELS = 2**31
"""Of an image to be made: more would not fit into memory, and is a resolution in the wrong unit."""
WANTED = "finite (s_min, t_min, s_max, t_max) with room between"
EQUAL = 1e-5
"""Part by which the sides of extents may differ that count as equally large."""


def sides_of(extent: Sequence[float] | Tensor | Array) -> tuple[float, float]:
    """The sides of one extent along s and t, in world units.

    Raises:
        TypeError: no numbers.
        ValueError: not four of them, or an empty or infinite extent.
    """
    s_min, t_min, s_max, t_max = numbers("extent", extent, WANTED, 4)
    if not (s_max > s_min and t_max > t_min and math.isfinite(s_max - s_min) and math.isfinite(t_max - t_min)):
        raise ValueError(f"extent: want {WANTED}, got {tuple(extent)}")
    return s_max - s_min, t_max - t_min


def shape_of(
    extent: Sequence[float] | Tensor | Array,
    resolution: float | None,
    size: tuple[int, int] | None = None,
    like: Tensor | None = None,
) -> tuple[int, int]:
    """`(rows, columns)` of the top view whose pixels fill the extent, or all extents of a batch.

    Args:
        extent: one, or `(*B, 4)` where each image has its own.
        resolution: world units per pixel.
        size: `(columns, rows)`, in place of the resolution.
        like: a tensor of the extents' kind.

    Raises:
        TypeError: no numbers.
        ValueError: not one of resolution and size, a resolution that is not positive or too fine, or, with a
            resolution, extents of different sizes or that cannot be read here.
    """
    if (resolution is None) is (size is None):
        got = "neither" if size is None else "both"
        raise ValueError(f"resolution: want it, or the size (width, height) of the top view in pixels, got {got}")
    said = checked_size(size)
    if said is not None:
        if said[0] * said[1] > MOST_PIXELS:
            raise ValueError(f"size: want one that fits into memory, got {said[0]} x {said[1]} px")
        return said[1], said[0]
    if _is_of_each(extent):
        extent = _first_of_equal(check_tensor("extent", extent, 4, like=like))
    width, height = sides_of(extent)
    resolution = number("resolution", resolution, "world units per pixel, above 0", above=0)
    rows, columns = (max(1.0, side / resolution) for side in (height, width))
    if rows * columns > MOST_PIXELS:
        raise ValueError(
            f"resolution: want world units per pixel that give a top view of an image's size, got {resolution:g}, and "
            f"{columns:.3g} x {rows:.3g} px for the extent"
        )
    return max(1, round(rows)), max(1, round(columns))


def cells(
    extent: Sequence[float] | Tensor | Array, shape: Sequence[int], like: Tensor, north_up: bool
) -> tuple[Tensor, Tensor]:
    """`(s, t)` of the corner where the first pixel begins, and the steps from pixel to pixel, `(*B, 2)` both.

    Args:
        extent: one, or `(*B, 4)`.
        shape: `(rows, columns)`.
        like: a tensor of the kind to make.
        north_up: whether the first row is at t_max.

    Raises:
        TypeError: no numbers.
        ValueError: an empty or infinite extent.
    """
    upwards, (rows, columns) = flag("north_up", north_up), shape
    if _is_of_each(extent):
        each = check_tensor("extent", extent, 4, like=like).to(like)
        sides = each[..., 2:] - each[..., :2]
        if each.numel() and has_values(each) and not bool(((sides > 0) & sides.isfinite()).all()):
            raise ValueError(f"extent: want {WANTED}, got {each.tolist()}")
    else:
        sides_of(extent)
        each = like.new_tensor([float(side) for side in extent])
    s_min, t_min, s_max, t_max = each.unbind(-1)
    if upwards:
        t_min, t_max = t_max, t_min
    return torch.stack([s_min, t_min], -1), torch.stack([(s_max - s_min) / columns, (t_max - t_min) / rows], -1)


def _is_of_each(extent: Sequence[float] | Tensor | Array) -> bool:
    """Whether it is to be handled as a tensor: of several extents, or of values that cannot be read."""
    if isinstance(extent, Tensor):
        return extent.ndim > 1 or not has_values(extent)
    return isinstance(extent, np.ndarray) and extent.ndim > 1


def _first_of_equal(each: Tensor) -> list[float]:
    """The first of extents `(*B, 4)` that are equally large.

    Raises:
        ValueError: extents of different sizes, none, or some that cannot be read.
    """
    if each.numel() == 0:
        raise ValueError(f"extent: want one extent, or at least one for each image, got shape {tuple(each.shape)}")
    if not has_values(each):
        raise ValueError(
            "size: want the top view's (width, height) in place of the resolution, where extents are an input of a "
            "compiled or exported function; got None"
        )
    sides = (each[..., 2:] - each[..., :2]).reshape(-1, 2)
    if not bool(each.isfinite().all()):
        raise ValueError("extent: want finite (s_min, t_min, s_max, t_max), got NaN or infinity")
    if not bool(((sides - sides[0]).abs() <= EQUAL * sides.abs()).all()):
        raise ValueError(
            f"extent: want extents of one size, got {sides.tolist()}; with size=(width, height) in place of the "
            "resolution they may differ"
        )
    return each.reshape(-1, 4)[0].tolist()
