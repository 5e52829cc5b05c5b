"""The start of the Brown-Conrady inverse: few points need more than the fixed steps, and those get them."""

import math

import pytest
import torch
from torch import Tensor

from diffproj.lens import brown_inverse
from diffproj.lens.brown_conrady import BrownConrady

ORDINARY = {
    "webcam": [-0.28, 0.07, 0.0013, 0.0001, 0.002],
    "wide": [-0.2535, 0.0924, -0.0006, 0.0007, -0.0191],
    "pincushion": [0.1, 0.02, 0.001, -0.0005, 0.0],
    "rational": [22.0, 8.0, 1e-4, 2e-4, 0.2, 22.3, 15.0, 1.6],
    "prism": [-0.25, 0.09, -6e-4, 7e-4, -0.02, 0.01, -0.003, 0.001, 1e-3, -1e-4, 2e-3, 1e-4],
    "radial alone": [-0.3, 0.1, 0.0, 0.0, -0.015],
}
DECENTRED = {"decentred": [-0.3, 0.1, 0.05, 0.03, 0.0], "prism": [-0.3, 0.1, 0.0, 0.0, 0.0, 0, 0, 0, 0.05, 0, -0.04, 0]}


def seen(lens: BrownConrady, radius: float, count: int = 20_000) -> tuple[Tensor, Tensor]:
    """Points of a disc, and where an exact lens sees them, in the lens's type."""
    u, angle = torch.rand(2, count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    r, angle = radius * u.sqrt(), 2 * math.pi * angle
    xy = torch.stack([r * angle.cos(), r * angle.sin()], dim=-1)
    xy_distorted, valid = lens.to(torch.float64).distort(xy)
    assert valid.all()
    return xy, xy_distorted.to(lens.dtype)


def share_left(lens: BrownConrady, xy_distorted: Tensor, monkeypatch: pytest.MonkeyPatch) -> float:
    """The share of the points that the fixed steps do not solve."""
    shares, solve = [], brown_inverse._solve_remaining

    def look(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        shares.append(float(tensors[-1].double().mean()))
        return solve(*tensors)

    monkeypatch.setattr(brown_inverse, "_solve_remaining", look)
    lens.undistort(xy_distorted)
    return sum(shares) / max(len(shares), 1)  # where none is left, nobody is asked


@pytest.mark.parametrize("name", ORDINARY)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_fixed_steps_are_enough(name: str, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for a few points that rounding keeps from a residual as small as asked."""
    lens = BrownConrady(torch.tensor(ORDINARY[name], dtype=dtype))
    assert share_left(lens, seen(lens, 0.8)[1], monkeypatch) < 0.05


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", DECENTRED)
def test_strong_tangential_terms_cost_steps_and_no_digits(name: str, dtype: torch.dtype) -> None:
    lens = BrownConrady(torch.tensor(DECENTRED[name], dtype=dtype))
    xy, xy_distorted = seen(lens, 0.8)
    found, valid = lens.undistort(xy_distorted)
    exact, _ = lens.to(torch.float64).undistort(xy_distorted.double())
    assert valid.all()
    assert (found.double() - exact).abs().max() < 8 * torch.finfo(dtype).eps
    assert (exact - xy).abs().max() < 16 * torch.finfo(dtype).eps


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("coefficients", [*DECENTRED.values(), [-0.27, 0.03, 0.002, -0.001]])
def test_a_point_is_the_same_whoever_is_beside_it(coefficients: list[float], dtype: torch.dtype) -> None:
    """Many points together take a further step as a whole, few one by one; some thousand are a matter for PyTorch."""
    lens = BrownConrady(torch.tensor(coefficients, dtype=dtype))
    _, xy_distorted = seen(lens, 1.0, 600)

    def first_beside(easy: int, step: int) -> tuple[Tensor, Tensor]:
        found, valid = lens.undistort(torch.cat([xy_distorted[::step], torch.zeros(easy, 2, dtype=dtype)]))
        return found[: 600 // step : 3 // step], valid[: 600 // step : 3 // step]

    few, many = first_beside(0, 1), first_beside(5000, 1)
    for one, other in ((few, first_beside(3000, 3)), (many, first_beside(20_000, 3))):
        assert torch.equal(one[0], other[0])
        assert torch.equal(one[1], other[1])
    torch.testing.assert_close(few[0], many[0], rtol=4 * torch.finfo(dtype).eps, atol=torch.finfo(dtype).eps)
    assert torch.equal(few[1], many[1])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_nothing_depends_on_the_unit(scale: float) -> None:
    """A lens of a narrow or a wide view: the same points, their coordinates and the terms' sizes scaled."""
    powers = torch.tensor([2.0, 4, 1, 1, 6], dtype=torch.float64)
    coefficients = torch.tensor([-0.28, 0.07, 0.0013, 0.0001, -0.01], dtype=torch.float64)
    lens, scaled = BrownConrady(coefficients), BrownConrady(coefficients / scale**powers)
    _, xy_distorted = seen(lens, 0.8)
    found, valid = scaled.undistort(scale * xy_distorted)
    assert valid.all()
    torch.testing.assert_close(found / scale, lens.undistort(xy_distorted)[0], rtol=1e-13, atol=1e-14)


def test_what_is_no_number_stays_among_the_invalid() -> None:
    lens = BrownConrady(torch.tensor(ORDINARY["webcam"]))
    bad = [[torch.nan, 0.1], [torch.inf, 0.0], [0.0, -torch.inf], [1e30, 1e30], [torch.nan, torch.inf]]
    found, valid = lens.undistort(torch.tensor([*bad, [0.1, 0.1]]))
    assert valid.tolist() == [False] * 5 + [True]
    assert found[:5].count_nonzero() == 0
