"""Intervals of functions with a kink, against sampling: with the kink of 2000 trials they hold 93 to 98.5 %."""

from collections.abc import Callable

import pytest
import torch

import diffproj as dp
from diffproj.measurement.student import joint_reach, normal_reach

D = torch.float64
K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D)
FRONTAL = dp.Camera(K, t=torch.tensor([0.0, 0, 1000], dtype=D))
SIGMA, TRIALS = 0.5, 500
Function = Callable[[torch.Tensor], torch.Tensor]


def first(points: torch.Tensor) -> torch.Tensor:
    return (points[1] - points[0]).norm()


def second(points: torch.Tensor) -> torch.Tensor:
    return (points[3] - points[2]).norm()


FUNCTIONS: dict[str, Function] = {
    "longer": lambda p: torch.maximum(first(p), second(p)),
    "shorter": lambda p: torch.minimum(first(p), second(p)),
    "difference": lambda p: (first(p) - second(p)).abs(),
    "excess": lambda p: (second(p) - first(p)).relu(),
}


def held(exact: list[list[float]], function: Function) -> float:
    """In how many of a hundred trials the truth lies in the interval."""
    places = torch.tensor(exact, dtype=D)
    which = [list(range(len(exact)))]
    truth = dp.measure(places, FRONTAL, dp.Plane.z(0.0), pixel_sigma=SIGMA).quantity(function, which).value
    draws = torch.randn(TRIALS, *places.shape, generator=torch.Generator().manual_seed(1), dtype=D)
    found = dp.measure(places + SIGMA * draws, FRONTAL, dp.Plane.z(0.0), pixel_sigma=SIGMA).quantity(function, which)
    low, high = found.interval()
    return 100 * float(((low <= truth) & (truth <= high)).double().mean())


