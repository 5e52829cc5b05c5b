"""An image as a grid of pixels: its size, the places of its pixels, and which places lie on it."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.numerics import has_values
from diffproj._core.warn import warn_caller

BORDER = 1.0
"""Pixels by which a place may lie beyond the image and still be meant: detectors count their boxes' edges from the
image's corner, half a pixel off, and round."""


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


def warn_if_off_image(
    caller: str,
    pixels: Float[Tensor, "*batch n 2"],
    valid: Bool[Tensor, "*many n"] | None,
    size: tuple[int, int] | None,
) -> None:
    """Warn of pixels that nobody can have seen on an image of that size, where it is known and values can be read.

    Args:
        caller: the function that was called, for the message.
        pixels: `(*B, N, 2)`; those that are not finite count as not seen.
        valid: which of them have a point `(*M, N)`, by broadcasting; the others are told by it.
        size: `(width, height)` of the image.
    """
    if size is None or not has_values(pixels):
        return
    pixels = pixels.detach()
    last = pixels.new_tensor(size) - 0.5 + BORDER
    off = ((pixels < -0.5 - BORDER) | (pixels > last)).any(dim=-1) & pixels.isfinite().all(dim=-1)
    off = off if valid is None else off & valid
    if not bool(off.any()):
        return
    count = int(off.sum())
    u, v = pixels.expand(*off.shape, 2)[off][0].tolist()
    others = "" if count == 1 else f" and {count - 1} more"
    warn_caller(
        f"{caller}: pixel ({u:g}, {v:g}){others} outside of the photograph of {size[0]} x {size[1]} px: are pixels "
        "(u, v), and counted in the camera's own image, not in a resized or turned one?"
    )
