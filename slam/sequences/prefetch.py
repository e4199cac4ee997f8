"""Run an iterator ahead of its consumer in a thread."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")
AHEAD = 3
"""Number of items that are made ahead where nothing else is said."""
FEATURES_AHEAD = 2
"""Number of frames whose features are extracted ahead of tracking, unless frames may be dropped."""


def prefetched(items: Iterable[T], depth: int = AHEAD) -> Generator[T, None, None]:
    """Yield ``items`` in order while one thread works ``depth`` of them ahead.

    An exception in ``items`` is raised here, after all items that came before it. When the
    consumer stops early, the thread ends after the item it is working on. With depth 0 there is
    no thread.
    """
    if depth <= 0:
        yield from items
        return
    iterator, end = iter(items), object()
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch") as worker:
        ahead: deque[Any] = deque(worker.submit(next, iterator, end) for _ in range(depth))
        try:
            while (item := ahead.popleft().result()) is not end:
                ahead.append(worker.submit(next, iterator, end))
                yield item
        finally:
            for future in ahead:
                future.cancel()
