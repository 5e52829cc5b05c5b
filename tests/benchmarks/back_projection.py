"""Back-projection against Kornia's unproject-and-intersect and OpenCV, in one process: prints rates and ratios.

Run alone on the machine: `python tests/benchmarks/back_projection.py [--threads N]`.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor

import diffproj as dp


def seconds(function: Callable[[], object], repeats: int = 11) -> float:
    """Median time of a call, after one that warms up."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def through_kornia(camera: dp.Camera, pixels: Tensor) -> Callable[[], Tensor]:
    """Each pixel unprojected at depth 1, and the line from the centre through it cut with z = 0."""
    pinhole = camera.to_kornia()
    depth = torch.ones(1, len(pixels), 1)

    def run() -> Tensor:
        center = camera.center
        through = pinhole.unproject(pixels[None], depth)[0]
        direction = through - center
        return center - center[2] / direction[:, 2:] * direction

    return run


def through_opencv(camera: dp.Camera, pixels: np.ndarray) -> Callable[[], np.ndarray]:
    """`cv2.undistortPoints` to the normalised plane, then the intersection in NumPy."""
    K, dist, _, _ = camera.to_opencv()
    R, center = camera.R.numpy(), camera.center.numpy()

    def run() -> np.ndarray:
        xy = cv2.undistortPoints(pixels[:, None], K, dist if dist.size else None)[:, 0]
        direction = np.concatenate([xy, np.ones_like(xy[:, :1])], axis=1) @ R
        return center - center[2] / direction[:, 2:] * direction

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    torch.set_num_threads(parser.parse_args().threads)
    cv2.setNumThreads(torch.get_num_threads())
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]])
    R = dp.rotation_from_euler(*torch.tensor([2.7, 0.25, 0.4]))
    t = torch.tensor([10.0, -20, 500])
    pinhole = dp.Camera(K, R, t, size=(640, 480))
    behind_lens = dp.Camera(K, R, t, dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002])), (640, 480))
    print(f"{torch.get_num_threads()} thread(s), float32, million points a second")
    compiled = torch.compile(dp.PlaneMap.__call__)
    for count in (10**6, 10**7):
        pixels = torch.rand(count, 2) * torch.tensor([640.0, 480])
        for name, camera in (("pinhole", pinhole), ("5-coefficient lens", behind_lens)):
            to_plane = dp.PlaneMap(camera, dp.Plane.z(0.0))
            ours = seconds(lambda: dp.back_project(pixels, camera, dp.Plane.z(0.0)))  # noqa: B023
            rates = {"eager": ours, "OpenCV": seconds(through_opencv(camera, pixels.numpy()), 5)}
            if count == 10**6:
                rates["compiled"] = seconds(lambda: compiled(to_plane, pixels))  # noqa: B023
            if camera.distortion is None:
                rates["Kornia"] = seconds(through_kornia(camera, pixels), 5)
            figures = "  ".join(f"{key} {count / 1e6 / value:.0f}" for key, value in rates.items())
            ratios = "  ".join(f"{key} {rates[key] / ours:.2f} x" for key in ("Kornia", "OpenCV") if key in rates)
            print(f"{count:>9} {name:<19} {figures}   faster than {ratios}")
    print(f"building a map: {1e3 * seconds(lambda: dp.PlaneMap(pinhole, dp.Plane.z(0.0)), 200):.2f} ms")


if __name__ == "__main__":
    main()
