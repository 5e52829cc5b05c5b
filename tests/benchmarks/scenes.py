"""The cameras that the benchmarks look through, and the formulas by hand that they are compared with."""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor

import diffproj as dp

SIZE = (640, 480)
K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]])
R = dp.rotation_from_euler(*torch.tensor([2.7, 0.25, 0.4]))
T = torch.tensor([10.0, -20, 500])
COEFFICIENTS = torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002])


def camera(lens: bool = False) -> dp.Camera:
    """A web camera that looks down at a slant from half a metre, in millimetres."""
    return dp.Camera(K, R, T, dp.BrownConrady(COEFFICIENTS) if lens else None, SIZE)


def board() -> dp.Plane:
    return dp.Plane.z(torch.zeros(()))


def some_pixels(count: int) -> Tensor:
    return torch.rand(count, 2, generator=torch.Generator().manual_seed(count)) * torch.tensor(SIZE)


def by_hand(pixels: Tensor, K: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """Rays of a pinhole cut with z = 0, as one writes it without a library: no mask, no care for float32."""
    x = (pixels[..., 0] - K[0, 2]) / K[0, 0]
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
    directions = torch.stack((x, y, torch.ones_like(x)), dim=-1) @ R
    center = -R.T @ t
    return center - center[2] / directions[..., 2:] * directions


def by_hand_fused(pixels: Tensor, K: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """The same without a matrix product, which a compiler fuses into one loop."""
    x = (pixels[..., 0] - K[0, 2]) / K[0, 0]
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
    a, b, c = (R[0, axis] * x + R[1, axis] * y + R[2, axis] for axis in range(3))
    center = -(R * t[:, None]).sum(0)
    depth = -center[2] / c
    return torch.stack((center[0] + depth * a, center[1] + depth * b, center[2] + depth * c), dim=-1)


def through_kornia(camera: dp.Camera, pixels: Tensor) -> Callable[[], Tensor]:
    """Each pixel unprojected at depth 1, and the line from the centre through it cut with z = 0."""
    pinhole = camera.to_kornia()
    depth = torch.ones(1, len(pixels), 1)

    def run() -> Tensor:
        center = camera.center
        direction = pinhole.unproject(pixels[None], depth)[0] - center
        return center - center[2] / direction[:, 2:] * direction

    return run


def through_opencv(camera: dp.Camera, pixels: Tensor) -> Callable[[], np.ndarray]:
    """`cv2.undistortPoints` to the normalised plane, with its five steps, then the intersection in NumPy."""
    K, coefficients, _, _ = camera.to_opencv()
    R, center, array = camera.R.numpy(), camera.center.numpy(), pixels.numpy()

    def run() -> np.ndarray:
        xy = cv2.undistortPoints(array[:, None], K, coefficients if coefficients.size else None)[:, 0]
        direction = np.concatenate([xy, np.ones_like(xy[:, :1])], axis=1) @ R
        return center - center[2] / direction[:, 2:] * direction

    return run


def both_ways(work: Callable[[], Tensor]) -> Callable[[], object]:
    """Forward and backward."""
    return lambda: work().sum().backward()
