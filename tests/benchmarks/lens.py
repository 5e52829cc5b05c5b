"""Undistorting float32 points, exactly, and the plane map behind a lens."""

import importlib
from collections.abc import Callable, Iterator

import cv2
import kornia.geometry
import numpy as np
import torch
from torch import Tensor

import diffproj as dp

from .comparing import Comparison
from .scenes import COEFFICIENTS, K, board, camera, some_pixels, through_opencv

COUNT = 10**6
LENSES = {"5": COEFFICIENTS.tolist(), "8": [22.0, 8.0, 1e-4, 2e-4, 0.2, 22.3, 15.0, 1.6]}


def comparisons() -> Iterator[Comparison]:
    pixels = some_pixels(COUNT)
    to_board, opencv = dp.PlaneMap(camera(lens=True), board()), through_opencv(camera(lens=True), pixels)
    compiled = torch.compile(dp.PlaneMap.__call__)
    peer = "cv2.undistortPoints, 5 steps, and NumPy"
    yield Comparison("PlaneMap behind a lens, 10^6 points", lambda: to_board(pixels), opencv, peer, 0.667)
    yield Comparison(
        "PlaneMap compiled behind a lens, 10^6 points", lambda: compiled(to_board, pixels), opencv, peer, 0.25
    )
    normalised = (pixels - K[:2, 2]) / K.diagonal()[:2]
    for name, coefficients in LENSES.items():
        yield from _alone(name, normalised, coefficients)


def _alone(name: str, xy: Tensor, coefficients: list[float]) -> Iterator[Comparison]:
    lens, array, distortion = dp.BrownConrady(coefficients).to(torch.float32), xy.numpy(), np.array(coefficients)
    to_rounding = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-7)
    compiled = torch.compile(lambda points: lens.undistort(points)[0], fullgraph=True)
    intrinsics, kornia_lens = torch.eye(3), torch.tensor(coefficients)

    def opencv() -> object:
        return cv2.undistortPoints(array, np.eye(3), distortion, criteria=to_rounding)

    def five_steps() -> object:
        return kornia.geometry.undistort_points(xy, intrinsics, kornia_lens)

    which = f"undistort, {name} coefficients, 10^6 points"
    yield Comparison(f"{which}: Kornia", lambda: lens.undistort(xy), five_steps, "Kornia, 5 steps")
    yield Comparison(f"{which}: OpenCV", lambda: lens.undistort(xy), opencv, "OpenCV to 1e-7", seconds=2.0)
    yield Comparison(f"{which}, compiled", lambda: compiled(xy), opencv, "OpenCV to 1e-7", seconds=2.0)
    for package, work in (("pycolmap", _pycolmap(xy, coefficients)), ("mrcal", _mrcal(xy, coefficients))):
        if work is not None:
            yield Comparison(f"{which}: {package}", lambda: lens.undistort(xy), work, package, seconds=2.0)


def _pycolmap(xy: Tensor, coefficients: list[float]) -> Callable[[], object] | None:
    """The inverse of COLMAP's lens of 4 or 8 coefficients, whose order is OpenCV's."""
    try:
        pycolmap = importlib.import_module("pycolmap")
    except ImportError:
        return None
    model, count = ("FULL_OPENCV", 8) if len(coefficients) == 8 else ("OPENCV", 4)
    camera = pycolmap.Camera(model=model, width=2, height=2, params=[1.0, 1.0, 0.0, 0.0, *coefficients[:count]])
    array = xy.double().numpy()
    return lambda: camera.cam_from_img(array)


def _mrcal(xy: Tensor, coefficients: list[float]) -> Callable[[], object] | None:
    try:
        mrcal = importlib.import_module("mrcal")
    except ImportError:
        return None
    array, intrinsics = xy.double().numpy(), np.array([1.0, 1.0, 0.0, 0.0, *coefficients])
    return lambda: mrcal.unproject(array, f"LENSMODEL_OPENCV{len(coefficients)}", intrinsics)
