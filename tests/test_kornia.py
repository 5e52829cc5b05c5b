"""Kornia's `PinholeCamera` is taken wherever a `Camera` is, and gives the same."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_leaves

import diffproj as dp
from diffproj import synthetic

D = torch.float64
BOARD = dp.Chessboard(columns=5, rows=4, square=20.0)
Z = dp.Plane.z(0.0)


@pytest.fixture(scope="module")
def cameras() -> dp.Camera:
    """Six views of a small board by a small camera."""
    K = torch.tensor([[140.0, 0, 80], [0, 141, 60], [0, 0, 1]], dtype=D)
    return synthetic.random_cameras(dp.Camera(K, size=(160, 120)), BOARD, 6)


@pytest.fixture(scope="module")
def views(cameras: dp.Camera) -> dp.Views:
    return synthetic.corner_views(cameras, BOARD)


CALLS: dict[str, Callable[[Any, dp.Views], Any]] = {
    "back_project": lambda camera, views: dp.back_project(views.pixels, camera, Z),
    "explain": lambda camera, views: dp.explain(views.pixels, camera, Z),
    "paper_route": lambda camera, views: dp.paper_route(views.pixels, camera, Z),
    "PlaneMap": lambda camera, views: dp.PlaneMap(camera, Z)(views.pixels),
    "PlaneProjector": lambda camera, views: dp.PlaneProjector(camera, Z, ("focal", "pose"))(views.pixels),
    "LearnableCamera": lambda camera, views: dp.LearnableCamera(camera)(),
    "ground_resolution": lambda camera, views: dp.ground_resolution(views.pixels, camera, Z),
    "image_residuals": lambda camera, views: dp.image_residuals(camera, views, BOARD),
    "plane_residuals": lambda camera, views: dp.plane_residuals(camera, views, BOARD),
    "refine": lambda camera, views: dp.refine(views, BOARD, camera).cameras,
    "rectify": lambda camera, views: dp.rectify(
        torch.ones(6, 1, 120, 160, dtype=D), camera, Z, (0.0, 0.0, 60.0, 50.0), 2.0
    ),
    "render": lambda camera, views: dp.render(torch.ones(1, 20, 30, dtype=D), camera, Z, (0.0, 0.0, 60.0, 50.0)),
    "photograph": lambda camera, views: synthetic.photograph(camera, BOARD),
    "corner_views": lambda camera, views: synthetic.corner_views(camera, BOARD).pixels,
    "random_cameras": lambda camera, views: synthetic.random_cameras(camera, BOARD, 2),
}


@pytest.mark.parametrize("name", CALLS)
def test_the_same_comes_out(name: str, cameras: dp.Camera, views: dp.Views) -> None:
    ours, korniass = CALLS[name](cameras, views), CALLS[name](cameras.to_kornia(), views)
    for a, b in zip(tree_leaves(ours), tree_leaves(korniass), strict=True):
        torch.testing.assert_close(a, b)


def test_one_camera_of_a_batch_of_one(cameras: dp.Camera, views: dp.Views, tmp_path: Path) -> None:
    single = cameras[0].to_kornia()
    calibration = dp.calibrate(views, BOARD, "none")
    prior = dp.CalibrationPrior(calibration)
    torch.testing.assert_close(prior(single), prior(cameras[0])[None])
    dp.save_camera(tmp_path / "camera.json", single)
    torch.testing.assert_close(dp.load_camera(tmp_path / "camera.json").K, cameras.K[:1])
