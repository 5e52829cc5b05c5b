"""Calibration from corners to the converged result, against OpenCV in the same process.

    python tests/benchmarks/calibration.py            # one thread, then as many as PyTorch takes by itself

Prints medians and their ratio for one camera of 13, 100 and 1000 views and for 256 cameras of 13 views (OpenCV in a
loop), simulated with noise of 0.2 px, 54 corners a view and a lens of 5 coefficients, and the exponent with which time
grows from 100 to 1000 views.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable

import cv2
import numpy as np
import torch

import diffproj as dp
from diffproj import synthetic


def median_ms(work: Callable[[], object], repeats: int) -> float:
    work()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return 1e3 * statistics.median(times)


def opencv(pixels: torch.Tensor, board: dp.Chessboard) -> float:
    corners = [view.numpy().astype(np.float32) for view in pixels]
    points = [board.points.numpy().astype(np.float32)] * len(corners)
    return cv2.calibrateCamera(points, corners, (640, 480), None, None)[0]


def compare(cameras: int, views: int, repeats: int) -> float:
    board = dp.Chessboard()
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=torch.float64)
    lens = dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002], dtype=torch.float64))
    camera = dp.Camera(K, distortion=lens, size=(640, 480))
    truth = synthetic.random_cameras(camera, board, cameras * views, seed=views)
    poses = truth.R.unflatten(0, (cameras, views)), truth.t.unflatten(0, (cameras, views))
    seen = synthetic.corner_views(camera.at(*poses), board, noise_px=0.2)
    if cameras == 1:
        seen = dp.Views(seen.pixels[0], size=seen.size)
        rms, peer = float(dp.calibrate(seen, board).rms), opencv(seen.pixels, board)
        theirs = median_ms(lambda: opencv(seen.pixels, board), repeats)
    else:
        rms, peer = float(dp.calibrate(seen, board).rms.max()), max(opencv(p, board) for p in seen.pixels)
        theirs = median_ms(lambda: [opencv(pixels, board) for pixels in seen.pixels], 1)
    ours = median_ms(lambda: dp.calibrate(seen, board), repeats)
    print(
        f"{cameras:4} x {views:4} views: diffproj {ours:8.1f} ms, OpenCV {theirs:8.1f} ms, ratio {theirs / ours:5.2f}"
        f"   (RMS {rms:.6f} and {peer:.6f} px)"
    )
    return ours


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    repeats = parser.parse_args().repeats
    default = torch.get_num_threads()
    for threads in sorted({1, default}):
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
        print(f"{threads} thread{'s' * (threads > 1)}, OpenCV {cv2.__version__}, PyTorch {torch.__version__}")
        compare(1, 13, 3 * repeats)
        hundred = compare(1, 100, repeats)
        thousand = compare(1, 1000, max(3, repeats // 2))
        compare(256, 13, max(3, repeats // 2))
        print(f"time grows with the views' number to the power of {math.log10(thousand / hundred):.2f}")


if __name__ == "__main__":
    main()
