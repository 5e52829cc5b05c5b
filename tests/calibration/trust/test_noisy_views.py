"""A view whose corners err more than the others': its pose is as uncertain as that makes it, and it is named."""

import math
from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj import synthetic

D = torch.float64
BOARD = dp.Chessboard()
SIZE = (640, 480)
SIGMA = 0.2
TRUE = synthetic.random_cameras(
    dp.Camera(
        torch.tensor([[533.0, 0, 322], [0, 534, 235], [0, 0, 1]], dtype=D),
        distortion=dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.0], dtype=D)),
        size=SIZE,
    ),
    BOARD,
    8,
    seed=5,
)


def views(blur: float, draws: int) -> dp.Views:
    """Noisy views, the first of them more so."""
    generator = torch.Generator().manual_seed(3)
    exact, seen = TRUE.project(BOARD.points)
    assert bool(seen.all())
    noise = SIGMA * torch.randn((draws, *exact.shape), generator=generator, dtype=D)
    noise[:, 0] *= blur / SIGMA
    return dp.Views(exact + noise, size=SIZE)


def errors_in_first_view(found: dp.Calibration) -> torch.Tensor:
    """Errors of points on the board, from exact pixels in the first view, in deviations."""
    points = BOARD.points[[0, len(BOARD.points) - 1]].to(D)
    pixels, _ = TRUE[0].project(points)
    measured = dp.measure(pixels.expand(len(found.status), -1, -1), found, dp.Plane.z(0.0), view=0, pixel_sigma=1e-3)
    return ((measured.points - points) / measured.deviations)[..., :2]


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"loss": dp.Huber(0.5)}, {"reject_outliers": True}, {"objective": "plane"}])
@pytest.mark.parametrize("blur", [SIGMA, 0.5, 1.2, 3.0])
def test_points_in_a_blurred_view_are_within_their_deviations(blur: float, options: dict[str, Any]) -> None:
    """By the pooled noise they would be off by twice to eight times that."""
    found = dp.calibrate(views(blur, 60), BOARD, throw=False, **options)
    level = float(errors_in_first_view(found)[found.used[:, 0].any(-1)].square().mean().sqrt())
    assert level < 1.3
    if blur == SIGMA:
        assert level > 0.8


def test_a_view_of_which_most_corners_are_left_out_is_named() -> None:
    found = dp.calibrate(dp.Views(views(5.0, 1).pixels[0], size=SIZE), BOARD, reject_outliers=True)
    used, lost = int(found.used[0].sum()), int(found.rejected[0].sum())
    assert 4 <= used < 10
    assert used + lost == len(BOARD.points)
    assert f"{lost} of {len(BOARD.points)} in view 1" in found.remarks[0]
    assert "too many corners were left out as outliers" in found.doubts
    assert "another look at view 1" in found.verdict
    on_board = [BOARD.points[:2, :2].mean(0).tolist()]
    assert "view 1" in dp.measure(on_board, found, dp.Plane.z(0.0), view=0, pixel_sigma=0.2).doubts
    assert not dp.measure(on_board, found, dp.Plane.z(0.0), view=1, pixel_sigma=0.2).doubts
    many = dp.calibrate(views(5.0, 2), BOARD, reject_outliers=True)
    assert "in view 1 of camera (1,)" in many.doubts


def test_every_visible_corner_is_used_or_rejected() -> None:
    """Whichever of the starts the minimum is from."""
    seen = views(1.2, 16)
    found = dp.calibrate(seen, BOARD, reject_outliers=True)
    enough = found.used.any(-1, keepdim=True)
    assert torch.equal((found.used | found.rejected) & enough, seen.visible & enough)


def test_gross_outliers_leave_the_others_as_they_are() -> None:
    """A fifth of the corners far off says nothing of the noise of the others."""
    plain = views(SIGMA, 20)
    pixels = plain.pixels.clone()
    wrong = torch.randperm(len(BOARD.points), generator=torch.Generator().manual_seed(1))[: len(BOARD.points) // 5]
    generator = torch.Generator().manual_seed(2)
    pixels[:, 0, wrong] += 15 * torch.randn(20, len(wrong), 2, generator=generator, dtype=D)
    found = dp.calibrate(dp.Views(pixels, size=SIZE), BOARD, reject_outliers=True)
    known = dp.calibrate(plain.hiding(found.rejected), BOARD)
    spread = found.covariance.poses[:, 0].diagonal(dim1=-2, dim2=-1) / known.covariance.poses[:, 0].diagonal(
        dim1=-2, dim2=-1
    )
    assert math.isclose(float(spread.median()), 1.0, rel_tol=0.05)


@pytest.mark.parametrize(("scale", "named"), [(0.2, True), (0.5, True), (3.0, False)])
def test_a_view_that_is_too_noisy_for_a_redescending_loss_is_named(scale: float, named: bool) -> None:
    """Of many minima it has one, and its pose is off by several of its deviations."""
    found = dp.calibrate(dp.Views(views(1.2, 1).pixels[0], size=SIZE), BOARD, loss=dp.Cauchy(scale))
    assert ("in view 1" in found.doubts) == named
    assert "view 2" not in found.doubts
