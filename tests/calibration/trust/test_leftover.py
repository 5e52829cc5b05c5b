"""The tests behind remarks: how improbable residuals are, against the distributions themselves."""

import math
from types import SimpleNamespace
from unittest.mock import Mock

import mpmath
import pytest
import torch

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.trust.leftover import effect
from diffproj.calibration.trust.other_poses import TAIL, _improbability
from diffproj.calibration.trust.remarks import CONTRADICTION, NOTABLE, _contradicts_noise
from diffproj.calibration.trust.two_groups import _along_the_line, _lowest

D = torch.float64


def fishers_tail(ratio: float, one: int, two: int) -> float:
    return float(mpmath.betainc(two / 2, one / 2, 0, two / (two + one * ratio), regularized=True))


@pytest.mark.parametrize(("unknowns", "count"), [(2, 60), (5, 200), (12, 400)])
@pytest.mark.parametrize("share", [0.03, 0.1])
def test_what_more_unknowns_explain_is_judged_by_fishers_distribution(unknowns: int, count: int, share: float) -> None:
    found = effect(
        torch.tensor([share], dtype=D), torch.tensor([unknowns]), torch.ones(1, dtype=D), torch.tensor([count])
    )
    rest = count - unknowns
    chance = fishers_tail(share / unknowns / ((1 - share) / rest), unknowns, rest)
    expected = math.sqrt(2) * float(mpmath.erfinv(1 - 2 * mpmath.mpf(chance)))
    assert float(found.deviations) == pytest.approx(expected, abs=0.1, rel=0.05)
    assert float(found.share) == pytest.approx(share)


def test_wrong_corners_are_as_likely_as_under_students_distribution() -> None:
    """Differences of the logarithm of the density of both coordinates, for 3 degrees of freedom."""
    residual = torch.randn(1, 2, 2, 7, dtype=D) * 4
    used = torch.rand(1, 2, 7) > 0.2
    variance = torch.tensor([[0.3]], dtype=D)

    def told(values: torch.Tensor) -> torch.Tensor:
        problem = SimpleNamespace(linearise=lambda _shared, _poses: torch.stack([values, values], dim=2))
        task = Mock(spec=Task, problem=problem, weights=None, used=used)
        return _improbability(task, torch.zeros(1, 4), (torch.zeros(1), torch.zeros(1)), variance)

    # A normal variable whose precision is a chi-squared one over its degrees of freedom, integrated over that.
    w = torch.linspace(0, 60, 200001, dtype=D)[1:]
    weight = w ** (TAIL / 2 - 1) * (-TAIL * w / 2).exp() * w
    squared = torch.cat([residual.square().sum(2).flatten(), torch.zeros(1, dtype=D)])
    density = torch.stack([(weight * (-w * r / (2 * 0.3)).exp()).sum() for r in squared]).log()
    expected = -torch.where(used, (density[:-1] - density[-1]).reshape(1, 2, 7), 0.0).sum(-1)
    torch.testing.assert_close(told(residual) - told(torch.zeros_like(residual)), expected, rtol=1e-3, atol=0)


@pytest.mark.parametrize("spare", [1, 2, 7, 40])
def test_a_noise_that_was_given_is_contradicted_by_the_chi_squared_distribution(spare: int) -> None:
    """Where residuals are so much larger that chance makes them in one of 10^4 cases, and 1.25 times as large."""
    rare = mpmath.findroot(
        lambda x: mpmath.gammainc(spare / 2, x / 2, mpmath.inf, regularized=True) / CONTRADICTION - 1,
        (spare, 12 + 3 * spare),
        solver="illinois",
    )
    limit = max(float(rare), NOTABLE**2 * spare)
    for times, expected in ((0.999, False), (1.001, True)):
        found = Mock(
            spec=Fit,
            knows_noise=True,
            solution=SimpleNamespace(status=torch.tensor([int(Status.CONVERGED)])),
            degrees_of_freedom=lambda: torch.tensor([spare]),
            variance_of_residuals=lambda times=times: torch.tensor([times * limit / spare], dtype=D),
        )
        assert bool(_contradicts_noise(found)) is expected


def test_places_on_the_line_through_two_groups_save_what_a_search_finds() -> None:
    """Of a quadratic cost of each view, against the lowest of many places along the line."""
    V, q = 6, 3
    root = torch.randn(1, V, q, q, dtype=D)
    H, g = root @ root.mT + 0.1 * torch.eye(q, dtype=D), torch.randn(1, V, q, dtype=D)
    one = torch.tensor([[True, True, False, True, False, False]])
    ends = [_lowest(H, g, group.unsqueeze(0))[0][0, 0] for group in (one, ~one)]

    def cost(view: int, place: torch.Tensor) -> torch.Tensor:
        return (place * (place @ H[0, view])).sum(-1) / 2 + place @ g[0, view]

    saved = 0.0
    for view in range(V):
        start = ends[0] if bool(one[0, view]) else ends[1]
        where = torch.linspace(-60, 60, 240001, dtype=D).unsqueeze(-1)
        saved += float(cost(view, start) - cost(view, start + where * (ends[1] - ends[0])).min())
    assert float(_along_the_line(H, g, one)) == pytest.approx(saved, rel=1e-4)
    assert math.isfinite(saved)
