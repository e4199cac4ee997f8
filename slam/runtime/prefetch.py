"""Work that a second thread does ahead."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
AHEAD = 3
"""Items that are prepared while another is used."""


def prepared_ahead(
    prepare: Callable[[Item], Result], items: Iterable[Item]
) -> Iterator[tuple[Item, Result]]:
    """Each item with what ``prepare`` makes of it in a second thread, in order.

    An exception of ``prepare`` is raised where its result would come.
    """
    with ThreadPoolExecutor(1, "prefetch") as thread:
        waiting: deque[tuple[Item, Future[Result]]] = deque()
        try:
            for item in items:
                waiting.append((item, thread.submit(prepare, item)))
                if len(waiting) > AHEAD:
                    done, result = waiting.popleft()
                    yield done, result.result()
            while waiting:
                done, result = waiting.popleft()
                yield done, result.result()
        finally:  # what nobody waits for is not begun
            for _, result in waiting:
                result.cancel()
