"""An image as a grid of pixels: its size, the places of its pixels, and which places lie on it."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def checked_size(size: Any) -> tuple[int, int] | None:
    """The size of an image as two numbers; `None` stays `None`.

    Raises:
        TypeError: not two whole numbers.
        ValueError: not positive.
    """
    if size is None:
        return None
    try:
        width, height = (int(side) for side in size)
        whole = (width, height) == tuple(size) and not any(isinstance(side, bool) for side in size)
    except (TypeError, ValueError, OverflowError):
        whole, width, height = False, 0, 0
    if not whole:
        raise TypeError(f"size: want (width, height) in whole px, got {size!r}")
    if width < 1 or height < 1:
        raise ValueError(f"size: want a positive width and height, got {size!r}")
    return width, height


def pixel_grid(rows: int, columns: int, like: Tensor) -> Float[Tensor, "rows columns 2"]:
    """`(column, row)` of every pixel `(rows, columns, 2)`, in the dtype and on the device of `like`."""
    row, column = torch.meshgrid(
        torch.arange(rows, dtype=like.dtype, device=like.device),
        torch.arange(columns, dtype=like.dtype, device=like.device),
        indexing="ij",
    )
    return torch.stack([column, row], dim=-1)


def inside(pixels: Float[Tensor, "*shape 2"], size: tuple[int, int]) -> Bool[Tensor, "*shape"]:
    """Whether pixels lie on an image of that `(width, height)`: its area ends half a pixel beyond the outer centres."""
    last = pixels.new_tensor(size) - 0.5
    return ((pixels >= -0.5) & (pixels <= last)).all(dim=-1)
