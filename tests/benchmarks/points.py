"""Pixels to points of a plane through a pinhole: short calls as in a network, and long inputs."""

import importlib
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import torch
from torch import Tensor

import diffproj as dp

from .comparing import Comparison
from .scenes import (
    SIZE,
    K,
    R,
    T,
    board,
    both_ways,
    by_hand,
    by_hand_fused,
    camera,
    some_pixels,
    through_kornia,
    through_opencv,
)


def comparisons() -> Iterator[Comparison]:
    yield from _short_calls()
    yield from _long_inputs()
    yield from _other_packages()


def _short_calls() -> Iterator[Comparison]:
    to_board, frozen = dp.PlaneMap(camera(), board()), dp.PlaneProjector(camera(), board())
    hand = "formula by hand"
    for count in (1, 100, 1000):
        pixels, learned = some_pixels(count), some_pixels(count).requires_grad_()

        def peer(pixels: Tensor = pixels) -> Tensor:
            return by_hand(pixels, K, R, T)

        for name, work in (("PlaneMap", to_board), ("frozen projector", frozen)):
            yield Comparison(f"{name}, {count} points", lambda w=work, p=pixels: w(p), peer, hand, 1.6)
            yield Comparison(
                f"{name}, {count} points, both ways",
                both_ways(lambda w=work, p=learned: w(p)[0]),
                both_ways(lambda p=learned: by_hand(p, K, R, T)),
                hand,
                1.3,
            )
    pixels, plane, seen_from = some_pixels(100), board(), camera()

    def direct() -> Tensor:
        return by_hand(pixels, K, R, T)

    yield Comparison("back_project, 100 points", lambda: dp.back_project(pixels, seen_from, plane), direct, hand, 3.0)
    yield Comparison("Camera(K, R, t, size=...)", lambda: dp.Camera(K, R, T, size=SIZE), direct, f"{hand}, 100 points")


def _long_inputs() -> Iterator[Comparison]:
    to_board, count = dp.PlaneMap(camera(), board()), 10**6
    pixels, more = some_pixels(count), some_pixels(10 * count)
    compiled, hand = torch.compile(dp.PlaneMap.__call__), torch.compile(by_hand_fused)

    def ours() -> object:
        return to_board(pixels)

    def ours_compiled() -> object:
        return compiled(to_board, pixels)

    def peer_compiled() -> Tensor:
        return hand(pixels, K, R, T)

    yield Comparison("PlaneMap, 10^6 points", ours, lambda: by_hand(pixels, K, R, T), "formula by hand")
    yield Comparison("PlaneMap, 10^6 points: Kornia", ours, through_kornia(camera(), pixels), "Kornia")
    yield Comparison("PlaneMap, 10^6 points: OpenCV", ours, through_opencv(camera(), pixels), "OpenCV and NumPy")
    yield Comparison("PlaneMap compiled, 10^6 points", ours_compiled, peer_compiled, "formula by hand, compiled", 1.0)
    array, H = pixels.numpy()[:, None], np.eye(3) + 1e-4
    warp = "cv2.perspectiveTransform, which gives no third coordinate"
    yield Comparison(
        "PlaneMap compiled, 10^6 points: OpenCV", ours_compiled, lambda: cv2.perspectiveTransform(array, H), warp, 1.43
    )
    yield Comparison("PlaneMap, 10^7 points", lambda: to_board(more), ours, "10^6, per point", 1.15, 10.0, 3.0)


def _other_packages() -> Iterator[Comparison]:
    """Packages that back-project too, where they are installed."""
    if (work := _cameratransform(10**5)) is not None:
        to_board, pixels = dp.PlaneMap(camera(), board()), some_pixels(10**5)
        yield Comparison("PlaneMap, 10^5 points", lambda: to_board(pixels), work, "cameratransform", seconds=2.0)


def _cameratransform(count: int) -> Callable[[], object] | None:
    try:
        transform = importlib.import_module("cameratransform")
    except ImportError:
        return None
    projection = transform.RectilinearProjection(focallength_px=533, center=(342, 235), image=SIZE)
    seen_from = transform.Camera(projection, transform.SpatialOrientation(elevation_m=500, tilt_deg=20))
    array = some_pixels(count).double().numpy()
    return lambda: seen_from.spaceFromImage(array, Z=0)
