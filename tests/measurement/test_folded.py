"""Lengths near zero: the bounds go over into those of a long length without a step."""

import pytest
import torch

from diffproj.measurement.folded import FAR, NEAR, lower_bound

D = torch.float64


def bound(r: float) -> float:
    """Of a measured length, where the noise has a deviation of 1 in all three directions."""
    one = torch.ones(1, dtype=D)
    found = lower_bound(torch.tensor([r], dtype=D), one, 2 * one, 0 * one, one, 0.975, 1.959964)
    return float(found)


@pytest.mark.parametrize("edge", [NEAR, FAR])
def test_no_step_from_near_to_far(edge: float) -> None:
    """The noise across makes the two bounds differ by .08 deviations even at 12."""
    assert bound(edge + 1e-6) == pytest.approx(bound(edge - 1e-6), abs=1e-4)


def test_far_off_the_length_is_normal() -> None:
    assert bound(FAR + 1) == pytest.approx(FAR + 1 - 1.959964)
