"""Saddle points of brightness: where four squares of a chessboard meet, and little else in the world does."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Shaped

BLUR = 1.5
"""Standard deviation in px of the blur before derivatives: squares from 6 px on survive it, pixel noise does not."""

RADIUS = 4.0
"""Radius in px of the ring on which four sectors must alternate."""

MOST = 1500
"""The strongest saddle points that are looked at: foliage has tens of thousands, a board some hundreds."""

WEAKEST = 4.0
"""Determinant of the Hessian below which a saddle is taken for noise; grey values run to 255."""

_ANGLES = np.arange(16) * (2 * np.pi / 16)
_RING = RADIUS * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
_BORDER = int(RADIUS) + 2


class Saddles(NamedTuple):
    """Saddle points.

    Attributes:
        points: `(N, 2)` px, to the nearest pixel or so.
        phases: `(N, 2)`, second harmonic of the ring of grey values around each: neighbours on a chessboard have
            opposite ones, since dark and light change places.
    """

    points: Float32[np.ndarray, "n 2"]
    phases: Float32[np.ndarray, "n 2"]


def saddle_points(image: Shaped[np.ndarray, "h w"]) -> Saddles:
    """Saddle points around which exactly four sectors alternate, dark and light, alike when turned by 180 degrees.

    Args:
        image: `(H, W)` from 0 to 255.

    Example:
        >>> squares = np.kron(np.indices((4, 5)).sum(axis=0) % 2, np.ones((20, 20))) * 200
        >>> len(saddle_points(squares).points)
        12
    """
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR)
    xx, yy, xy = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (0, 2), (1, 1)))
    strength = xy * xy - xx * yy
    peak = (strength == cv2.dilate(strength, np.ones((5, 5), np.uint8))) & (strength > WEAKEST)
    peak[:_BORDER] = peak[-_BORDER:] = False
    peak[:, :_BORDER] = peak[:, -_BORDER:] = False
    # Without noise, pixels around one corner may be equally strong: they are one peak.
    _, _, _, centres = cv2.connectedComponentsWithStats(peak.astype(np.uint8), connectivity=8)
    points = centres[1:]
    if len(points) > MOST:
        u, v = points.astype(int).T
        points = points[np.argpartition(-strength[v, u], MOST)[:MOST]]
    around = np.rint(points[:, None] + _RING).astype(int)
    ring = smooth[around[..., 1], around[..., 0]].reshape(-1, len(_RING))
    ring -= ring.mean(axis=1, keepdims=True)
    power = (ring**2).sum(axis=1)
    changes = ((ring > 0) != np.roll(ring > 0, 1, axis=1)).sum(axis=1)
    turned = (ring * np.roll(ring, len(_RING) // 2, axis=1)).sum(axis=1)
    alternates = (changes == 4) & (turned > 0.6 * power)
    phases = np.stack([ring @ np.cos(2 * _ANGLES), ring @ np.sin(2 * _ANGLES)], axis=-1)
    return Saddles(*(part[alternates].astype(np.float32) for part in (points, phases)))
