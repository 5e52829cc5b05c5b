"""The panels that the calibration's solver works on: residuals and closed-form Jacobians of both objectives."""

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

import diffproj as dp
from diffproj.calibration.problem.board_error import BoardError
from diffproj.calibration.problem.bow import bow_shape
from diffproj.calibration.problem.parametrisation import Parametrisation, moved
from diffproj.calibration.problem.reprojection import Reprojection
from diffproj.lens.models import MODELS, LensModel, model_of

D = torch.float64
P, V = 2, 3


def situation(
    lens: LensModel, bow: bool, skew: bool = False
) -> tuple[dp.Chessboard, torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """Shared parameters, board and poses at random; every coefficient differs from 0."""
    board = dp.Chessboard(columns=5, rows=4, square=40.0)
    intrinsics = torch.tensor([500.0, 510, 320, 240], dtype=D) + torch.randn(P, 4, dtype=D)
    coefficients = 0.02 * torch.randn(P, MODELS[lens].count, dtype=D) + 0.01
    extra = [5 * torch.randn(P, int(skew), dtype=D), 3 * torch.randn(P, 2 * bow, dtype=D)]
    shared = torch.cat([intrinsics, coefficients, *extra], dim=-1)
    R = axis_angle_to_rotation_matrix(0.3 * torch.randn(P * V, 3, dtype=D)).reshape(P, V, 3, 3)
    t = 20 * torch.randn(P, V, 3, dtype=D) + torch.tensor([-80.0, -60, 500], dtype=D)
    return board, shared, (R, t)


def residual(
    kind: type[Reprojection],
    board: dp.Chessboard,
    pixels: torch.Tensor,
    lens: LensModel,
    bow: bool,
    skew: bool,
    shared: torch.Tensor,
    local: tuple[torch.Tensor, ...],
) -> torch.Tensor:
    """`(P, V, 2, N)` through the public camera and the public back-projection."""
    cameras = Parametrisation(lens, bow, skew).unpack(shared, local)
    points = board.points.expand(P, 1, -1, 3)
    if bow:
        z = (shared[:, None, -2:, None] * bow_shape(board.points)).sum(2)
        points = points + torch.nn.functional.pad(z.unsqueeze(-1), (2, 0))
    if kind is BoardError:
        landed, valid = dp.back_project(pixels, cameras, dp.Plane.z(0.0))
        assert valid.all()
        return (landed - board.points)[..., :2].mT
    projected, valid = cameras.project(points)
    assert valid.all()
    return (projected - pixels).mT


LONG = ("brown8", "brown12", "brown14")
LENSES = [pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in MODELS]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("skew", [False, True])
@pytest.mark.parametrize(("kind", "bow"), [(Reprojection, False), (Reprojection, True), (BoardError, False)])
def test_jacobians_are_autograds(kind: type[Reprojection], lens: LensModel, bow: bool, skew: bool) -> None:
    board, shared, local = situation(lens, bow, skew)
    cameras = Parametrisation(lens, bow, skew).unpack(shared, local)
    pixels = cameras.project(board.points)[0] + torch.randn(P, V, len(board), 2, dtype=D)
    problem = kind(board.points, pixels, torch.ones(pixels.shape[:-1], dtype=torch.bool), lens, bow, skew)
    panel = problem.linearise(shared, local).clone()
    torch.testing.assert_close(
        panel[:, :, -1], residual(kind, board, pixels, lens, bow, skew, shared, local), rtol=0, atol=1e-10
    )
    s = Parametrisation(lens, bow, skew).size
    # Each direction at once, for every camera and view: a step along it moves all of them.
    zero = torch.zeros(P, V, 6, dtype=D)
    for row in range(s + 6):
        direction = torch.nn.functional.one_hot(torch.tensor(row), s + 6).to(D)

        def along(step: torch.Tensor, direction: torch.Tensor = direction) -> torch.Tensor:
            pose = moved(local, zero + step * direction[s:])
            return residual(kind, board, pixels, lens, bow, skew, shared + step * direction[:s], pose)

        _, want = torch.func.jvp(along, (torch.zeros((), dtype=D),), (torch.ones((), dtype=D),))
        scale = float(want.abs().amax()) + 1e-12
        torch.testing.assert_close(
            panel[:, :, row], want, rtol=0, atol=1e-11 * scale, msg=lambda m, row=row: f"{row}: {m}"
        )
        step = 1e-5 * max(1.0, float(shared[:, row].abs().amax())) if row < s else 1e-5
        nudge = torch.tensor(step, dtype=D)
        finite = (along(nudge) - along(-nudge)) / (2 * step)
        torch.testing.assert_close(panel[:, :, row], finite, rtol=0, atol=2e-5 * scale)


@pytest.mark.parametrize("lens", MODELS)
def test_unused_corners_are_zero_wherever_they_are(lens: LensModel) -> None:
    board, shared, (R, t) = situation(lens, bow=True, skew=True)
    used = torch.rand(P, V, len(board)) > 0.3
    problem = Reprojection(board.points, torch.rand(P, V, len(board), 2, dtype=D), used, lens, bow=True, skew=True)
    every = Reprojection(board.points, problem.pixels, torch.ones_like(used), lens, bow=True, skew=True)
    seen = used[:, :, None, None].expand(P, V, shared.shape[-1] + 7, 2, len(board))
    panel = problem.linearise(shared, (R, t)).clone()
    assert (panel[~seen] == 0).all()
    assert torch.equal(panel[seen], every.linearise(shared, (R, t))[seen])
    away = torch.where(torch.rand(P, V, 1) > 0.5, t - torch.tensor([0.0, 0, 500], dtype=D), t)  # on the camera's plane
    assert (problem.linearise(shared, (R, away))[~seen] == 0).all()


def test_unused_corners_are_zero_and_behind_is_no_cost() -> None:
    board, shared, (R, t) = situation("brown5", bow=False)
    used = torch.rand(P, V, len(board)) > 0.3
    pixels = torch.rand(P, V, len(board), 2, dtype=D)
    away = t.clone()
    away[0, 0, 2] = -500
    panel = Reprojection(board.points, pixels, used, "brown5").linearise(shared, (R, away))
    assert (panel.movedim(-1, 2)[~used] == 0).all()
    assert panel[0, 0].isnan().any()
    assert panel[0, 1:].isfinite().all()
    assert panel[1].isfinite().all()
    # Corners that do not count may be anywhere.
    nowhere = torch.zeros_like(used)
    assert (
        Reprojection(board.points, pixels, nowhere, "fisheye").linearise(shared[:, :8], (R, away))[..., -7:, :, :] == 0
    ).all()


def test_fisheye_on_the_axis_and_sideways() -> None:
    points = torch.tensor([[0.0, 0, 0], [1e-12, 0, 0], [3000.0, 0, 0], [0, 3000, 0]], dtype=D)
    shared = torch.tensor([[300.0, 310, 320, 240, 0.02, -0.01, 0.003, 0.001]], dtype=D)
    R, t = torch.eye(3, dtype=D).expand(1, 1, 3, 3), torch.tensor([[[0.0, 0, 2]]], dtype=D)
    problem = Reprojection(points, torch.zeros(1, 1, 4, 2, dtype=D), torch.ones(1, 1, 4, dtype=torch.bool), "fisheye")
    panel = problem.linearise(shared, (R, t)).clone()
    assert panel.isfinite().all()

    def project(tau: torch.Tensor) -> torch.Tensor:
        return Parametrisation("fisheye").unpack(shared, (R, t + tau)).project(points)[0].mT

    want = torch.func.jacfwd(project)(torch.zeros(1, 1, 3, dtype=D))[0, 0, :, :, 0, 0].permute(2, 0, 1)
    torch.testing.assert_close(panel[0, 0, -4:-1], want, rtol=1e-12, atol=1e-12)


def test_moved_is_the_exponential_to_second_order() -> None:
    R = axis_angle_to_rotation_matrix(torch.randn(5, 3, dtype=D))
    t = torch.randn(5, 3, dtype=D)
    for size in (1e-3, 2.0):
        step = size * torch.randn(5, 6, dtype=D)
        turned, shifted = moved((R, t), step)
        torch.testing.assert_close(turned @ turned.mT, torch.eye(3, dtype=D).expand(5, 3, 3), rtol=0, atol=1e-14)
        assert torch.equal(shifted, t + step[:, 3:])
        if size < 1:
            exact = axis_angle_to_rotation_matrix(step[:, :3]) @ R
            assert float((turned - exact).abs().amax()) < step[:, :3].norm(dim=-1).amax() ** 3


def test_lens_models_by_name() -> None:
    for name, model in MODELS.items():
        assert model_of(model.lens(torch.zeros(model.count, dtype=D))) is model
        assert model.name == name
    with pytest.raises(TypeError, match="camera: want a pinhole"):
        model_of("brown5")


@pytest.mark.parametrize("bow", [False, True])
@pytest.mark.parametrize("lens", MODELS)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_parameters_go_into_a_vector_and_back(lens: LensModel, bow: bool, batch: tuple[int, ...]) -> None:
    parameters = Parametrisation(lens, bow)
    shared = torch.randn(*batch, parameters.size, dtype=D)
    R, t = torch.eye(3, dtype=D).expand(*batch, 4, 3, 3), torch.randn(*batch, 4, 3, dtype=D)
    camera = parameters.unpack(shared, (R, t))
    assert camera.batch_shape == (*batch, 4)
    assert torch.equal(camera.t, t)
    again = parameters.pack(camera[..., 0], shared[..., -2:] if bow else None)
    assert torch.equal(again, shared)
    assert len(parameters.names) == parameters.size
    assert Parametrisation.of(camera, bow) == parameters
