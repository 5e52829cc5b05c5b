"""Whether the sides of an image are in the wrong order, as far as the principal point tells.

It lies near the image's middle, but for images that were cut out of larger ones. Of 37 cameras of public files none is
off by more than a quarter of half a side, but for two of one file, whose sides are in the wrong order.
"""

from torch import Tensor

from diffproj._core.numerics import has_values
from diffproj._core.warn import warn_caller

ASIDE = 0.18
"""Part of half a side by which the principal point must be off along both, in the way that exchanged sides put it."""
NEAR = 0.3
"""The same up to which it may be off along both if the sides are exchanged."""
NEARER = 0.15
"""The same where a camera is built: of parts of 40 to 70 % of each side, cut out anywhere, one in 150 is warned of."""
BETTER = 0.65
"""Times the distance from the middle that it must come down to then."""


def exchanged(K: Tensor, size: tuple[int, int], near: float = NEAR) -> str:
    """What makes a size look like height and width, in words; empty where nothing does.

    Args:
        K: intrinsics `(*B, 3, 3)`, of which the first are looked at.
        size: `(width, height)`.
        near: how far the principal point may be from the middle if the sides are exchanged, as a part of half a side.
    """
    width, height = size
    if width == height or K.numel() == 0:
        return ""
    c_x, c_y = principal_point(K)
    x, y = (2 * (c_x + 0.5) / width, 2 * (c_y + 0.5) / height)
    if not (min(abs(x - 1), abs(y - 1)) > ASIDE and (x - 1) * (y - 1) < 0):
        return ""
    off = (x - 1) ** 2 + (y - 1) ** 2
    x, y = x * width / height - 1, y * height / width - 1
    if not (max(abs(x), abs(y)) < near and x * x + y * y < BETTER**2 * off):
        return ""
    return f"which looks like height and width: c is ({c_x:g}, {c_y:g})"


def principal_point(K: Tensor) -> tuple[float, float]:
    """That of the first camera."""
    x, y = K.detach()[(0,) * (K.ndim - 2)][:2, 2].tolist()
    return x, y


def warn_of_exchanged(K: Tensor, size: tuple[int, int] | None) -> None:
    """Warn where the size of a sensor, wider than high, is in the wrong order, as far as no device is waited for."""
    if size is None or size[0] >= size[1] or not K.is_cpu or not has_values(K):
        return
    doubt = exchanged(K, size, NEARER)
    if doubt:
        warn_caller(f"size: want (width, height), got {size}, {doubt}; of a part that was cut out all may be well")
