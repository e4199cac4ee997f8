"""The same work on several things at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
THREADS = 2


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """What ``work`` makes of each item, in their order; some items are worked on at a time.

    It pays where most of the work is done without the interpreter: images decoded, large arrays.
    An exception of ``work`` is raised here.
    """
    with ThreadPoolExecutor(THREADS, "beside") as threads:
        return list(threads.map(work, items))
