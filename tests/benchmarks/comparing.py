"""What a benchmark is: a piece of work of this package beside what somebody would use instead, timed in turn.

Times on a shared machine are worth little, ratios of what ran in turn in one process a lot. On the CPU a time is that of
the calling thread's work, which waiting for the machine does not lengthen, and of many repeats the lower quartile counts.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch.profiler import ProfilerActivity, profile

Work = Callable[[], object]
QUARTILE = 0.25


@dataclass(frozen=True)
class Comparison:
    """One line of the table: the package's work, and the peer's.

    Attributes:
        name: of the line, and in the baseline.
        ours: the package's work.
        peer: the other work; it does the same, or as much of it as the peer can.
        against: what the peer is.
        target: the ratio, ours to the peer's, that the package aims at; `None` where there is none.
        per: how many times as much ours does as the peer's; times are divided by it.
        seconds: how long the two are repeated.
        memory: whether bytes at the peak are compared in place of times, with the bytes that `peer` returns.
    """

    name: str
    ours: Work
    peer: Work
    against: str
    target: float | None = None
    per: float = 1.0
    seconds: float = 1.0
    memory: bool = field(default=False, kw_only=True)


class Result(NamedTuple):
    """What was measured: ratio, its quartiles over the rounds, and ours and the peer's in milliseconds or megabytes."""

    ratio: float
    low: float
    high: float
    ours: float
    peer: float


Benchmark = Callable[[], Iterator[Comparison]]


def measured(comparison: Comparison, clock: Callable[[], float] = time.thread_time) -> Result:
    """Run both in turn and compare."""
    if comparison.memory:
        ours, peer = float(peak_bytes(comparison.ours)), float(comparison.peer())  # type: ignore[arg-type]
        return Result(ours / peer, ours / peer, ours / peer, ours / 1e6, peer / 1e6)
    both = comparison.ours, comparison.peer
    for work in both * 2:
        work()
    rounds: list[list[float]] = []
    until = time.perf_counter() + comparison.seconds
    while len(rounds) < 3 or time.perf_counter() < until:
        times = []
        for work in both:
            begin = clock()
            work()
            times.append(clock() - begin)
        rounds.append(times)
    ours, peer = torch.tensor(rounds, dtype=torch.float64).div(torch.tensor([comparison.per, 1.0])).unbind(-1)
    typical = ours.quantile(QUARTILE) / peer.quantile(QUARTILE)
    low, high = (ours / peer).quantile(torch.tensor([QUARTILE, 1 - QUARTILE], dtype=torch.float64))
    figures = typical, low, high, 1e3 * ours.quantile(QUARTILE), 1e3 * peer.quantile(QUARTILE)
    return Result(*map(float, figures))


def synchronised() -> float:
    """The time when a GPU has finished what it was given."""
    torch.cuda.synchronize()
    return time.perf_counter()


def peak_bytes(work: Work) -> int:
    """Highest sum of what PyTorch allocates less what it frees while the work runs, on the CPU or on a GPU."""
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        work()
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() - before
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as seen:
        work()
    held, peak = 0, 0
    events: list[Any] = seen.profiler.kineto_results.events()  # type: ignore[union-attr]
    for event in sorted((one for one in events if one.name() == "[memory]"), key=lambda one: one.start_ns()):
        held += event.nbytes()
        peak = max(peak, held)
    return peak
