"""The minimum that `calibrate` and `locate` find is the lowest: no view in the wrong one of its two poses, no side valley.

The oracle is the minimum that the solver reaches from the true cameras. Random problems are drawn in the regimes where
one start in closed form was seen to fail.
"""

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

import diffproj as dp

D = torch.float64
BOARD = dp.Chessboard()
LENS = (-0.25, 0.09, 0.0, 0.0)


def rotations(vectors: Tensor) -> Tensor:
    return axis_angle_to_rotation_matrix(vectors.reshape(-1, 3)).reshape(*vectors.shape[:-1], 3, 3)


def problems(
    count: int,
    views: int,
    focal: tuple[float, float],
    depth: tuple[float, float],
    tilt: tuple[float, float],
    lens: tuple[float, ...] = LENS,
    size: tuple[int, int] = (640, 480),
    missing: float = 0.0,
    outliers: float = 0.0,
    noise: float = 0.2,
    seed: int = 0,
) -> tuple[dp.Views, dp.Camera, Tensor]:
    """Views of the whole board anywhere in the image, the true cameras, and which corners were moved by up to 60 px."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=draw, dtype=D)

    f = uniform(*focal, count)
    c = torch.tensor(size, dtype=D) / 2 - 0.5 + 0.02 * torch.tensor(size, dtype=D) * uniform(-1, 1, count, 2)
    K = torch.eye(3, dtype=D).repeat(count, 1, 1)
    K[:, 0, 0], K[:, 1, 1], K[:, :2, 2] = f, f, c
    camera = dp.Camera(K, distortion=dp.BrownConrady(torch.tensor(lens, dtype=D)), size=size)[:, None]
    R, t = torch.zeros(count, views, 3, 3, dtype=D), torch.zeros(count, views, 3, dtype=D)
    wanting = torch.ones(count, views, dtype=torch.bool)
    for _ in range(300):
        if not bool(wanting.any()):
            break
        towards, lean = uniform(0, 2 * math.pi, count, views), torch.deg2rad(uniform(*tilt, count, views))
        leaning = torch.stack([towards.cos() * lean, towards.sin() * lean, torch.zeros_like(lean)], -1)
        turn = rotations(torch.nn.functional.pad(uniform(-math.pi, math.pi, count, views, 1), (2, 0)))
        turned = rotations(leaning) @ turn
        where = uniform(0, 1, count, views, 1, 2) * (torch.tensor(size, dtype=D) - 1)
        ray = camera.directions(where)[0].squeeze(-2)
        shift = ray / ray[..., 2:] * uniform(*depth, count, views, 1) - turned @ BOARD.points.mean(0)
        pixels, seen = camera.at(turned, shift).project(BOARD.points)
        faces = (turned[..., 2] * (shift + turned @ BOARD.points.mean(0))).sum(-1) > 0
        taken = wanting & (seen & camera.in_image(pixels)).all(-1) & faces
        R, t = torch.where(taken[..., None, None], turned, R), torch.where(taken[..., None], shift, t)
        wanting = wanting & ~taken
    assert not bool(wanting.any())
    truth = camera.at(R, t)
    pixels, visible = truth.project(BOARD.points)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=draw, dtype=D)
    visible = visible & (uniform(0, 1, *visible.shape) >= missing)
    moved = visible & (uniform(0, 1, *visible.shape) < outliers)
    pixels = torch.where(moved.unsqueeze(-1), pixels + uniform(-60, 60, *pixels.shape), pixels)
    visible = visible & camera.in_image(pixels)
    return dp.Views(pixels, visible, size=size), truth, moved & visible


def cost(calibration: dp.Calibration) -> Tensor:
    return calibration.residuals.square().sum((-3, -2, -1))


def from_truth(views: dp.Views, truth: dp.Camera, count: int, **options: Any) -> dp.Calibration:
    known = truth.distortion.coefficients[..., 0, :]  # type: ignore[union-attr]
    lens = dp.BrownConrady(torch.nn.functional.pad(known, (0, count - known.shape[-1])))
    cameras = dp.Camera(truth.K[..., 0, :, :], distortion=lens, size=truth.size)[..., None].at(truth.R, truth.t)
    return dp.refine(views, BOARD, cameras, throw=False, **options)


def turned_by(calibration: dp.Calibration, truth: dp.Camera) -> Tensor:
    """Angles in degrees between poses found and true ones."""
    trace = (calibration.cameras.R * truth.R).sum((-2, -1))
    return torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).acos())


# Of so many problems of each kind, one start alone ended too high in: near 4 of 100, far 6 of 100, long lens 3 of 100,
# few corners 17 of 100 (13 of them refused), telephoto 8 of 100. Now: none of 150 or 300 of each.
FAMILIES: dict[str, tuple[str, dict[str, Any]]] = {
    "near": ("brown4", {"views": 15, "focal": (600, 600), "depth": (250, 1875), "tilt": (0, 50)}),
    "far": ("brown4", {"views": 15, "focal": (600, 600), "depth": (900, 2340), "tilt": (0, 50)}),
    "long lens": ("brown4", {"views": 15, "focal": (1920, 1920), "depth": (900, 3000), "tilt": (0, 50)}),
    "few corners": (
        "brown4",
        {"views": 15, "focal": (600, 600), "depth": (250, 800), "tilt": (0, 50), "missing": 0.85},
    ),
    "telephoto": (
        "brown5",
        {
            "views": 12,
            "focal": (6000, 15000),
            "depth": (2600, 5000),
            "tilt": (10, 40),
            "size": (1224, 1024),
            "lens": (0.0, 0.0, 0.0, 0.0),
        },
    ),
}
COUNTS = {"brown4": 4, "brown5": 5}


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "telephoto"])
def test_no_minimum_is_above_that_from_the_truth(family: str) -> None:
    model, settings = FAMILIES[family]
    views, truth, _ = problems(10, **settings)
    found = dp.calibrate(views, BOARD, model, throw=False)  # type: ignore[arg-type]
    best = from_truth(views, truth, COUNTS[model])
    assert torch.equal(found.converged, best.converged)  # four corners on a line determine no pose, from any start
    assert (cost(found) / cost(best)).max() <= 1 + 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_no_minimum_of_many_is_above_that_from_the_truth(family: str) -> None:
    model, settings = FAMILIES[family]
    views, truth, _ = problems(300, seed=5, **settings)
    found = dp.calibrate(views, BOARD, model, throw=False)  # type: ignore[arg-type]
    best = from_truth(views, truth, COUNTS[model])
    higher = cost(found) > cost(best) * (1 + 1e-6)
    assert int((higher & found.converged).sum()) <= 1
    assert int((best.converged & ~found.converged).sum()) <= 3


def reported_views() -> tuple[Tensor, dp.Camera]:
    """Six clean views of which one start put two into the wrong one of their poses: f 721 where 602 is right."""
    K = torch.tensor([[600.0, 0, 335], [0, 600, 225], [0, 0, 1]], dtype=D)
    vectors = [
        (-0.74, 0, -0.3),
        (-0.18, -0.26, -2.28),
        (0.18, 0.17, 0.33),
        (0.07, 0.04, 0.08),
        (-0.81, -0.22, 1.91),
        (0.19, 0.75, 2.03),
    ]
    shifts = [
        (-11.0, 382, 1875),
        (-330, 212, 909),
        (-497, 138, 1190),
        (107, -65, 651),
        (228, -27, 488),
        (235, 60, 1244),
    ]
    lens = dp.BrownConrady(torch.tensor(LENS, dtype=D))
    R, t = rotations(torch.tensor(vectors, dtype=D)), torch.tensor(shifts, dtype=D)
    truth = dp.Camera(K, R, t, lens, (640, 480))
    noise = np.stack([np.random.default_rng(view).standard_normal((54, 2)) for view in range(6)])
    return truth.project(BOARD.points)[0] + 0.3 * torch.from_numpy(noise), truth


def test_views_in_the_wrong_one_of_their_two_poses() -> None:
    pixels, truth = reported_views()
    found = dp.calibrate(dp.Views(pixels, size=(640, 480)), BOARD, "brown4")
    assert found.camera.K[0, 0].item() == pytest.approx(602.352, abs=1e-3)
    assert found.rms.item() == pytest.approx(0.39588, abs=1e-5)
    assert turned_by(found, truth).max() < 5


def test_neither_copies_nor_company_nor_order_change_the_minimum() -> None:
    pixels, _ = reported_views()
    alone = dp.calibrate(dp.Views(pixels, size=(640, 480)), BOARD, "brown4")
    for copies in (2, 10, 11):
        views = dp.Views(pixels.expand(copies, *pixels.shape), size=(640, 480))
        together = dp.calibrate(views, BOARD, "brown4")
        # To the bit on some processors; on others PyTorch multiplies batches in another order than single matrices.
        torch.testing.assert_close(together.camera.K, alone.camera.K.expand(copies, 3, 3), rtol=1e-12, atol=0)
    order = [3, 5, 0, 4, 2, 1]
    other = dp.calibrate(dp.Views(pixels[order], size=(640, 480)), BOARD, "brown4")
    torch.testing.assert_close(other.camera.K, alone.camera.K, rtol=1e-6, atol=0)


def test_one_wrong_corner_does_not_cost_its_view() -> None:
    """Exact corners but for one; the view far away flips under it, and with least squares all its corners would go."""
    board = dp.Chessboard(10, 9, 0.1)
    K = torch.tensor([[1750.0, 0, 1999.5], [0, 1750, 1099.5], [0, 0, 1]], dtype=D)
    poses = [
        (25, 0, 0, -0.5, -0.4, 1.6),
        (-25, 0, 5, -0.4, -0.4, 1.5),
        (0, 25, -5, -0.6, -0.3, 1.6),
        (0, -25, 0, -0.3, -0.5, 1.5),
        (20, 20, 45, 0, -0.6, 1.7),
        (-20, 20, 90, 0.5, -0.4, 1.8),
        (10, -30, 180, 0.6, 0.5, 1.8),
        (15, 10, 30, -1.2, -0.6, 2.2),
        (30, 0, 0, 0.3, 0.1, 7.0),
    ]
    table = torch.tensor(poses, dtype=D)
    truth = dp.Camera(K, dp.rotation_from_euler(*table[:, :3].deg2rad().unbind(-1)), table[:, 3:])
    pixels = truth.project(board.points)[0].clone()
    pixels[8, 89, 0] += 60
    found = dp.calibrate(dp.Views(pixels, size=(4000, 2200)), board, "brown4", reject_outliers=True)
    assert found.rejected.nonzero().tolist() == [[8, 89]]
    assert turned_by(found, truth).max() < 1e-4
    assert found.camera.K[0, 0].item() == pytest.approx(1750, abs=1e-6)


@pytest.mark.parametrize("share", [pytest.param(0.01, marks=pytest.mark.slow), 0.05])
@pytest.mark.parametrize("options", [{"loss": dp.Huber(0.5)}, {"reject_outliers": True}], ids=["huber", "rejection"])
def test_wrong_corners_turn_no_view(options: dict[str, Any], share: float) -> None:
    """One start left a view turned by more than 10 degrees in 12 and 43 (Huber), 19 and 133 (rejection) of 300."""
    settings: dict[str, Any] = {"views": 10, "focal": (533, 533), "depth": (300, 600), "tilt": (0, 50)}
    views, truth, moved = problems(12, outliers=share, seed=3, **settings)
    found = dp.calibrate(views, BOARD, "brown5", throw=False, **options)
    assert bool(found.converged.all())
    assert turned_by(found, truth).max() < 10
    if "reject_outliers" in options:
        assert int((found.rejected & ~moved).sum()) <= 1
        assert int((~found.used.any(-1)).sum()) == 0


@pytest.mark.slow
def test_a_tilted_lens_leaves_its_side_valley() -> None:
    along = torch.arange(31, dtype=D) * 5 - 75
    x, y = torch.meshgrid(along, along, indexing="xy")

    class Dots:
        points = torch.stack([x.flatten(), y.flatten(), torch.zeros(31 * 31, dtype=D)], dim=-1)

    K = torch.tensor([[3572.985, 0, 799.5], [0, 3572.985, 599.5], [0, 0, 1]], dtype=D)
    coefficients = torch.zeros(14, dtype=D)
    coefficients[:4], coefficients[12] = torch.tensor([0.05, -0.05, 0.005, -0.005]), -0.12688
    vectors = [(2.18546, 0, 0), (2.22656, 0, 0), (2.14248, 0, 0), (2.03768, 0, 0), (2.18072, -0.08364, -0.16142)]
    vectors += [(2.33324, 0, 0), (2.18072, 0.08364, 0.16142)]
    shifts = [(0, -9.1538, 212.9679), (0, -7.7405, 194.9186), (0, -11.005, 234.9506), *[(0, -9.1538, 212.9679)] * 4]
    R, t = rotations(torch.tensor(vectors, dtype=D)), torch.tensor(shifts, dtype=D)
    truth = dp.Camera(K, R, t, dp.BrownConrady(coefficients), (1600, 1200))
    pixels, visible = truth.project(Dots.points)
    pixels = pixels + 0.001 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0), dtype=D)
    views = dp.Views(pixels, visible & truth.in_image(pixels), size=(1600, 1200))
    fixed = ("k3", "k4", "k5", "k6")
    found = dp.calibrate(views, Dots(), "brown14", tied_focal=True, fixed=fixed)
    assert found.rms.item() == pytest.approx(0.00142, abs=2e-5)  # the side valley: 0.011, c_y 1755
    assert found.camera.K[1, 2].item() == pytest.approx(599.5, abs=3)
    assert "hardly tell" not in found.message  # the tilt is in the corners


# ------------------------------------------------------------------------------------------------------------ poses


def test_locate_finds_the_lower_of_two_poses() -> None:
    """A board at 3 m: of 3000 noisy views 23 ended in the pose of higher cost. OpenCV's two poses, refined, are the
    oracle."""
    K = torch.tensor([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]], dtype=D)
    camera = dp.Camera(K, size=(640, 480))
    R = rotations(torch.tensor([0.3, 0.15, 0.8], dtype=D)).expand(200, 3, 3)
    pixels, _ = camera.at(R, torch.tensor([-250.0, 150, 3000], dtype=D)).project(BOARD.points)
    pixels = pixels + 0.2 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0), dtype=D)
    with pytest.warns(dp.AmbiguousPoseWarning):
        found = dp.locate(dp.Views(pixels, size=(640, 480)), BOARD, camera, throw=False)
    costs = found.residuals.square().sum((-2, -1))
    points, matrix = BOARD.points.numpy(), K.numpy()
    for view, seen in enumerate(pixels.numpy()):
        _, vectors, shifts, _ = cv2.solvePnPGeneric(points, seen, matrix, None, flags=cv2.SOLVEPNP_IPPE)
        lowest = math.inf
        for vector, shift in zip(vectors, shifts, strict=True):
            stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
            pose = cv2.solvePnPRefineLM(points, seen, matrix, None, vector.copy(), shift.copy(), stop)
            projected = cv2.projectPoints(points, *pose, matrix, None)[0].reshape(-1, 2)
            lowest = min(lowest, float(np.square(projected - seen).sum()))
        assert float(costs[view]) <= lowest * (1 + 1e-6)


@pytest.mark.parametrize(
    ("vector", "shift"),
    [
        ((0.0399, 0.5908, 0.1668), (0.3557, -0.9578, 0.3175)),
        ((0.5795, 0.3004, 0.0785), (0.5264, -0.7378, 0.1419)),
    ],
)
def test_locate_along_rays_far_off_the_axis(
    vector: tuple[float, float, float], shift: tuple[float, float, float]
) -> None:
    class Marker:
        points = torch.tensor([(-0.1, 0.1, 0), (0.1, 0.1, 0), (0.1, -0.1, 0), (-0.1, -0.1, 0)], dtype=D)

    K = torch.tensor([[605.4, 0, 317.35], [0, 601.2, 242.63], [0, 0, 1]], dtype=D)
    truth = dp.Camera(K, rotations(torch.tensor([vector], dtype=D)), torch.tensor([shift], dtype=D))
    pixels, valid = truth.project(Marker.points)
    assert bool(valid.all())
    found = dp.locate(dp.Views(pixels), Marker(), dp.Camera(K))
    assert found.rms < 1e-9
    torch.testing.assert_close(found.cameras.R, truth.R, rtol=0, atol=1e-9)


# ---------------------------------------------------------------------------------------------------------- verdicts


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e8])
@pytest.mark.parametrize(("objective", "rms"), [("image", 0.1583), ("plane", 0.1601)])
def test_the_verdict_does_not_depend_on_the_unit_of_weights(unit: float, objective: str, rms: float) -> None:
    views = dp.example_views("left")
    weights = torch.tensor(unit, dtype=D)
    good = dp.calibrate(views, BOARD, weights=weights, objective=objective)  # type: ignore[arg-type]
    assert good.rms == pytest.approx(rms, abs=2e-4)
    mixed = views.pixels.clone()
    mixed[4] = mixed[4].reshape(6, 9, 2).transpose(0, 1).reshape(54, 2)
    with pytest.raises(dp.CalibrationError, match=r"left05\.jpg do not match the board"):
        dp.calibrate(dp.Views(mixed, names=views.names, size=views.size), BOARD, weights=weights)


@pytest.mark.slow
def test_a_robust_loss_does_not_hide_a_view_that_fits_nowhere() -> None:
    views = dp.example_views("left")
    mixed = views.pixels.clone()
    mixed[4] = mixed[4].reshape(6, 9, 2).transpose(0, 1).reshape(54, 2)
    for loss in (dp.Huber(0.5), dp.Cauchy(1.0)):
        with pytest.raises(dp.CalibrationError, match=r"left05\.jpg do not match the board"):
            dp.calibrate(dp.Views(mixed, names=views.names, size=views.size), BOARD, loss=loss)


@pytest.mark.parametrize("size", [(480, 640), (320, 240)])
def test_corners_outside_the_photographs_are_refused(size: tuple[int, int]) -> None:
    views = dp.example_views("left")
    wrong = dp.Views(views.pixels, names=views.names, size=size)
    with pytest.raises(ValueError, match=r"views: want corners inside the photographs of .* px, got .* in 'left"):
        dp.calibrate(wrong, BOARD, fixed=("principal_point",))


def test_targets_far_from_the_origin_and_with_too_few_points_are_told_apart() -> None:
    class Three:
        points = torch.eye(3, dtype=D) * torch.tensor([1.0, 1, 0], dtype=D)

    with pytest.raises(ValueError, match="target: want at least 4 points.*got 3"):
        dp.locate(dp.Views(torch.rand(1, 3, 2, dtype=D)), Three(), dp.Camera(torch.eye(3, dtype=D)))