@pytest.mark.parametrize("apart", [0.0, 0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_kinks_within_the_noise(name: str, apart: float) -> None:
    """Two sides whose lengths differ by so many px. Measured: 94.4 to 98.4 %; without a search inside 0 to 98 %."""
    exact = [[200.0, 200], [300, 200], [200, 300], [300 + apart, 300]]
    assert 93 < held(exact, FUNCTIONS[name]) < 98.6


@pytest.mark.parametrize("apart", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("function", [first, lambda p: first(p).square()], ids=["norm", "square"])
def test_lengths_of_ones_own_near_zero(function: Function, apart: float) -> None:
    """Measured: 94.2 to 97.8 %; without a search inside 20 to 95 %."""
    assert 93 < held([[200.0, 200], [200 + apart, 200]], function) < 98.6


@pytest.mark.parametrize("count", [3, 4, 8])
@pytest.mark.parametrize(
    "of", [lambda sides: sides.amax(), lambda sides: sides.amax() - sides.amin()], ids=["longest", "spread"]
)
def test_many_sides_of_one_length(of: Function, count: int) -> None:
    """Measured: 91 to 96 %; with a search in four directions alone 54 and 0 % of eight."""
    exact = [[x, 100.0 + 30 * side] for side in range(count) for x in (200.0, 300.0)]
    assert held(exact, lambda p: of((p[1::2] - p[::2]).norm(dim=-1))) > 89


def test_few_kinks_among_many_numbers() -> None:
    """Each has the bounds that it has by itself."""
    pixels = torch.tensor([[200.0, 200], [300, 200], [200, 300], [300.2, 300], [320.0, 400], [200, 400]], dtype=D)
    measured = dp.measure(pixels, FRONTAL, dp.Plane.z(0.0), pixel_sigma=SIGMA)
    which = [[0, 1, 4, 5], [0, 1, 2, 3], [4, 5, 0, 1]]
    low, high = measured.quantity(FUNCTIONS["longer"], which).interval()
    for row, points in enumerate(which):
        alone = measured.quantity(FUNCTIONS["longer"], [points]).interval()
        torch.testing.assert_close(torch.stack([low[row], high[row]]), torch.stack(alone).squeeze(-1))


def test_the_truth_at_a_kink_is_held() -> None:
    """Sides that are equal by design, and a difference that is measured as a little more than nothing."""
    pixels = torch.tensor([[200.0, 200], [300, 200], [200, 300], [300.5, 300]], dtype=D)
    measured = dp.measure(pixels, FRONTAL, dp.Plane.z(0.0), pixel_sigma=SIGMA)
    found = measured.quantity(FUNCTIONS["difference"], [[0, 1, 2, 3]])
    low, high = (float(bound) for bound in found.interval())
    assert low <= 0 < 0.999 * float(found.value) < high
    assert low > -1e-3 * high
    assert not found.significant


def test_straight_functions_are_as_before() -> None:
    pixels = torch.tensor([[200.0, 200], [300, 200], [200, 300], [320, 300]], dtype=D)
    measured = dp.measure(pixels, FRONTAL, dp.Plane.z(0.0), pixel_sigma=SIGMA)
    for name in FUNCTIONS:
        found = measured.quantity(FUNCTIONS[name], [[0, 1, 2, 3]])
        low, high = found.interval()
        torch.testing.assert_close((high - low) / 2, 1.959964 * found.deviation, rtol=1e-3, atol=0)


def test_kinks_beside_the_horizon_have_no_bound() -> None:
    floor = dp.Plane([0.0, 1.0, 0.0], 1500.0)
    measured = dp.measure([[320.0, 240.5], [320.0, 300.0]], dp.Camera(K), floor, pixel_sigma=SIGMA)
    found = measured.quantity(lambda p: torch.maximum(p[0, 2], p[1, 2]), [[0, 1]])
    low, high = found.interval()
    assert float(high) == torch.inf
    assert 0 < float(low) < float(found.value)


def test_joint_reach() -> None:
    """Against the quantiles of chi squared with 1, 2 and 3 degrees of freedom (Abramowitz and Stegun 26.8)."""
    found = joint_reach(0.95, torch.tensor([1.0, 2.0, 3.0], dtype=D))
    torch.testing.assert_close(found.square(), torch.tensor([3.841459, 5.991465, 7.814728], dtype=D), rtol=1e-6, atol=0)
    assert float(found[0]) == pytest.approx(normal_reach(0.95), rel=1e-9)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda p: p[0, 0] if p[0, 0] > 0 else -p[0, 0], "data-dependent"),
        (lambda p: torch.tensor(p[0, 0].item()), ".item"),
        (lambda p: p.numpy().sum(), "numpy"),
        (lambda p: p.mul_(2).sum(), "in-place"),
    ],
    ids=["if", "item", "numpy", "in place"],
)
def test_a_function_that_is_not_pytorchs_is_refused_by_name(function: Callable[..., object], reason: str) -> None:
    measured = dp.measure(torch.tensor([[300.0, 200], [200, 210]], dtype=D), FRONTAL, dp.Plane.z(0.0), pixel_sigma=0.5)
    with pytest.raises(ValueError, match=f"function: want one written in PyTorch's functions.*{reason}"):
        measured.quantity(function, [[0, 1]])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda p: p[0] @ torch.ones(2, dtype=D), "size mismatch|inconsistent tensor size"),
        (lambda p: p[0] @ torch.ones(3), "dtype|same"),
        (lambda p: p.reshape(7).sum(), "invalid for input of size 6"),
    ],
    ids=["shape", "dtype", "reshape"],
)
def test_a_function_that_fails_on_points_is_told_why(function: Callable[..., object], reason: str) -> None:
    """It was told to be written in PyTorch's functions, as it is."""
    measured = dp.measure(torch.tensor([[300.0, 200], [200, 210]], dtype=D), FRONTAL, dp.Plane.z(0.0), pixel_sigma=0.5)
    with pytest.raises(ValueError, match=rf"function: want one of points \(2, 3\), got one that fails: .*({reason})"):
        measured.quantity(function, [[0, 1]])  # type: ignore[arg-type]
