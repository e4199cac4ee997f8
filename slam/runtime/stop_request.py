"""Stops a run on Ctrl-C, SIGTERM or SIGHUP between two frames, so that everything can be saved.

SIGHUP comes when a terminal is closed or a remote login is lost.
"""

from __future__ import annotations

import logging
import signal
import threading
from types import FrameType
from typing import Any

logger = logging.getLogger(__name__)

SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]


class StopRequest:
    """In its block the first of these signals only sets ``signal``; a second one acts as usual.

    Outside the main thread, where Python allows no handlers, ``signal`` is never set. A signal that
    the caller ignores, as SIGHUP under nohup and SIGINT in a background job of a script, stays
    ignored; a handler that is not Python's, of a program that embeds it, stays in place, since it
    could not be put back.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                present = signal.getsignal(number)  # None: not Python's
                if present not in (None, signal.SIG_IGN):
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
