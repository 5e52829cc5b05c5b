"""Threads that share what the package remembers get the results that one thread gets."""

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.plan import RECENT, _domain, _rest

THREADS = 6


@pytest.fixture(autouse=True)
def _threads_take_turns_often() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def lenses(count: int) -> list[torch.Tensor]:
    draws = torch.randn(count, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return list((0.05 * draws).unbind())


@pytest.mark.slow
def test_the_memory_of_compiled_lenses() -> None:
    coefficients = lenses(RECENT + 8)  # more than are remembered, so that entries come and go
    key = BrownConrady._key
    domains = [_domain(c, key) for c in coefficients]
    want = [_rest(c, d, key) for c, d in zip(coefficients, domains, strict=True)]

    def wrong(thread: int) -> int:
        count = 0
        for turn in range(250):
            k = (7 * turn + 5 * thread) % len(coefficients)
            found = _domain(coefficients[k], key), *_rest(coefficients[k], domains[k], key)
            count += any(not torch.equal(a, b) for a, b in zip(found, (domains[k], *want[k]), strict=True))
        return count

    with ThreadPoolExecutor(THREADS) as pool:
        assert list(pool.map(wrong, range(THREADS))) == [0] * THREADS


def test_one_lens_shared_by_all() -> None:
    points = 0.4 * torch.randn(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for coefficients in lenses(12):
        want, valid = BrownConrady(coefficients).undistort(points)
        lens = BrownConrady(coefficients)  # knows nothing yet: all threads work out its plan at once

        def found(_: int, lens: BrownConrady = lens) -> tuple[torch.Tensor, torch.Tensor]:
            return lens.undistort(points)

        with ThreadPoolExecutor(THREADS) as pool:
            for xy, seen in pool.map(found, range(THREADS)):
                assert torch.equal(xy, want)
                assert torch.equal(seen, valid)


def test_lenses_of_one_name_keep_apart() -> None:
    """Two classes that share a name, as after a cell of a notebook was run again, each have their own model."""

    def make(reach: float) -> type[BrownConrady]:
        class Mine(BrownConrady):
            @staticmethod
            def _find_domain(coefficients: torch.Tensor) -> torch.Tensor:
                return torch.full_like(coefficients[..., 0], reach)

        return Mine

    narrow, wide = make(0.25), make(0.5)
    coefficients = torch.zeros(4, dtype=torch.float64)
    assert [float(kind(coefficients).domain) for kind in (narrow, wide, narrow)] == [0.25, 0.5, 0.25]
    assert [float(_domain(coefficients, kind._key)) for kind in (narrow, wide, narrow)] == [0.25, 0.5, 0.25]
