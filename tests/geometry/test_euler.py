"""The paper's Euler angles: against Kornia's axis-angle factors, there and back, and at the locked angle."""

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

import diffproj as dp

D = torch.float64


def test_is_the_product_of_rotations_about_x_y_z() -> None:
    psi, phi, theta = torch.randn(3, 50, dtype=D)
    about = [
        axis_angle_to_rotation_matrix(angle[:, None] * axis)
        for angle, axis in zip((psi, phi, theta), torch.eye(3, dtype=D), strict=True)
    ]
    torch.testing.assert_close(
        dp.rotation_from_euler(psi, phi, theta), about[0] @ about[1] @ about[2], atol=1e-15, rtol=0
    )


def test_angles_come_back() -> None:
    psi, theta = (torch.rand(2, 500, dtype=D) * 2 - 1) * torch.pi
    phi = (torch.rand(500, dtype=D) - 0.5) * torch.pi
    found = dp.euler_from_rotation(dp.rotation_from_euler(psi, phi, theta))
    for angle, want in zip(found, (psi, phi, theta), strict=True):
        torch.testing.assert_close(angle, want, atol=1e-12, rtol=0)


@pytest.mark.parametrize("sign", [1, -1])
def test_locked_angles_give_a_rotation_back_and_finite_derivatives(sign: int) -> None:
    half = torch.tensor(sign * torch.pi / 2, dtype=D)
    R = dp.rotation_from_euler(torch.tensor(0.3, dtype=D), half, torch.tensor(0.5, dtype=D)).requires_grad_()
    angles = dp.euler_from_rotation(R)
    assert angles[0].item() == 0
    torch.testing.assert_close(dp.rotation_from_euler(*angles), R, atol=1e-15, rtol=0)
    (gradient,) = torch.autograd.grad(sum(angles), R)
    assert gradient.isfinite().all()


def test_derivatives() -> None:
    angles = tuple(angle.clone().requires_grad_() for angle in torch.tensor([0.4, -0.3, 2.0], dtype=D))
    assert torch.autograd.gradcheck(dp.rotation_from_euler, angles, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(dp.rotation_from_euler, angles)
    R = dp.rotation_from_euler(*angles).detach().requires_grad_()
    assert torch.autograd.gradcheck(dp.euler_from_rotation, R, check_forward_ad=True)


def test_broadcasts() -> None:
    R = dp.rotation_from_euler(torch.zeros(4, 1), torch.zeros(5), torch.tensor(0.1))
    assert R.shape == (4, 5, 3, 3)


@pytest.mark.plain
def test_errors() -> None:
    with pytest.raises(TypeError, match="psi: want a floating-point tensor, got torch.int64"):
        dp.rotation_from_euler(torch.tensor(1), torch.tensor(0.0), torch.tensor(0.0))
    with pytest.raises(TypeError, match="theta: want torch.float32 as psi has, got torch.float64"):
        dp.rotation_from_euler(torch.tensor(1.0), torch.tensor(0.0), torch.tensor(0.0, dtype=D))
    with pytest.raises(ValueError, match=r"R: want shape \(\*B, 3, 3\), got \(4, 4\)"):
        dp.euler_from_rotation(torch.eye(4))
