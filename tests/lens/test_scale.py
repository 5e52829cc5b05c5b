"""The scale of a lens: the radius at which one of its terms is as large as the point itself."""

import pytest
import torch

import diffproj as dp
from diffproj.lens.brown_domain import length_scale

D = torch.float64


@pytest.mark.parametrize("place", range(12))
def test_scale_of_one_term(place: int) -> None:
    """The power of each term's radius is read off the lens: how much more it moves a point twice as far out."""
    coefficients = torch.zeros(12, dtype=D)
    coefficients[place] = 1e-6
    lens = dp.BrownConrady(coefficients)
    point = torch.tensor([[0.3, 0.2]], dtype=D)
    moved = [(lens.distort(size * point)[0] - size * point).norm() for size in (1.0, 2.0)]
    power = round(float(torch.log2(moved[1] / moved[0]))) - 1  # relative to the point
    assert float(length_scale(3e5 * coefficients)) == pytest.approx(0.3 ** (-1 / power), rel=1e-12)
