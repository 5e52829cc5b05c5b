"""A target in national grid coordinates, 5000 km from the world's origin, gives what it gives at the origin."""

import json
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic

D = torch.float64
ORIGIN = torch.tensor([5e5, 5.2e6, 0.0], dtype=D)
VIEWS = dp.example_views("left")
# Metres: at 5.2e6 a coordinate is rounded to 1e-9, which is 1e-9 of the squares of the larger and 4e-8 of the smaller.
SQUARES = {1.0: 1e-8, 0.025: 1e-6}


def far(board: dp.Chessboard) -> SimpleNamespace:
    return SimpleNamespace(points=board.points.to(D) + ORIGIN)


def moved(cameras: dp.Camera) -> Tensor:
    """Translations from where the target's frame had its origin before."""
    return cameras.t + cameras.R @ ORIGIN


@pytest.mark.parametrize(("square", "part"), SQUARES.items())
@pytest.mark.parametrize(
    "options",
    [{}, {"objective": "plane"}, {"shape": "bow"}, {"loss": dp.Huber(0.3)}],
    ids=["plain", "plane", "bow", "huber"],
)
def test_calibrate(square: float, part: float, options: dict[str, Any]) -> None:
    board = dp.Chessboard(square=square)
    near = dp.calibrate(VIEWS, board, **options)
    away = dp.calibrate(VIEWS, far(board), **options)
    assert abs(away.rms - near.rms) < part
    for name, deviation in near.covariance.deviations.items():
        at = near.parameters.names.index(name)
        assert abs(away.shared[at] - near.shared[at]) < 10 * part * deviation
        assert abs(away.covariance.deviations[name] / deviation - 1) < 4 * part
    torch.testing.assert_close(away.cameras.R, near.cameras.R, rtol=0, atol=part)
    torch.testing.assert_close(moved(away.cameras), near.cameras.t, rtol=0, atol=10 * part * square)
    assert torch.equal(away.nominal, far(board).points)


@pytest.mark.parametrize(("square", "part"), SQUARES.items())
def test_measured_deviations(square: float, part: float) -> None:
    board = dp.Chessboard(square=square)
    near, away = dp.calibrate(VIEWS, board), dp.calibrate(VIEWS, far(board))
    pixels = VIEWS.pixels[4, [0, 8, 53, 45]]
    for normal in ([0.0, 0.0, 1.0], [0.1, -0.2, 1.0]):
        offset = float(torch.tensor(normal, dtype=D) @ ORIGIN)
        one = dp.measure(pixels, near, dp.Plane(normal, 0.0), view=4)
        two = dp.measure(pixels, away, dp.Plane(normal, offset), view=4)
        torch.testing.assert_close(two.points - ORIGIN, one.points, rtol=0, atol=10 * part * square)
        axes = slice(0, 2 if normal[0] == 0 else 3)
        torch.testing.assert_close(two.deviations[:, axes], one.deviations[:, axes], rtol=part, atol=0)
        torch.testing.assert_close(two.lengths().value, one.lengths().value, rtol=part, atol=0)
        torch.testing.assert_close(two.lengths().deviation, one.lengths().deviation, rtol=part, atol=0)
    fields = json.loads(json.dumps(away.covariance.to_fields()))
    again = dp.Covariance.from_fields(fields)
    assert again.middle is not None
    for found, kept in ((again.about_middle, away.covariance.about_middle), (again, away.covariance)):
        torch.testing.assert_close(found.view(4), kept.view(4), rtol=1e-9, atol=0)


@pytest.mark.parametrize(("square", "part"), SQUARES.items())
def test_locate_and_refine(square: float, part: float) -> None:
    board = dp.Chessboard(square=square)
    known = dp.calibrate(VIEWS, board)
    near, away = dp.locate(VIEWS, board, known), dp.locate(VIEWS, far(board), known)
    torch.testing.assert_close(away.cameras.R, near.cameras.R, rtol=0, atol=part)
    torch.testing.assert_close(moved(away.cameras), near.cameras.t, rtol=0, atol=10 * part * square)
    posed = dp.refine(VIEWS, far(board), dp.calibrate(VIEWS, far(board)).cameras)
    assert abs(posed.rms - known.rms) < part
    assert int(posed.iterations) <= 1  # the poses that it starts from are understood


