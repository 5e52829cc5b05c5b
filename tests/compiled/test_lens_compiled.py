"""Lenses under `torch.compile(fullgraph=True)`: the same results and derivatives as eager."""

import pytest
import torch
from torch import Tensor

from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt

CASES = {
    "brown5": (BrownConrady, [-0.2535, 0.0924, -0.0006, 0.0007, -0.0191]),
    "brown8": (BrownConrady, [22.0, 8.0, 1e-4, 2e-4, 0.2, 22.3, 15.0, 1.6]),
    "brown14": (
        BrownConrady,
        [-0.25, 0.09, -6e-4, 7e-4, -0.02, 0.01, -0.003, 0.001, 1e-3, -1e-4, 2e-3, 1e-4, 0.02, -0.03],
    ),
    "fisheye": (KannalaBrandt, [0.01, -0.002, 0.0, 0.0]),
}


def points(count: int) -> Tensor:
    return torch.randn(count, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.6


@pytest.mark.parametrize(
    "name", [name if name == "brown5" else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_results_and_gradients(name: str) -> None:
    kind, values = CASES[name]
    coefficients = torch.tensor(values, dtype=torch.float64)

    def round_trip(xy: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        lens = kind(coefficients)
        direction, valid = lens.unproject(xy)
        again, _ = lens.project_direction(direction)
        return direction, again, valid

    xy = points(300)
    results = []
    for function in (round_trip, torch.compile(round_trip, fullgraph=True)):
        arguments = xy.clone().requires_grad_(), coefficients.clone().requires_grad_()
        direction, again, valid = function(*arguments)
        gradients = torch.autograd.grad(direction.sin().sum() + again.square().sum(), arguments)
        results.append((direction, again, valid, *gradients))
    for eager, other in zip(*results, strict=True):
        torch.testing.assert_close(other, eager, rtol=1e-9, atol=1e-11)
    assert (results[1][1] - xy)[results[1][2]].abs().max() < 1e-12


def test_a_lens_as_an_argument() -> None:
    lens = BrownConrady(torch.tensor(CASES["brown5"][1], dtype=torch.float64))
    function = torch.compile(lambda lens, xy: lens.undistort(xy), fullgraph=True)
    for count in (50, 51):
        xy = points(count)
        for compiled, eager in zip(function(lens, xy), lens.undistort(xy), strict=True):
            torch.testing.assert_close(compiled, eager, rtol=1e-13, atol=1e-13)


def test_next_to_the_fold() -> None:
    """A millionth of the radius in front of it fixed steps would not do: the compiled lens takes more, too."""
    lens = BrownConrady(torch.tensor(CASES["brown5"][1], dtype=torch.float64))
    angle = torch.linspace(0, 6.28, 50, dtype=torch.float64)
    share = 1 - 10 ** torch.linspace(-6, -2, 50, dtype=torch.float64)
    edge = (lens.domain * share).unsqueeze(-1) * torch.stack([angle.cos(), angle.sin()], dim=-1)
    xy, _ = lens.distort(edge)
    found, valid = torch.compile(lambda points: lens.undistort(points), fullgraph=True)(xy)
    assert valid.all()
    assert (lens.distort(found)[0] - xy).abs().max() < 1e-12


def test_vmap_and_jvp_inside() -> None:
    many = torch.tensor(CASES["brown5"][1], dtype=torch.float64) * torch.tensor([[0.5], [1.0]], dtype=torch.float64)
    xy = points(20)

    def slopes(many: Tensor) -> Tensor:
        def one(c: Tensor) -> Tensor:
            return torch.func.jvp(lambda c: BrownConrady(c).undistort(xy)[0], (c,), (torch.ones_like(c),))[1]

        return torch.func.vmap(one)(many)

    torch.testing.assert_close(torch.compile(slopes, fullgraph=True)(many), slopes(many), rtol=1e-9, atol=1e-11)
