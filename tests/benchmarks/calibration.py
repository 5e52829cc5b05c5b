"""Calibration from corners to the converged result, with its covariance, against OpenCV.

One camera of 13, 100 and 1000 views, and 256 cameras of 13 views (OpenCV in a loop): simulated with noise of 0.2 px, 54
corners a view and a lens of 5 coefficients.
"""

from collections.abc import Iterator

import cv2
import numpy as np

import diffproj as dp
from diffproj import synthetic

from .comparing import Comparison
from .scenes import COEFFICIENTS, SIZE, K

TARGETS = {(1, 13): 1 / 1.2, (1, 100): 1 / 6, (1, 1000): 1 / 9, (256, 13): 1 / 10}


def comparisons() -> Iterator[Comparison]:
    board = dp.Chessboard()
    for (cameras, views), target in TARGETS.items():
        seen = simulated(cameras, views, board)
        points = [board.points.numpy().astype(np.float32)] * views
        each = [[view.numpy().astype(np.float32) for view in pixels] for pixels in seen.pixels]
        one = dp.Views(seen.pixels[0], size=seen.size) if cameras == 1 else seen

        def ours(one: dp.Views = one) -> object:
            return dp.calibrate(one, board)

        def opencv(points: list[np.ndarray] = points, each: list[list[np.ndarray]] = each) -> object:
            return [cv2.calibrateCamera(points, corners, SIZE, None, None) for corners in each]  # type: ignore[call-overload]

        which = f"calibrate, {cameras} x {views} views"
        yield Comparison(which, ours, opencv, "OpenCV", target, seconds=3.0)


def simulated(cameras: int, views: int, board: dp.Chessboard) -> dp.Views:
    """Views `(cameras, views)` of the board by cameras that are alike."""
    camera = dp.Camera(K.double(), distortion=dp.BrownConrady(COEFFICIENTS.double()), size=SIZE)
    truth = synthetic.random_cameras(camera, board, cameras * views, seed=views)
    poses = truth.R.unflatten(0, (cameras, views)), truth.t.unflatten(0, (cameras, views))
    return synthetic.corner_views(camera.at(*poses), board, noise_px=0.2)
