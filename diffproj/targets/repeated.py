"""Which of several alike boards in one photograph is taken: the same by one rule, and that there are others is told."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float


class Taken(NamedTuple):
    """A board's points in a photograph.

    Attributes:
        points: `(N, 2)` px, in order, NaN where not seen.
        again: whether the photograph shows the board elsewhere, too.
    """

    points: Float[np.ndarray, "n 2"]
    again: bool


def largest(boards: list[Float[np.ndarray, "n 2"]]) -> Taken | None:
    """The one that covers most of the photograph, of those that were found in it; None of none."""
    return Taken(max(boards, key=covered), len(boards) > 1) if boards else None


def covered(points: Float[np.ndarray, "n 2"]) -> float:
    """The area in px around the points that are seen."""
    seen = points[np.isfinite(points[:, 0])].astype(np.float32)
    return float(cv2.contourArea(cv2.convexHull(seen))) if len(seen) > 2 else 0.0
