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
_RING = np.rint(RADIUS * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)).astype(int)
_HARMONIC = np.stack([np.cos(2 * _ANGLES), np.sin(2 * _ANGLES)], axis=-1).astype(np.float32)
_BEFORE, _OPPOSITE = np.roll(range(16), 1), np.roll(range(16), 8)
_BORDER = int(RADIUS) + 2


class Saddles(NamedTuple):
    """Saddle points.

    Attributes:
        points: `(N, 2)` px, to the nearest pixel.
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
    # Few large arrays, written again and again, stay in the processor's cache.
    spare = image.astype(np.float32)
    smooth = cv2.GaussianBlur(spare, (0, 0), BLUR)
    xx, yy, xy = (
        cv2.Sobel(smooth, cv2.CV_32F, 2, 0, dst=spare, ksize=3),
        *(cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((0, 2), (1, 1))),
    )
    strength = cv2.subtract(cv2.multiply(xy, xy, dst=xy), cv2.multiply(xx, yy, dst=xx), dst=xy)
    # Without noise, pixels around one corner may be equally strong: by a hair, the last of them shall be the peak.
    height, width = image.shape
    strength *= 1 + 1e-6 * np.arange(width, dtype=np.float32)
    strength *= 1 + 5e-6 * np.arange(height, dtype=np.float32)[:, None]
    peak = (strength == cv2.dilate(strength, np.ones((5, 5), np.uint8), dst=yy)) & (strength > WEAKEST)
    peak[:_BORDER] = peak[-_BORDER:] = False
    peak[:, :_BORDER] = peak[:, -_BORDER:] = False
    places = np.flatnonzero(peak)
    if len(places) > MOST:
        places = places[np.argpartition(-strength.reshape(-1)[places], MOST)[:MOST]]
    ring = smooth.reshape(-1)[places[:, None] + (_RING[:, 0] + width * _RING[:, 1])]
    ring -= ring.mean(axis=1, keepdims=True)
    light = ring > 0
    changes = (light != light[:, _BEFORE]).sum(axis=1)
    turned = np.einsum("nk,nk->n", ring, ring[:, _OPPOSITE])
    alternates = (changes == 4) & (turned > 0.6 * np.einsum("nk,nk->n", ring, ring))
    places = places[alternates]
    points = np.stack([places % width, places // width], axis=-1).astype(np.float32)
    return Saddles(points, ring[alternates] @ _HARMONIC)
