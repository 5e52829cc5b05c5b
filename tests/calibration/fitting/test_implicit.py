"""The differentiable optimum: gradients of `refine` against finite differences of re-solving."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj import synthetic
from diffproj.calibration.circle_centres import middle_minus_centre

D = torch.float64


def situation(outliers: bool = False) -> tuple[dp.Camera, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A start, the corners, their visibility and the board's points: small, so that re-solving is fast."""
    board = dp.Chessboard(columns=5, rows=4, square=40.0)
    K = torch.tensor([[533.0, 0, 322], [0, 534, 238], [0, 0, 1]], dtype=D)
    lens = dp.BrownConrady(torch.tensor([-0.2, 0.05, 0.001, -0.001], dtype=D))
    truth = synthetic.random_cameras(dp.Camera(K, distortion=lens, size=(640, 480)), board, 6, seed=1)
    views = synthetic.corner_views(truth, board, noise_px=0.3, seed=1)
    pixels, visible = views.pixels.clone(), views.visible.clone()
    visible[2, :7] = False
    visible[5, 3:] = False  # too few corners: no part
    if outliers:
        wrong = torch.rand(visible.shape) < 0.05
        pixels[wrong] += 15 * torch.randn(int(wrong.sum()), 2, dtype=D)
    return truth[0].without_pose(), pixels, visible, board.points


class Target:
    def __init__(self, points: torch.Tensor) -> None:
        self.points = points


def answer(calibration: dp.Calibration) -> torch.Tensor:
    """Numbers of every kind of parameter: intrinsics, lens, a pose, the bow."""
    K = calibration.camera.K
    lens = calibration.camera.distortion
    assert isinstance(lens, dp.BrownConrady)
    parts = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *(100 * lens.coefficients)]
    parts += [*calibration.cameras.t[1], *(100 * calibration.cameras.R[3].flatten())]
    parts += [] if calibration.bow is None else list(100 * calibration.bow)
    parts += [] if calibration.displacements is None else list(calibration.points[[0, 7, 19]].flatten())
    return torch.stack(parts)


CENTRAL, FOURTH_ORDER = {1: 1 / 2}, {1: 2 / 3, 2: -1 / 12}
"""Finite differences: weights of how much the values so many steps ahead and behind differ."""


def check(
    solve: Callable[[torch.Tensor, bool], dp.Calibration],
    value: torch.Tensor,
    step: float,
    stencil: dict[int, float] = CENTRAL,
) -> None:
    """The directional derivative of every number against a finite difference, to 1e-4 of the largest of its kind."""
    direction = torch.randn_like(value)
    argument = value.clone().requires_grad_()
    found = answer(solve(argument, True))
    rows = [torch.autograd.grad(x, argument, retain_graph=True)[0] for x in found]
    got = torch.stack([(row * direction).sum() for row in rows])
    with torch.no_grad():
        want = torch.zeros_like(got)
        for steps, weight in stencil.items():
            ahead, behind = (answer(solve(value + sign * steps * step * direction, False)) for sign in (1, -1))
            want += weight * (ahead - behind) / step
    torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-5 * float(want.abs().amax()))


CASES: dict[str, dict[str, Any]] = {
    "plain": {},
    "bow": {"shape": "bow"},
    "free": {"shape": "free", "weights": torch.tensor(10.0, dtype=D), "priors": {"points": 1.0}},
    "fixed": {"fixed": ("c_x", "p1"), "tied_focal": True},
    "huber": {"loss": dp.Huber(0.5)},
    "cauchy": {"loss": dp.Cauchy(1.0)},
    "plane": {"objective": "plane"},
}


STEPS = {"huber": 3e-5, "free": 1e-3}
"""Steps in px; a longer one takes corners across Huber's kink, where the gradient changes by a jump, and free points of
five views along a curve."""


@pytest.mark.parametrize("case", list(CASES))
def test_gradient_by_pixels(case: str) -> None:
    robust = case in ("huber", "cauchy")
    camera, pixels, visible, points = situation(outliers=robust)

    def solve(pixels: torch.Tensor, differentiable: bool) -> dp.Calibration:
        views = dp.Views(pixels, visible, size=(640, 480))
        return dp.refine(
            views,
            Target(points),
            camera,
            differentiable=differentiable,
            tolerance=1e-17,
            max_iterations=2000,
            **CASES[case],
        )

    check(solve, pixels, STEPS.get(case, 5e-3))


@pytest.mark.parametrize("shape", ["flat", "free"])
def test_gradient_by_board_points(shape: str) -> None:
    camera, pixels, visible, points = situation()
    in_plane = torch.tensor([1.0, 1.0, 0.0], dtype=D)

    def solve(points: torch.Tensor, differentiable: bool) -> dp.Calibration:
        views = dp.Views(pixels, visible, size=(640, 480))
        options: dict[str, Any] = {"differentiable": differentiable, "tolerance": 1e-17}
        options |= CASES["free"] if shape == "free" else {}
        return dp.refine(views, Target(points * in_plane), camera, **options)

    check(solve, points, 1e-3 if shape == "flat" else 1e-2)


@pytest.mark.parametrize("loss", [None, dp.Huber(0.5)])
def test_gradient_by_weights(loss: dp.Loss | None) -> None:
    camera, pixels, visible, points = situation(outliers=loss is not None)
    weights = 0.5 + torch.rand(visible.shape, dtype=D)

    def solve(weights: torch.Tensor, differentiable: bool) -> dp.Calibration:
        views = dp.Views(pixels, visible, size=(640, 480))
        options = {"weights": weights, "loss": loss, "tolerance": 1e-17, "max_iterations": 2000}
        return dp.refine(views, Target(points), camera, differentiable=differentiable, **options)

    check(solve, weights, 3e-5 if loss else 1e-3)


