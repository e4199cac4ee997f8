"""Work that other threads do ahead, or beside this one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
AHEAD = 3
"""Items that are prepared while another is used."""
THREADS = 2


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """What ``work`` makes of each item, in their order; some items are worked on at a time.

    It pays where most of the work is done without the interpreter: images decoded, large arrays.
    An exception of ``work`` is raised here.
    """
    with ThreadPoolExecutor(THREADS, "beside") as threads:
        return list(threads.map(work, items))


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
