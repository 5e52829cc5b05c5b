# pyright: strict
"""What a user writes, for type checkers in their strict mode (`test_style.py`, `test_typing.py`): nobody runs this."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

import diffproj as dp


def calibrated(photographs: Sequence[str]) -> dp.Calibration:
    board = dp.Chessboard(columns=9, rows=6, square=25.0)
    views = dp.detect(photographs, board)
    calibration = dp.calibrate(views, board, "auto", reject_outliers=True)
    if calibration.comparison is not None:
        print(calibration.comparison.summary())
    print(calibration.verdict, calibration.status, calibration.covariance.deviations["f_x"].item())
    numbers: dict[str, object] = calibration.to_dict()
    print(numbers)
    return calibration


def measured(photograph: str, calibration: dp.Calibration, clicks: Tensor) -> float:
    board = dp.Chessboard()
    located = dp.locate(dp.detect(photograph, board), board, calibration)
    found = dp.measure(clicks, located, dp.Plane.z(-12.0), pixel_sigma=0.5)
    low, high = found.lengths().interval(0.95)
    print(found.summary(), found.doubts, low, high, found.to_dict()["reason"])
    print(dp.Reason(int(dp.explain(clicks, located.cameras[0], dp.Plane.z(-12.0))[0])).name)
    return float(found.lengths().value[0])


def fleet(views: Sequence[dp.Views], shared: dp.Views) -> list[Tensor]:
    board = dp.Chessboard()
    found = dp.calibrate(views, board, priors={"f_x": (500.0, 5)}, fixed=["k3"], loss=dp.Huber(1))
    many = dp.calibrate(shared, board)
    return [one.rms for one in [*found, *many] if not isinstance(one, dp.CalibrationError)]


def arrays(K: npt.NDArray[np.float64]) -> tuple[Tensor, Tensor]:
    camera = dp.Camera(K.tolist(), R=np.eye(3), t=[0.0, 0.0, 5.0], distortion=dp.BrownConrady([-0.1, 0.01, 0.0, 0.0]))
    camera = dp.stack([camera, dp.Camera.from_opencv(K, np.zeros(4), np.zeros(3), np.zeros(3), size=(640, 480))])
    pixels, seen = camera.project(np.zeros((3, 3)))
    resolution, _ = dp.ground_resolution([[1.0, 2.0], [3, 4]], camera, dp.Plane.z(0))
    dp.figures.accuracy(dp.AccuracyMap.over_image(camera, pixel_sigma=1.0))
    print(seen, resolution, dp.synthetic.photograph(camera[0], dp.Chessboard()), dp.__version__)
    return dp.back_project(pixels, camera, dp.Plane([0.0, 0.0, 1.0], 0.0))


class Above:
    """An observation of the user's own."""

    def residuals(self, camera: dp.Camera) -> Tensor:
        return camera.center[..., 2:] - 6.0


def adjusted(mast: dp.Camera, seen: Sequence[tuple[float, float]]) -> dp.Adjustment:
    horizon = dp.Horizon([[1.0, 2.0], [3.0, 4.0]], 3.0)
    return dp.adjust(mast, [horizon, dp.Seen([(0.0, 0.0, 0.0)], seen), Above()], priors={"height": 0.05})


def straightened(camera: dp.Camera, pixels: Tensor) -> Tensor:
    lens = camera.distortion
    xy = (pixels - camera.K[:2, 2]) / camera.K.diagonal()[:2]
    if lens is None:
        return xy
    undistorted, valid = lens.undistort(xy)
    again, _ = lens.distort(undistorted)
    print(int(valid.sum()), float((again - xy).abs().amax()))
    return undistorted


def rigs(pair: dict[str, dp.Views]) -> list[float]:
    board = dp.Chessboard()
    one = dp.calibrate_rig(pair, board, shape="free", priors={"points": 0.1})
    for name in one:
        print(name, one[name].rms, [camera.center for camera in one[name].cameras])
    print(dp.cross_validate_rig(pair, board).summary(), [len(view) for view in pair["left"]])
    many = dp.calibrate_rig([pair, pair], board, shape="bow")
    print(one.summary(), one.points_deviation.amax())
    return [float(rig.baseline("left", "right").length) for rig in many if isinstance(rig, dp.RigCalibration)]


class Network(nn.Module):
    def __init__(self, camera: dp.Camera) -> None:
        super().__init__()
        self.heads = nn.Linear(8, 2)
        self.projector = dp.PlaneProjector(camera, dp.Plane.z(0.0), learn=("focal", "pose"))

    def forward(self, features: Tensor) -> Tensor:
        points, valid = self.projector(self.heads(features))
        return torch.where(valid.unsqueeze(-1), points, 0.0)


def trained(camera: dp.Camera, calibration: dp.Calibration, features: Tensor, target: Tensor) -> Tensor:
    network, loss, prior = Network(camera), dp.PlaneLoss(dp.Huber(5.0)), dp.CalibrationPrior(calibration)
    points = network.forward(features)
    learnable = dp.LearnableCamera(camera)
    moved: dp.Camera = learnable()
    plane: dp.Plane = dp.LearnablePlane(dp.Plane.z(0.0))()
    print(moved.size, plane.offset)
    moving = dp.LearnableRig(
        {"left": camera, "right": camera}, ("focal", "right.pose", "moments"), (camera.R, camera.t)
    )
    placed: dict[str, dp.Camera] = moving()
    print(placed["left"].center, moving["right"].rotation, moving.names)
    total = loss(points, target) + prior(learnable())
    (slope,) = torch.autograd.grad(total, [network.heads.weight])
    return slope


def mapped(camera: dp.Camera, calibration: dp.Calibration, image: Tensor) -> Tensor:
    to_plane = dp.PlaneMap(camera, dp.Plane.z(0.0))
    points, valid = to_plane(torch.rand(10, 2, dtype=torch.float64))
    accuracy = dp.AccuracyMap.over_image(calibration, view="left01.jpg", step=16)
    print(points[valid].shape, accuracy.extrapolated.sum(), accuracy.deviation.amax())
    return dp.rectify(image, camera, dp.Plane.z(0.0), (0.0, 0.0, 200.0, 125.0), 0.5)[0]


def misspelt() -> None:
    print(dp.calibrat)  # type: ignore[attr-defined]
