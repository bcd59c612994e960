"""A parallel map over threads that keeps the order and few results in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ordered_map(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Map a function over items in threads.

    Args:
        function: called once for each item.
        items: consumed only as far ahead as there are threads for.
        threads: number of threads, at least 1.

    Yields:
        Results in the order of the items. At most `2 * threads + 1` are pending or unread at a time, unlike with
        `ThreadPoolExecutor.map`, which submits everything at once.
    """
    pending = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                pending.append(pool.submit(function, item))
                if len(pending) > 2 * threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for job in pending:
                job.cancel()
