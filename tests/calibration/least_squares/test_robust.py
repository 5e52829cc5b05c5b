"""What a robust loss takes from the information of residuals, against integrals done by hand."""

import math

import pytest
import torch

import diffproj as dp
from diffproj.calibration.least_squares.robust import robust_factors, robust_matrices

D = torch.float64
EVEN = torch.zeros(1, 5, 2, dtype=D)
"""Residuals that say nothing against normal ones."""


@pytest.mark.parametrize("c", [0.5, 1.345, 3.0])
def test_huber_of_normal_residuals_in_the_plane(c: float) -> None:
    """The length r of such a residual has the density `r exp(-r^2 / 2)`; the score is `min(r, c)`."""
    a, q = robust_factors(dp.Huber(c), EVEN)
    within = 1 - math.exp(-c * c / 2)
    assert float(q) == pytest.approx(within, rel=1e-3)
    assert float(a) == pytest.approx(within + c / 2 * math.sqrt(math.pi / 2) * math.erfc(c / math.sqrt(2)), rel=1e-3)


def test_huber_of_normal_residuals_on_a_line() -> None:
    """The classical figure: with c = 1.345 a location is 95 % as sure as the mean of normal residuals is."""
    a, q = robust_factors(dp.Huber(1.345), EVEN[..., :1])
    assert float(a) == pytest.approx(math.erf(1.345 / math.sqrt(2)), rel=1e-3)
    assert float(a.square() / q) == pytest.approx(0.95, abs=5e-3)


def test_outliers_count_where_they_are_worse() -> None:
    residuals = torch.tensor([[[0.6, 0.8], [3.0, 4.0]]], dtype=D)  # as long as 1 and 5
    a, q = robust_factors(dp.Huber(1.5), residuals)
    assert float(a) == pytest.approx((1 + 0.5 * 1.5 / 5) / 2)
    assert float(q) == pytest.approx((1 + 1.5**2) / 4)


def test_least_squares_loses_nothing() -> None:
    for residuals, loss in ((EVEN + 3, None), (EVEN[:, :0], dp.Huber(1.0))):
        assert [factor.tolist() for factor in robust_factors(loss, residuals)] == [[1.0], [1.0]]


def test_a_wrong_item_counts_by_itself_and_an_unseen_one_not_at_all() -> None:
    draw = torch.Generator().manual_seed(0)
    residuals, rows = torch.randn(1, 30, 2, generator=draw, dtype=D), torch.randn(1, 4, 30, 2, generator=draw, dtype=D)
    residuals[0, 0], residuals[0, 1] = torch.tensor([6e5, 8e5], dtype=D), 0.0
    for loss in (dp.Huber(1.5), dp.SoftL1(1.0), dp.Cauchy(1.0)):
        right = robust_matrices(loss, residuals[:, 2:], rows[:, :, 2:])
        found = robust_matrices(loss, residuals[:, [0, *range(2, 30)]], rows[:, :, [0, *range(2, 30)]])
        # Its pull alone, for noise as it is none: H hardly grows, which would make the rest surer.
        pull = rows[0, :, 0] @ residuals[0, 0] * float(loss.weight(residuals[0, 0].square().sum()))
        assert torch.allclose(found[0], right[0], atol=1e-3)
        assert torch.allclose(found[1][0], right[1][0] + torch.outer(pull, pull), atol=1e-3)
        for one, wanted in zip(robust_matrices(loss, residuals[:, 1:], rows[:, :, 1:]), right, strict=True):
            assert torch.allclose(one, wanted, rtol=1e-12)