def test_exact_corners_of_random_cameras() -> None:
    board = dp.Chessboard(square=0.03)
    K = torch.tensor([[800.0, 0, 320], [0, 810, 240], [0, 0, 1]], dtype=D)
    lens = dp.BrownConrady(torch.tensor([-0.2, 0.05, 0.001, -0.001, 0.0], dtype=D))
    truth = synthetic.random_cameras(dp.Camera(K, distortion=lens, size=(640, 480)), board, 8)
    found = dp.calibrate(synthetic.corner_views(truth, board, noise_px=0.0), far(board))
    assert found.rms < 1e-4  # 1e-9 m of 1 px
    torch.testing.assert_close(found.camera.K, K, rtol=0, atol=1e-3)
    torch.testing.assert_close(moved(found.cameras), truth.t, rtol=0, atol=1e-6)


def test_gradients_of_the_optimum() -> None:
    board = dp.Chessboard(square=0.025)
    camera = dp.calibrate(VIEWS, board).camera

    def gradients(points: Tensor) -> tuple[Tensor, ...]:
        pixels, points = VIEWS.pixels.clone().requires_grad_(), points.clone().requires_grad_()
        views = dp.Views(pixels, size=VIEWS.size)
        found = dp.refine(views, SimpleNamespace(points=points), camera, differentiable=True)
        place = found.cameras.R[3] @ points.detach().mean(0) + found.cameras.t[3]
        return torch.autograd.grad(found.camera.K[0, 0] + 100 * place[0], (pixels, points))

    for near, away in zip(gradients(board.points.to(D)), gradients(far(board).points), strict=True):
        torch.testing.assert_close(away, near, rtol=0, atol=1e-6 * float(near.abs().amax()))


def test_covariance_of_poses_about_both_origins() -> None:
    """A target 3 squares from the origin: the documented `t <- t + tau` is about the world's origin, to first order."""
    board, shift = dp.Chessboard(), torch.tensor([70.0, -40.0, 0.0], dtype=D)
    near = dp.calibrate(VIEWS, board).covariance
    found = dp.calibrate(VIEWS, SimpleNamespace(points=board.points.to(D) + shift))
    s, V = len(near.names), len(VIEWS)
    turn = torch.eye(s + 6 * V, dtype=D)
    for v in range(V):
        a, b, c = (found.cameras.R[v] @ shift).tolist()
        cross = torch.tensor([[0, -c, b], [c, 0, -a], [-b, a, 0]], dtype=D)
        row = s + 6 * v
        turn[row + 3 : row + 6, row : row + 3] = cross  # t' = t - R shift
    want = turn @ near.full() @ turn.mT
    size = want.diagonal().sqrt()
    error = (found.covariance.full() - want) / size / size[:, None]
    assert error.abs().amax() < 1e-6
    view, pair = found.covariance.view(3), found.covariance.between(3, 5)
    rows = [*range(s), *range(s + 18, s + 24)]
    torch.testing.assert_close(view, found.covariance.full()[rows][:, rows], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(pair, found.covariance.full()[s + 18 : s + 24, s + 30 : s + 36], rtol=1e-9, atol=1e-12)


def test_prior_of_a_pose() -> None:
    board = dp.Chessboard(square=0.025)
    near, away = dp.calibrate(VIEWS, board), dp.calibrate(VIEWS, far(board))
    values = []
    for found, middle in ((near, board.points.to(D).mean(0)), (away, far(board).points.mean(0))):
        start = found.cameras[2]
        R = torch.linalg.matrix_exp(1e-3 * torch.tensor([[0, -1.0, 2], [1, 0, -3], [-2, 3, 0]], dtype=D)) @ start.R
        place = start.R @ middle + start.t + 1e-4
        values.append(dp.CalibrationPrior(found, view=2)(start.at(R, place - R @ middle)))
    assert values[0] > 10
    torch.testing.assert_close(values[1], values[0], rtol=1e-4, atol=0)


@pytest.mark.parametrize("count", [4, 6, 9])
def test_exact_corners_are_located(count: int) -> None:
    """What is left of their residuals is the rounding of coordinates; no step lowers that, and none needs to."""
    generator = torch.Generator().manual_seed(count)
    drone = dp.Camera.mounted(80.0, 50.0, heading_deg=30.0, focal=2300.0, size=(4000, 3000)).shifted(-ORIGIN)
    clicked = 500 + torch.rand(4, count, 2, dtype=D, generator=generator) * torch.tensor([3000.0, 2000.0], dtype=D)
    ground, _ = dp.back_project(clicked, drone, dp.Plane.z(0.0))
    for points in ground + torch.rand(4, count, 3, dtype=D, generator=generator) * torch.tensor([0, 0, 5.0], dtype=D):
        pixels, _ = drone.project(points)
        found = dp.locate(dp.Views([pixels], size=(4000, 3000)), dp.Landmarks(points), drone, pixel_sigma=1.0)
        assert found.rms < 1e-6
        torch.testing.assert_close(found.cameras.center[0], drone.center, rtol=0, atol=1e-5)
