"""Boards at random poses before a camera with a lens, photographed: what the tests of detectors share."""

import math

import numpy as np
import torch

import diffproj as dp
from diffproj.targets.boards import Board

D = torch.float64
SIZE = (320, 240)


def camera_before(
    board: Board, seed: int, side_px: float = 20.0, tilt_deg: float = 35.0, whole: bool = True
) -> dp.Camera:
    """A camera with a lens, and a board in any orientation, whose side is so many pixels in the middle.

    The board's middle is near that of the image, or, where not the whole board is to be seen, anywhere in it.
    """
    draw = np.random.default_rng(seed)
    K = torch.tensor([[300.0, 0, SIZE[0] / 2], [0, 300, SIZE[1] / 2], [0, 0, 1]], dtype=D)
    lens = dp.BrownConrady(torch.tensor([-0.25, 0.08, 1e-3, -5e-4, 0.0], dtype=D))
    camera = dp.Camera(K, distortion=lens, size=SIZE)
    origin, right, down = board.artwork.axes
    upright = np.stack([right, down, np.cross(right, down)])
    angles = *np.radians(draw.uniform(-tilt_deg, tilt_deg, 2)), draw.uniform(-math.pi, math.pi)
    R = dp.rotation_from_euler(*torch.tensor(angles, dtype=D)).numpy() @ upright
    width, height = board.artwork.size
    middle = origin + (right * width + down * height) / 2
    pixel = np.array(SIZE) * (draw.uniform(0.35, 0.65, 2) if whole else draw.uniform(0, 1, 2))
    ray = camera.directions(torch.from_numpy(pixel)[None])[0][0].numpy()
    t = ray / ray[2] * (300 * board.side / side_px) - R @ middle
    return camera.at(torch.from_numpy(R), torch.from_numpy(t))


def photographed(camera: dp.Camera, board: Board, seed: int = 0, blur_px: float = 0.8) -> np.ndarray:
    """An 8-bit photograph."""
    return dp.synthetic.photograph(camera, board, blur_px=blur_px, noise=3 / 255, seed=seed).numpy()


def errors(found: dp.Views, camera: dp.Camera, board: Board) -> tuple[np.ndarray, int]:
    """Distances in px of the visible points of one view from the truth, and how many lie well inside the image."""
    truth, valid = camera.project(board.points)
    inside = valid & ((truth > 8) & (truth < torch.tensor(SIZE) - 9)).all(-1)
    seen = found.visible[0]
    return (found.pixels[0] - truth).norm(dim=-1)[seen].numpy(), int(inside.sum())
