"""Run an iterator ahead of its consumer in a thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class _End:
    """What the producer leaves last: nothing, or the exception that stopped it."""

    error: BaseException | None = None


def prefetched(items: Iterable[T], depth: int) -> Iterator[T]:
    """Yield ``items`` in order while a thread works up to ``depth`` of them ahead.

    An exception in ``items`` is raised here, after all items that came before it. When the
    consumer stops early, the thread ends after the item it is working on. With depth 0 there is
    no thread.
    """
    if depth <= 0:
        yield from items
        return
    ready: queue.Queue[T | _End] = queue.Queue(maxsize=depth)
    stopped = threading.Event()
    thread = threading.Thread(
        target=_produce, args=(items, ready, stopped), name="prefetch", daemon=True
    )
    thread.start()
    try:
        while not isinstance(item := ready.get(), _End):
            yield item
        if item.error is not None:
            raise item.error
    finally:
        stopped.set()
        while not ready.empty():  # frees a producer that waits for room; it puts once at most
            ready.get_nowait()
        thread.join()


def _produce(items: Iterable[T], ready: queue.Queue[T | _End], stopped: threading.Event) -> None:
    """Put every item and then the end; whatever goes wrong is handed over, not swallowed."""
    end = _End()
    try:
        for item in items:
            if stopped.is_set():
                return
            ready.put(item)
    except BaseException as error:  # noqa: BLE001 - raised again in the consumer's thread
        end = _End(error)
    if not stopped.is_set():
        ready.put(end)
