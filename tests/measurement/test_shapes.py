"""Lengths, angles and areas as vectors, and the longest and shortest that noise allows, against plain formulas."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from diffproj.measurement.folded import upper_bound
from diffproj.measurement.propagation import _firsts
from diffproj.measurement.quantity import Quantity
from diffproj.measurement.shapes import area_vector, difference, length, turn

D = torch.float64


def test_lengths_with_a_gradient_everywhere() -> None:
    points = torch.tensor([[1.0, 2, 3], [4, 6, 3]], dtype=D)
    vector, supplement = difference(points)
    assert vector.tolist() == [3, 4, 0]
    assert not supplement
    vectors = torch.stack([vector, torch.zeros(3, dtype=D)]).requires_grad_()
    found = length(vectors)
    assert found.tolist() == [5.0, 0.0]
    (gradient,) = torch.autograd.grad(found.sum(), vectors)
    torch.testing.assert_close(gradient, torch.tensor([[0.6, 0.8, 0], [0, 0, 0]], dtype=D))


def test_a_right_angle_has_the_slopes_of_those_near_it() -> None:
    """Its cosine is exactly 0, where the absolute value that tells the angle's supplement apart has no slope."""
    arms = torch.tensor([[2.0, 0, 0], [0, 0, 0], [0, 3, 0]], dtype=D, requires_grad=True)
    vector, obtuse = turn(arms)
    assert float(vector.detach().norm()) == math.pi / 2
    assert not obtuse
    (gradient,) = torch.autograd.grad(vector[2], arms)
    want = torch.tensor([[0, -1 / 2, 0], [1 / 3, 1 / 2, 0], [-1 / 3, 0, 0]], dtype=D)
    torch.testing.assert_close(gradient, want, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 10.0, 89.0, 91.0, 170.0, 179.9999, 180.0])
def test_angles_and_their_supplements(degrees: float) -> None:
    angle = math.radians(degrees)
    arms = torch.tensor([[2.0, 0, 0], [0, 0, 0], [3 * math.cos(angle), 3 * math.sin(angle), 0]], dtype=D)
    arms = (arms + 7).requires_grad_()
    vector, obtuse = turn(arms)
    size = float(vector.detach().norm())
    assert bool(obtuse) == (degrees > 90)
    assert (math.pi - size if obtuse else size) == pytest.approx(angle, abs=1e-9)
    (gradient,) = torch.autograd.grad(vector[2], arms)
    # One arm's end moves across at a distance of 2, the other's at 3.
    assert gradient[[0, 2]].norm(dim=-1).tolist() == pytest.approx([1 / 2, 1 / 3], abs=1e-6)


def test_an_arm_without_length_has_no_angle() -> None:
    vector, _ = turn(torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0]], dtype=D))
    assert vector.tolist() == [0, 0, 0]


def test_areas_cancel_where_an_outline_crosses_itself() -> None:
    square = torch.tensor([[0.0, 0, 5], [2, 0, 5], [2, 3, 5], [0, 3, 5]], dtype=D)
    assert area_vector(square)[0].tolist() == [0, 0, 6]
    assert float(area_vector(square[[0, 1, 3, 2]])[0].norm()) == pytest.approx(0)


@pytest.mark.parametrize("distance", [0.0, 0.5, 2.0, 4.0, 6.0, 40.0])
def test_no_vector_within_the_noise_is_longer_than_the_bound(distance: float) -> None:
    root = torch.randn(200, 3, 3, dtype=D)
    C = root @ root.mT
    values, vectors = torch.linalg.eigh(C)
    largest, longest = values[:, -1], vectors[..., -1]
    w = distance * largest.sqrt().unsqueeze(-1) * torch.nn.functional.normalize(torch.randn(200, 3, dtype=D), dim=-1)
    found = upper_bound(w, C, largest, longest, 2.0)
    around = torch.nn.functional.normalize(torch.randn(20_000, 3, dtype=D), dim=-1)
    ends = w.unsqueeze(-2) + 2.0 * around @ (vectors * values.sqrt().unsqueeze(-2)).mT
    sampled = ends.norm(dim=-1).amax(-1)
    towards = w / w.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    first_order = w.norm(dim=-1) + 2.0 * (towards * (C @ towards.unsqueeze(-1)).squeeze(-1)).sum(-1).sqrt()
    assert bool((found >= first_order - 1e-9).all())
    assert bool((found <= sampled * 1.01).all())
    if distance <= 2.0:  # near zero it is the longest; farther off it goes over into the first order
        assert bool((found >= sampled * (1 - 1e-9)).all())


def test_a_quantity_alone_has_the_interval_of_its_deviation() -> None:
    low, high = Quantity(torch.tensor([3.0, -1.0], dtype=D), torch.tensor([1.0, 0.0], dtype=D)).interval(0.95)
    torch.testing.assert_close(low, torch.tensor([3 - 1.959963985, -1.0], dtype=D))
    torch.testing.assert_close(high, torch.tensor([3 + 1.959963985, -1.0], dtype=D))


@pytest.mark.plain
@pytest.mark.parametrize("level", [Fraction(19, 20), np.float32(0.95), np.array(0.95), torch.tensor(0.95, dtype=D)])
def test_a_level_comes_in_many_forms(level: object) -> None:
    one = torch.ones(2, dtype=D)
    few = Quantity(one, one, one * torch.tensor([3.0, 20.0], dtype=D))
    torch.testing.assert_close(few.interval(level), few.interval(0.95), rtol=1e-6, atol=0)


def test_points_that_are_named_twice_count_once() -> None:
    index = torch.tensor([[0, 1, 0, 1], [2, 2, 2, 3], [4, 5, 6, 7]])
    assert _firsts(index).tolist() == [[1, 1, 0, 0], [1, 0, 0, 1], [1, 1, 1, 1]]
