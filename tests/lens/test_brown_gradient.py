"""The gradient of the inverse in closed form against the one that autograd records."""

import pytest
import torch

import diffproj as dp
from diffproj.lens.brown_gradient import recorded, with_gradient

KIND = {"dtype": torch.float64, "device": "cpu"}
LENSES = {
    4: [-0.3, 0.1, 1e-3, -2e-3],
    5: [-0.28, 0.07, 1.3e-3, 1e-4, 0.02],
    8: [0.2, -0.1, 1e-3, 2e-3, 0.01, 0.4, -0.05, 0.02],
    12: [-0.2, 0.05, 1e-3, 1e-3, 0.01, 0.1, 0.02, 0.01, 1e-3, -1e-3, 2e-3, 1e-3],
}


@pytest.mark.parametrize("count", LENSES)
@pytest.mark.parametrize("batch", [(), (2,)])
def test_first_and_second_derivatives_are_those_of_the_recorded_steps(count: int, batch: tuple[int, ...]) -> None:
    torch.manual_seed(count)
    lens = dp.BrownConrady(torch.tensor(LENSES[count], **KIND))
    xy = torch.rand(*batch, 30, 2, **KIND) - 0.5
    points, valid = lens.distort(xy)
    valid = valid & (torch.rand(valid.shape, **KIND) > 0.2)
    x, y = torch.where(valid.unsqueeze(-1), lens.undistort(points)[0], 0.0).unbind(-1)
    coefficients, points = lens.coefficients.clone().requires_grad_(), points.detach().requires_grad_()
    inputs, weights = (coefficients, points), torch.randn_like(points)
    slow, fast = (f(coefficients, points, x, y, valid) for f in (recorded, with_gradient))
    torch.testing.assert_close(fast, slow)
    first = [torch.autograd.grad(one, inputs, weights, create_graph=True) for one in (slow, fast)]
    torch.testing.assert_close(torch.autograd.grad(fast, inputs, weights), first[0], rtol=1e-8, atol=1e-8)
    second = [torch.autograd.grad(torch.stack([g.square().sum() for g in one]).sum(), inputs) for one in first]
    torch.testing.assert_close(second[1], second[0], rtol=1e-7, atol=1e-7)


def test_undistort_uses_it() -> None:
    lens = dp.BrownConrady(torch.tensor(LENSES[5], **KIND).requires_grad_())
    xy, _ = lens.undistort(torch.rand(10, 2, **KIND) - 0.5)
    assert "Inverse" in type(xy.grad_fn).__name__
