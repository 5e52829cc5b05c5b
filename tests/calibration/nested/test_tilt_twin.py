"""Two tilts of the sensor that do much the same, and the minimum that lies with the other one."""

import pytest
import torch

import diffproj as dp
from diffproj.calibration.nested.tilt_twin import TERMS, twin
from diffproj.calibration.problem.parametrisation import Parametrisation
from tests.calibration.minima.drawn import BOARD, KINDS, Draw

D = torch.float64
TERMS_AT = [Parametrisation("brown14").names.index(name) for name in TERMS]


def moved(tilt: float, with_terms: bool) -> float:
    """How far a ring about the axis moves when the sensor is tilted to the other side."""
    shared = torch.zeros(1, 18, dtype=D)
    shared[0, 6:8], shared[0, 12:16] = torch.tensor([1e-3, -2e-3]), torch.tensor([1e-3, 2e-3, 3e-3, 1e-3])
    shared[0, 16:] = tilt * torch.tensor([0.5, -0.8])
    other = twin(shared, TERMS_AT)
    if not with_terms:
        other[:, :16] = shared[:, :16]
    angle = 2 * torch.pi * torch.arange(50, dtype=D) / 50
    ring = 0.2 * torch.stack([angle.cos(), angle.sin()], dim=-1)
    here, there = (dp.BrownConrady(x[0, 4:]).distort(ring)[0] for x in (shared, other))
    return float((here - there).abs().amax())


def test_the_terms_make_up_for_the_tilt() -> None:
    """What is left is of second order in the angles; without them it is of first."""
    assert moved(0.02, True) / moved(0.01, True) == pytest.approx(4, rel=0.05)
    assert moved(0.02, False) / moved(0.01, False) == pytest.approx(2, rel=0.05)
    assert moved(0.01, True) < 0.05 * moved(0.01, False)


def test_the_lower_minimum_lies_with_the_other_tilt() -> None:
    """The first minimum is at 29.5541, with error bars a tenth of the distance to this one."""
    problems = KINDS["any brown14"](25, Draw(5008))
    views = dp.Views(problems.views.pixels[7], problems.views.visible[7], size=problems.views.size)
    found = dp.calibrate(views, BOARD, "brown14")
    assert float(found.residuals.square().sum()) == pytest.approx(29.5466, abs=1e-3)
