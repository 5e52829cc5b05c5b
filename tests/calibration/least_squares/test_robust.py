"""What a robust loss takes from the information of residuals, against integrals done by hand."""

import math

import pytest
import torch

import diffproj as dp
from diffproj.calibration.least_squares.robust import robust_factors

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
