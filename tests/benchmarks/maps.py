"""Maps of how well a calibrated camera measures."""

from collections.abc import Iterator

import diffproj as dp

from .comparing import Comparison


def comparisons() -> Iterator[Comparison]:
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    plane = dp.Plane.z(0.0)
    pixels = dp.AccuracyMap.over_image(calibration, plane, 0).pixels.flatten(0, 1)
    seen_from = calibration.cameras[0]
    yield Comparison(
        f"accuracy map of {len(pixels)} places",
        lambda: dp.AccuracyMap.over_image(calibration, plane, 0),
        lambda: dp.ground_resolution(pixels, seen_from, plane),
        "their ground resolution alone",
        seconds=3.0,
    )
