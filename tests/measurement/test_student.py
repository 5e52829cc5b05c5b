"""Student's t against the tables, and where it goes over into the normal distribution."""

import math

import pytest
import torch

from diffproj.measurement.student import normal_reach, student_reach

D = torch.float64


@pytest.mark.parametrize(
    ("level", "table"),
    [
        (0.95, {1: 12.7062, 2: 4.30265, 3: 3.18245, 5: 2.57058, 10: 2.22814, 30: 2.04227, 100: 1.98397, 1000: 1.96234}),
        (0.99, {1: 63.6567, 2: 9.92484, 3: 5.84091, 5: 4.03214, 10: 3.16927, 30: 2.75000, 100: 2.62589, 1000: 2.58075}),
        (0.5, {1: 1.0, 2: 0.81650, 10: 0.69981, 100: 0.67695}),
    ],
)
def test_quantiles_are_those_of_the_tables(level: float, table: dict[int, float]) -> None:
    found = student_reach(level, torch.tensor(list(table), dtype=D))
    assert found.tolist() == pytest.approx(list(table.values()), rel=1e-5)


@pytest.mark.parametrize("level", [0.1, 0.6827, 0.95, 0.9973, 0.999999])
def test_closed_forms_and_limits(level: float) -> None:
    one, two, many, infinite, none, unknown = student_reach(
        level, torch.tensor([1.0, 2.0, 1e9, torch.inf, 0.0, torch.nan], dtype=D)
    ).tolist()
    assert one == pytest.approx(math.tan(math.pi / 2 * level), rel=1e-9)
    assert two == pytest.approx(level * math.sqrt(2 / (1 - level**2)), rel=1e-9)
    assert many == pytest.approx(normal_reach(level), rel=1e-6)
    assert infinite == normal_reach(level)
    assert math.isinf(none)
    assert math.isnan(unknown)


def test_the_two_ways_meet_at_a_thousand_degrees_of_freedom() -> None:
    for level in (0.5, 0.95, 0.999):
        below, above = student_reach(level, torch.tensor([1000 - 1e-9, 1000.0], dtype=D)).tolist()
        assert below == pytest.approx(above, rel=1e-10)


def test_any_shape_and_degrees_between() -> None:
    found = student_reach(0.95, torch.tensor([[1.5, 2.5], [7.3, torch.inf]], dtype=D))
    assert found.shape == (2, 2)
    assert (found.flatten().diff() < 0).all()
    with pytest.raises(ValueError, match="level: want a probability between 0 and 1"):
        student_reach(1.0, found)
