"""The plane z = 0, which is taken where none is given: a board lies there, and surveyed landmarks need not.

Maps count heights from the sea. Where all landmarks are hundreds of metres up, z = 0 is far below the ground, and
lengths on it are many times those on the ground, with deviations that say nothing of that.
"""

from typing import NamedTuple

from diffproj._core.warn import warn_caller
from diffproj.calibration.results.calibration import Calibration

OFF = 0.01
"""Parts by which lengths at the nearest landmark's height may differ from those on z = 0."""


class Heights(NamedTuple):
    """Where landmarks are that lie all above z = 0, or all below.

    Attributes:
        low: z of the lowest, in world units.
        high: z of the highest.
        nearest: z of the one that is nearest to z = 0.
    """

    low: float
    high: float
    nearest: float

    def in_words(self, unit: str | None) -> str:
        """What is told where z = 0 was taken; the caller adds what to give instead."""
        return (
            "no plane is given, and z = 0, which is taken, is not where the landmarks are, from z = "
            f"{self.low:.10g} to {self.high:.10g}{f' {unit}' if unit else ''}: if they stand on the ground, points and "
            "lengths on it come out wrong"
        )


def far_from_landmarks(calibration: Calibration, view: int) -> Heights | None:
    """The heights of a view's landmarks, where z = 0 is far from them; `None` where it is not, and for a board.

    That is farther from the nearest than half of what they differ in height, and so far that lengths differ by more
    than `OFF`. Landmarks above a camera that is itself above z = 0, as on a façade, say nothing of the ground.
    """
    if calibration.landmarks is None:
        return None
    heights = calibration.points[calibration.used[view]][:, 2]
    if not len(heights):
        return None
    low, high = float(heights.min()), float(heights.max())
    nearest = low if low > 0 else high
    camera = float(calibration.cameras[view].center[2])
    if low <= 0 <= high or 0 < camera < low or abs(nearest) <= max(OFF * abs(camera - nearest), (high - low) / 2):
        return None
    return Heights(low, high, nearest)


def warn_if_far_from_landmarks(calibration: Calibration, view: int) -> None:
    """Warn where z = 0 is taken by itself, and is far from a view's landmarks."""
    far = far_from_landmarks(calibration, view)
    if far is not None:
        warn_caller(f"{far.in_words(calibration.unit)}; give plane=dp.Plane.z({far.nearest:.10g}), or dp.Plane.z(0.0)")
