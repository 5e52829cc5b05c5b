"""One piece of work for each photograph or camera, here or on the workers of an executor: in order, or as they come."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from queue import SimpleQueue
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 64
"""Tasks handed out and not yet done: enough to keep a cluster busy, and few enough to stop soon after a failure."""


def results_of(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    executor: Executor | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Result]:
    """Do the work for each item; the results are in the items' order.

    Args:
        work: what to do; for processes and clusters, something that can be pickled, as the items and results.
        items: what to do it for.
        executor: any `concurrent.futures.Executor`; none does the work here, one item after the other.
        progress: called here with `(done, total)` after each item.

    Raises:
        Exception: the first that the work raised; what has not begun by then is cancelled.

    Example:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> with ThreadPoolExecutor(2) as pool:
        ...     results_of(abs, [-3, 1, -2], pool)
        [3, 1, 2]
    """
    found: dict[int, Any] = {}
    for place, result in as_done(work, items, executor):
        found[place] = result
        if progress is not None:
            progress(len(found), len(items))
    return [found[place] for place in range(len(items))]


def as_done(
    work: Callable[[Item], Result], items: Sequence[Item], executor: Executor | None = None
) -> Iterator[tuple[int, Result]]:
    """The results one by one as they come, each with its item's number from 0; see `results_of`.

    Raises:
        Exception: the first that the work raised; what has not begun by then is cancelled, as it is when nobody asks
            for more.

    Example:
        >>> list(as_done(abs, [-3, 1]))
        [(0, 3), (1, 1)]
    """
    if executor is None:
        for place, item in enumerate(items):
            yield place, work(item)
        return
    places: dict[Future[Any], int] = {}
    done: SimpleQueue[Future[Any]] = SimpleQueue()
    waiting = list(reversed(range(len(items))))
    try:
        while waiting or places:
            while waiting and len(places) < AHEAD:
                place = waiting.pop()
                future = executor.submit(work, items[place])
                places[future] = place
                future.add_done_callback(done.put)
            future = done.get()
            yield places.pop(future), future.result()
    finally:
        for future in places:
            future.cancel()