def test_gradient_by_priors() -> None:
    camera, pixels, visible, points = situation()

    def solve(values: torch.Tensor, differentiable: bool) -> dp.Calibration:
        views = dp.Views(pixels, visible, size=(640, 480))
        priors = {"focal": (values[:2], values[2].abs()), "k2": values[3]}
        return dp.refine(views, Target(points), camera, priors=priors, differentiable=differentiable, tolerance=1e-17)

    # A step whose square does not matter leaves the noise of two minima.
    check(solve, torch.tensor([530.0, 540, 2.0, 0.05], dtype=D), 2e-3, FOURTH_ORDER)


def test_gradient_by_how_well_the_target_was_printed() -> None:
    camera, pixels, visible, points = situation()

    def solve(deviations: torch.Tensor, differentiable: bool) -> dp.Calibration:
        views = dp.Views(pixels, visible, size=(640, 480))
        options: dict[str, Any] = {"shape": "free", "pixel_sigma": 0.3, "tolerance": 1e-17}
        priors = {"points": 0.5, "points_x": deviations}
        return dp.refine(views, Target(points), camera, priors=priors, differentiable=differentiable, **options)

    check(solve, 0.5 + torch.rand(20, dtype=D), 1e-2, FOURTH_ORDER)


def test_gradient_by_the_middles_of_circles(monkeypatch: pytest.MonkeyPatch) -> None:
    """The correction follows the camera: without that gradients were off by 8e-3 of the largest.

    Finite differences want it settled; as it is used, gradients are right to some 1e-5 of the largest.
    """
    monkeypatch.setattr("diffproj.calibration.circle_centres.SETTLED", 1e-9)
    board = dp.CircleGrid(5, 4, spacing=40.0, diameter=30.0)
    camera, *_ = situation()
    truth = synthetic.random_cameras(camera, board, 6, seed=1)
    seen = synthetic.corner_views(truth, board, noise_px=0.1, seed=1)

    def solve(middles: torch.Tensor, differentiable: bool) -> dp.Calibration:
        views = dp.Views(middles, seen.visible, size=(640, 480))
        return dp.refine(views, board, camera, differentiable=differentiable, tolerance=1e-17)

    check(solve, seen.pixels + middle_minus_centre(truth, board), 2e-2, FOURTH_ORDER)


@pytest.mark.parametrize("weights", [{}, {"weights": 4.0}, {"pixel_sigma": 0.3, "loss": dp.Huber(1.0)}])
@pytest.mark.parametrize("views", [6, 1])
def test_landmarks_that_are_weighed_by_the_minimum_are_refused(views: int, weights: dict[str, Any]) -> None:
    """Gradients were off by 2 % to 5 % without `pixel_sigma`, and of one view there were none."""
    camera, pixels, _, points = situation()
    seen, landmarks = dp.Views(pixels[:views].requires_grad_(), size=(640, 480)), dp.Landmarks(points, sigma=0.3)
    want = "want pixel_sigma= and no loss" if views > 1 else "want several views"
    fixed = () if views > 1 else ("focal", "principal_point", "distortion")
    with pytest.raises(ValueError, match=want):
        dp.refine(seen, landmarks, camera, differentiable=True, fixed=fixed, **weights)


def test_points_that_are_weighed_by_the_minimum_are_refused() -> None:
    """Gradients were off by 80 %."""
    camera, pixels, visible, points = situation()
    views = dp.Views(pixels.requires_grad_(), visible, size=(640, 480))
    options: dict[str, Any] = {"shape": "free", "priors": {"points_z": 1.0, "points_x": 1.0}}
    with pytest.raises(ValueError, match="want pixel_sigma= or weights= beside priors on the target's points"):
        dp.refine(views, Target(points), camera, differentiable=True, **options)


def test_values_are_those_of_the_solver_and_batches_keep_apart() -> None:
    camera, pixels, visible, points = situation()
    both = torch.stack([pixels, pixels + 0.1 * torch.randn_like(pixels)]).requires_grad_()
    views = dp.Views(both, visible.expand(2, -1, -1), size=(640, 480))
    plain = dp.refine(views, Target(points), camera)
    found = dp.refine(views, Target(points), camera, differentiable=True)
    assert torch.equal(found.camera.K.detach(), plain.camera.K)
    assert torch.equal(found.cameras.R.detach(), plain.cameras.R)
    assert not plain.camera.K.requires_grad
    gradient = torch.autograd.grad(found.camera.K[0, 0, 0], both)[0]
    assert (gradient[1] == 0).all()
    assert (gradient[0][~visible] == 0).all()
    assert (gradient[0, 5] == 0).all()
    assert gradient[0, 0].abs().max() > 0


def test_second_derivatives_are_warned_of() -> None:
    """Of a penalty on a gradient only those of the minimum count, and were left out: 0 for 36."""
    camera, pixels, visible, points = situation()
    views = dp.Views(pixels.requires_grad_(), visible, size=(640, 480))
    focal = dp.refine(views, Target(points), camera, differentiable=True).camera.K[0, 0]
    torch.autograd.grad(focal, pixels, retain_graph=True)
    with pytest.warns(UserWarning, match="create_graph: want False for the gradient of a minimum"):
        torch.autograd.grad(focal, pixels, create_graph=True)
