"""Gradients of `refine` by the camera's own values, where it keeps them or priors are about them."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic
from tests.calibration.fitting.test_implicit import FOURTH_ORDER, Target, situation

D = torch.float64
OWN = torch.tensor([536.0, 531, 320, 240, 0.7, -0.19, 0.045, 0.0012, -0.0008], dtype=D)
"""f_x, f_y, c_x, c_y, skew, and four coefficients of a lens: not those of the views."""
STEP = torch.tensor([1.0, 1, 1, 1, 0.1, 0.01, 0.01, 0.001, 0.001], dtype=D)

PRINTED: dict[str, Any] = {"shape": "free", "priors": {"points": 0.3}, "pixel_sigma": 0.3}
CASES: dict[str, dict[str, Any]] = {
    "focal": {"fixed": ("focal",)},
    "principal point": {"fixed": ("principal_point",)},
    "distortion": {"fixed": ("distortion",)},
    "some": {"fixed": ("f_x", "k2", "c_y")},
    "all": {"fixed": ("focal", "principal_point", "distortion")},
    "tied": {"tied_focal": True},
    "tied, fixed": {"tied_focal": True, "fixed": ("focal",)},
    "tied, prior": {"tied_focal": True, "priors": {"focal": 2.0}, "pixel_sigma": 0.3},
    "prior": {"priors": {"focal": 2.0, "k1": 0.01}, "pixel_sigma": 0.3},
    "priors with means, too": {"priors": {"focal": 2.0, "f_x": (533.0, 1.0), "c_x": (322.0, 1.0)}, "pixel_sigma": 0.3},
    "fitted skew": {"skew": True, "priors": {"skew": 0.1}, "fixed": ("principal_point",), "pixel_sigma": 0.3},
    "loss": {"fixed": ("focal",), "loss": dp.SoftL1(0.5)},
    "huber": {"fixed": ("principal_point",), "loss": dp.Huber(2.0)},
    "plane": {"objective": "plane", "fixed": ("focal",), "priors": {"principal_point": 1.0}},
    "bow": {"shape": "bow", "fixed": ("principal_point",)},
    "free": {"shape": "free", "fixed": ("focal",), "priors": {"points": 0.3, "c_x": 1.0}, "pixel_sigma": 0.3},
    "free, in the plane": {**PRINTED, "fixed": ("points_z",), "tied_focal": True},
}


def camera_of(own: Tensor) -> dp.Camera:
    """The camera of such values `(*B, 9)`."""
    f_x, f_y, c_x, c_y, skew = own[..., :5].unbind(-1)
    zero = torch.zeros_like(f_x)
    rows = [f_x, skew, c_x, zero, f_y, c_y, zero, zero, zero + 1]
    K = torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
    return dp.Camera(K, distortion=dp.BrownConrady(own[..., 5:]), size=(640, 480))


def numbers(found: dp.Calibration) -> Tensor:
    """Intrinsics, lens, poses, and points where they are free."""
    lens = found.camera.distortion
    assert isinstance(lens, dp.BrownConrady)
    parts = [found.camera.K[..., :2, :], 100 * lens.coefficients, found.cameras.t[..., 1, :]]
    parts += [100 * found.cameras.R[..., 3, :, :], *([] if found.displacements is None else [found.points[..., :8, :]])]
    return torch.cat([part.flatten() for part in parts])


def differ(solve: Any, own: Tensor, direction: Tensor, step: float) -> None:
    """Compare the derivative of all numbers along a direction with the finite difference of re-solving, to 1e-4."""
    argument = own.clone().requires_grad_()
    found = numbers(solve(argument, True))
    assert torch.equal(found.detach(), numbers(solve(own, False)))
    rows = [torch.autograd.grad(x, argument, retain_graph=True)[0] for x in found]
    got = torch.stack([(row * direction).sum() for row in rows])
    want = torch.zeros_like(got)
    for steps, weight in FOURTH_ORDER.items():
        ahead, behind = (numbers(solve(own + sign * steps * step * direction, False)) for sign in (1, -1))
        want += weight * (ahead - behind) / step
    # Measured: to 4e-5 of the largest, which is the noise of two minima.
    torch.testing.assert_close(got, want, rtol=0, atol=1e-4 * float(want.abs().amax()))


def refined(own: Tensor, differentiable: bool, views: dp.Views, target: Any, **options: Any) -> dp.Calibration:
    steps: dict[str, Any] = {"tolerance": 1e-17, "max_iterations": 2000}
    return dp.refine(views, target, camera_of(own), differentiable=differentiable, **steps, **options)


@pytest.mark.parametrize("case", list(CASES))
def test_gradient_by_the_cameras_own_values(case: str) -> None:
    """By what is held, tied or about the camera; with `skew` that is held throughout. There was none."""
    _, pixels, visible, points = situation()
    views = dp.Views(pixels, visible, size=(640, 480))

    def solve(own: Tensor, differentiable: bool) -> dp.Calibration:
        return refined(own, differentiable, views, Target(points), **CASES[case])

    differ(solve, OWN, torch.randn(9, dtype=D) * STEP, 0.1 if case == "huber" else 0.3)


@pytest.mark.parametrize("sigma", [None, 0.3])
def test_gradient_of_landmarks(sigma: float | None) -> None:
    camera, *_ = situation()
    truth = synthetic.random_cameras(camera, dp.Chessboard(columns=5, rows=4, square=40.0), 6, seed=1)
    points = torch.rand(20, 3, dtype=D) * torch.tensor([200.0, 120, 60], dtype=D)
    pixels = torch.stack([one.project(points)[0] for one in truth])
    views = dp.Views(pixels + 0.3 * torch.randn_like(pixels), size=(640, 480))

    def solve(own: Tensor, differentiable: bool) -> dp.Calibration:
        priors = {"focal": 2.0, "c_x": 1.0}
        options: dict[str, Any] = {"tied_focal": True, "priors": priors, "pixel_sigma": 0.3}
        return refined(own, differentiable, views, dp.Landmarks(points, sigma=sigma), **options)

    differ(solve, OWN, torch.randn(9, dtype=D) * STEP, 0.3)


@pytest.mark.parametrize("batch", [(), (2,)])
def test_gradient_of_a_batch(batch: tuple[int, ...]) -> None:
    """Of cameras of their own, and of one that begins them all."""
    _, pixels, visible, points = situation()
    both = torch.stack([pixels, pixels + 0.1 * torch.randn_like(pixels)])
    views = dp.Views(both, visible.expand(2, -1, -1), size=(640, 480))

    def solve(own: Tensor, differentiable: bool) -> dp.Calibration:
        options: dict[str, Any] = {"fixed": ("principal_point",), "tied_focal": True, "priors": {"k1": 0.01}}
        return refined(own, differentiable, views, Target(points), pixel_sigma=0.3, **options)

    own = OWN + torch.randn(*batch, 9, dtype=D) * STEP
    differ(solve, own, torch.randn(*batch, 9, dtype=D) * STEP, 0.3)
    if batch:
        argument = own.clone().requires_grad_()
        gradient = torch.autograd.grad(solve(argument, True).camera.K[0, 0, 0], argument)[0]
        assert gradient[0].abs().amax() > 0
        assert (gradient[1] == 0).all()


@pytest.mark.parametrize("with_poses", [False, True])
def test_a_turned_camera_and_one_with_poses(with_poses: bool) -> None:
    _, pixels, visible, points = situation()
    quarter = torch.tensor([[0.0, -1, 479], [1, 0, 0], [0, 0, 1]], dtype=D)
    views = dp.Views(pixels @ quarter[:2, :2].mT + quarter[:2, 2], visible, size=(480, 640))
    rough = dp.refine(views, Target(points), camera_of(OWN).warped(quarter, size=(480, 640)), throw=False)

    def solve(own: Tensor, differentiable: bool) -> dp.Calibration:
        camera = camera_of(own).warped(quarter, size=(480, 640))
        if with_poses:  # turned itself
            camera = camera.upright()[None].expand(6).at(rough.cameras.R, rough.cameras.t)
        options: dict[str, Any] = {"tolerance": 1e-17, "fixed": ("f_x", "k1")}
        return dp.refine(views, Target(points), camera, differentiable=differentiable, **options)

    differ(solve, OWN, torch.randn(9, dtype=D) * STEP, 0.3)


@pytest.mark.parametrize(
    "options",
    [{}, {"priors": {"focal": (533.0, 2.0)}, "pixel_sigma": 0.3}, {**PRINTED, "fixed": ("points_z",)}],
)
def test_a_camera_that_is_a_start_alone_has_no_gradient(options: dict[str, Any]) -> None:
    _, pixels, visible, points = situation()
    own = OWN * (torch.arange(9) != 4)
    argument, seen = own.clone().requires_grad_(), pixels.clone().requires_grad_()
    assert not refined(argument, True, dp.Views(pixels, visible), Target(points), **options).camera.K.requires_grad
    found = refined(argument, True, dp.Views(seen, visible), Target(points), **options)
    assert torch.autograd.grad(found.camera.K[0, 0], [seen, argument], allow_unused=True)[1] is None


def test_without_the_option_nothing_carries_a_gradient() -> None:
    _, pixels, visible, points = situation()
    views, argument = dp.Views(pixels, visible), OWN.clone().requires_grad_()
    options: dict[str, Any] = {"fixed": ("focal",), "priors": {"c_x": 1.0}}
    for differentiable in (False, True):
        with torch.set_grad_enabled(not differentiable):
            found = refined(argument, differentiable, views, Target(points), **options)
        assert not found.camera.K.requires_grad
        assert not found.cameras.t.requires_grad
    located = dp.locate(views, Target(points), camera_of(argument))
    assert not located.camera.K.requires_grad
    assert not located.cameras.t.requires_grad
