"""Undistorting a million float32 points: the exact lens against OpenCV and Kornia. Prints times and ratios.

Run as `python tests/benchmarks/lens.py`; `--threads` sets how many threads PyTorch and OpenCV may use, `--compile`
adds the compiled lens. Ratios are to be trusted, times are not: medians of interleaved runs in one process.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import cv2
import kornia.geometry
import numpy as np
import torch

from diffproj.lens.brown_conrady import BrownConrady

CASES = {
    "5 coefficients": [-0.2535, 0.0924, -0.0006, 0.0007, -0.0191],
    "8 coefficients": [22.0, 8.0, 1e-4, 2e-4, 0.2, 22.3, 15.0, 1.6],
}
SIZE = (3840, 2160)
FOCAL = 2500.0


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--points", type=int, default=10**6)
    options.add_argument("--rounds", type=int, default=7)
    options.add_argument("--threads", type=int, default=1)
    options.add_argument("--compile", action="store_true")
    chosen = options.parse_args()
    torch.set_num_threads(chosen.threads)
    cv2.setNumThreads(chosen.threads)
    for name, coefficients in CASES.items():
        compare(name, coefficients, chosen.points, chosen.rounds, compiled=chosen.compile)


def compare(name: str, coefficients: list[float], count: int, rounds: int, *, compiled: bool) -> None:
    """Print medians for one lens, in milliseconds and relative to Kornia's five steps, and the largest errors."""
    torch.manual_seed(0)
    centre = torch.tensor(SIZE) / 2
    pixels = torch.rand(count, 2) * torch.tensor(SIZE)
    xy = (pixels - centre) / FOCAL
    lens = BrownConrady(torch.tensor(coefficients))
    exact, _ = BrownConrady(lens.coefficients.double()).undistort(xy.double())
    distortion, intrinsics = lens.coefficients, torch.eye(3)
    array, array_distortion = xy.numpy(), np.array(coefficients)
    to_rounding = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-7)
    candidates: dict[str, Callable[[], torch.Tensor]] = {
        "kornia, 5 steps": lambda: kornia.geometry.undistort_points(xy, intrinsics, distortion),
        "cv2, equal tolerance": lambda: torch.from_numpy(
            cv2.undistortPoints(array, np.eye(3), array_distortion, criteria=to_rounding)
        ).reshape(-1, 2),
        "diffproj": lambda: lens.undistort(xy)[0],
    }
    if compiled:
        function = torch.compile(lambda points: lens.undistort(points)[0], fullgraph=True)
        candidates["diffproj compiled"] = lambda: function(xy)
    results = {label: run() for label, run in candidates.items()}
    times: dict[str, list[float]] = {label: [] for label in candidates}
    for _ in range(rounds):
        for label, run in candidates.items():
            started = time.perf_counter()
            run()
            times[label].append(time.perf_counter() - started)
    reference = statistics.median(times["kornia, 5 steps"])
    print(f"{name}, {count} float32 points, {torch.get_num_threads()} thread(s)")
    for label in candidates:
        median = statistics.median(times[label])
        error = float((results[label] - exact).abs().max()) * FOCAL
        print(f"  {label:22s} {median * 1e3:8.1f} ms   {median / reference:5.2f} x kornia   off by {error:.1e} px")


if __name__ == "__main__":
    main()
