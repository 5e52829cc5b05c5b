"""Every public call that takes tensors gives on a CUDA device what it gives on the CPU, and keeps its tensors there."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj.targets import synthetic

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
D = torch.float64
BOARD = dp.Chessboard()
EXTENT = (-20.0, -20.0, 220.0, 140.0)


class Scene:
    """The same cameras, views and pixels on one device."""

    def __init__(self, device: str) -> None:
        self.device = device
        views = dp.example_views("left").to(device)
        self.views, self.others = views[:6], views[6:9]
        self.calibration = dp.calibrate(self.views, BOARD, "brown5")
        self.camera = self.calibration.cameras[0]
        lens = dp.KannalaBrandt(torch.tensor([0.01, -0.02, 0.001, 0.0], dtype=D, device=device))
        self.fisheye = dp.Camera(self.camera.K, self.camera.R, self.camera.t, lens, (640, 480))
        self.pinhole = dp.Camera(self.camera.K, self.camera.R, self.camera.t, size=(640, 480))
        self.plane = dp.Plane([0.1, 0.2, 1.0], 3.0).to(device)
        self.pixels = self.views.pixels[0]
        self.points = BOARD.points.to(device)
        self.image = torch.rand(1, 48, 64, dtype=D, generator=torch.Generator().manual_seed(0)).to(device)


def fitted(calibration: dp.Calibration) -> list[Any]:
    covariance = calibration.covariance
    return [*calibration.cameras.tensors(), calibration.rms, covariance.deviations, covariance.full()]


def through_cameras(scene: Scene) -> list[Any]:
    found: list[Any] = []
    for camera in (scene.camera, scene.fisheye, scene.pinhole):
        found += [
            camera.project(scene.points),
            camera.rays(scene.pixels),
            dp.back_project(scene.pixels, camera, scene.plane),
            dp.PlaneMap(camera, scene.plane)(scene.pixels),
            dp.ground_resolution(scene.pixels, camera, scene.plane),
            dp.explain(scene.pixels, camera, scene.plane),
            camera.center,
        ]
    return found


def gradients(scene: Scene) -> list[Any]:
    tensors = [tensor.clone().requires_grad_() for tensor in (scene.pixels, scene.camera.K, scene.camera.t)]
    pixels, K, t = tensors
    camera = dp.Camera(K, scene.camera.R, t, scene.camera.distortion)
    points, valid = dp.back_project(pixels, camera, scene.plane)
    return list(torch.autograd.grad(dp.PlaneLoss(dp.Huber(2.0))(points, points.detach() + 1, valid), tensors))


def measured(scene: Scene) -> list[Any]:
    found = dp.measure(scene.pixels[::9], scene.calibration, scene.plane, view=0, pixel_sigma="detector")
    return [found.points, found.covariance, found.lengths().value, found.lengths().deviation, found.area().deviation]


def learning(scene: Scene) -> list[Any]:
    every = ("focal", "principal_point", "distortion", "pose", "plane")
    projector = dp.PlaneProjector(scene.camera, scene.plane, learn=every).to(scene.device)
    points, valid = projector(scene.pixels)
    loss = points.square().mean() + dp.CalibrationPrior(scene.calibration, view=0)(projector.camera)
    return [points, valid, loss, *torch.autograd.grad(loss, list(projector.parameters()), allow_unused=True)]


def out_of_torch(scene: Scene) -> list[Any]:
    """Numbers and files: no tensors, so that nothing but the values counts."""
    camera = scene.camera
    opencv = [np.asarray(part).ravel().tolist() for part in camera.to_opencv()[:4]]
    again = dp.load_calibration(saved(scene.calibration))
    return [opencv, camera.center.tolist(), again.rms.tolist(), again.covariance.full().tolist()]


def saved(calibration: dp.Calibration) -> Path:
    path = Path(tempfile.mkdtemp()) / "calibration.json"
    dp.save_camera(path, calibration)
    return path


def pictures(scene: Scene) -> list[Any]:
    small = scene.camera.resized((64, 48))
    top = dp.rectify(scene.image, small, scene.plane, EXTENT, 5.0)
    return [top, dp.render(scene.image, scene.pinhole, scene.plane, EXTENT, size=(64, 48))]


def maps(scene: Scene) -> list[Any]:
    found = dp.AccuracyMap.over_image(scene.calibration, view=0, step=100)
    return [found.points, found.deviation]


def surveyed(scene: Scene) -> list[Any]:
    """Landmarks in space: the pose, from a camera that is known, and the focal length too."""
    points = torch.rand(12, 3, dtype=D, generator=torch.Generator().manual_seed(0))
    points = (points * torch.tensor([200.0, 125, -80], dtype=D)).to(scene.device)
    camera = dp.Camera(scene.camera.K, scene.camera.R, scene.camera.t, size=(640, 480))
    views = dp.Views(camera.project(points)[0].unsqueeze(0), size=(640, 480))
    found = dp.locate(views, dp.Landmarks(points), camera, pixel_sigma=0.5)
    held = ("principal_point", "distortion")
    both = dp.calibrate(views, dp.Landmarks(points), "none", fixed=held[:1], pixel_sigma=0.5)
    ellipses = dp.measure(scene.pixels[::9], found, scene.plane, pixel_sigma=0.5).ellipses(0.95)
    return [*found.cameras.tensors(), found.covariance.full(), both.camera.K, ellipses.half_axes]


def mounted(scene: Scene) -> list[Any]:
    """A camera on a mast, and what is seen of it."""
    mast = dp.Camera.mounted(6.0, 20.0, heading_deg=30.0, fov_deg=70.0, size=(640, 480)).to(scene.device)
    standing = torch.tensor([[6.0, 10, 0], [8, 14, 0], [5, 12, 0]], dtype=D, device=scene.device)
    top = standing + torch.tensor([0, 0, 1.75], dtype=D, device=scene.device)
    mast = mast.to(D)
    heights = dp.Heights(mast.project(standing)[0], mast.project(top)[0], 1.75, 0.03)
    far = mast.center + 1e6 * torch.tensor([[0.3, 1, 0], [0.9, 1, 0]], dtype=D, device=scene.device)
    horizon = dp.Horizon(mast.project(far)[0], 2.0)
    found = dp.adjust(mast, [heights, horizon], fixed=("heading", "position"))
    return [*found.camera.tensors(), mast.mounting().tilt]


def rig(scene: Scene) -> list[Any]:
    """Two cameras of one rig, and points from both."""
    views = {side: dp.example_views(side)[:6].to(scene.device) for side in ("left", "right")}
    found = dp.calibrate_rig(views, BOARD)
    spots = found.triangulate({side: one.pixels[0] for side, one in views.items()})
    return [found.cameras["right"].t, spots.points, spots.deviations]


def joined(scene: Scene) -> list[Any]:
    """Two measurements of the same points."""
    one, other = (dp.measure(scene.pixels[::9] + d, scene.camera, scene.plane, pixel_sigma=0.5) for d in (0.0, 0.1))
    found = dp.fuse([one, other])
    return [found.points, found.covariance]


CALLS: dict[str, Callable[[Scene], list[Any]]] = {
    "cameras": through_cameras,
    "gradients": gradients,
    "calibrate": lambda s: fitted(dp.calibrate(s.views, BOARD, "brown5")),
    "calibrate robustly": lambda s: fitted(dp.calibrate(s.views, BOARD, "none", loss=dp.Huber(0.3))),
    "calibrate without outliers": lambda s: fitted(dp.calibrate(s.views, BOARD, "brown4", reject_outliers=True)),
    "calibrate a fisheye": lambda s: fitted(dp.calibrate(s.views, BOARD, "fisheye")),
    "choose a lens": lambda s: fitted(dp.calibrate(s.views, BOARD, "auto")),
    "refine": lambda s: fitted(dp.refine(s.views, BOARD, s.calibration.cameras)),
    "locate": lambda s: fitted(dp.locate(s.others, BOARD, s.calibration)),
    "cross_validate": lambda s: dp.cross_validate(s.views, BOARD, "brown4", folds=2).to_dict()["held_out_px"],
    "measure": measured,
    "learning": learning,
    "calibrate a free shape": lambda s: fitted(dp.calibrate(s.views, BOARD, "brown4", shape="free")),
    "landmarks": surveyed,
    "mounted": mounted,
    "rig": rig,
    "fuse": joined,
    "one sample": lambda s: [
        dp.rectify(s.image, s.camera.resized((64, 48)), s.plane, EXTENT, 5.0, samples=1, north_up=True)
    ],
    "pictures": pictures,
    "maps": maps,
    "out of torch": out_of_torch,
    "residuals": lambda s: [dp.image_residuals(s.calibration.cameras, s.views, BOARD)],
    "synthetic": lambda s: [
        synthetic.corner_views(s.calibration.cameras, BOARD).pixels,
        *synthetic.random_cameras(s.camera.without_pose(), BOARD, 5).tensors(),
    ],
    "bootstrap": lambda s: [dp.bootstrap(s.views, BOARD, "none", draws=2)],
}


def flat(found: Any) -> list[Any]:
    """Tensors and numbers in a flat list."""
    if isinstance(found, dict):
        return [*found, *flat(list(found.values()))]
    return [item for part in found for item in flat(part)] if isinstance(found, list | tuple) else [found]


@pytest.fixture(scope="module")
def scenes() -> tuple[Scene, Scene]:
    return Scene("cpu"), Scene("cuda")


@pytest.mark.parametrize("name", CALLS)
def test_a_call_gives_the_same_there(name: str, scenes: tuple[Scene, Scene]) -> None:
    here, there = (flat(CALLS[name](scene)) for scene in scenes)
    assert len(here) == len(there)
    for want, got in zip(here, there, strict=True):
        if isinstance(want, Tensor) and isinstance(got, Tensor):
            assert got.device.type == "cuda"
            torch.testing.assert_close(
                got.cpu(), want, rtol=1e-4 if want.dtype != D else 1e-6, atol=1e-7, equal_nan=True
            )
        else:
            assert got == pytest.approx(want)
