"""Stops a run on Ctrl-C or SIGTERM between two frames, so that everything can be saved."""

from __future__ import annotations

import logging
import signal
import threading
from types import FrameType
from typing import Any

logger = logging.getLogger(__name__)


class StopRequest:
    """In its block the first SIGINT or SIGTERM only sets ``signal``; a second one acts as usual.

    Outside the main thread, where Python allows no handlers, ``signal`` is never set.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal = signal.Signals(number)
        self._restore()
        logger.warning("%s: stopping and saving; once more to quit at once", self.signal.name)

    def _restore(self) -> None:
        while self._previous:
            signal.signal(*self._previous.popitem())
