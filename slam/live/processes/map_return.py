"""Where the map's process runs, and its way to a workstation that was lost, or away at the start.

A thread waits until the workstation can be reached, lets the process of this machine save a state,
starts one there from that, and waits until it is ready. The process here works on meanwhile; only
then do the messages after that state go there.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.live.messages import Ready
from bmask_slam.live.processes.worker import (
    Failure,
    WorkerEnd,
    Workstation,
    WorkstationAwayError,
)

logger = logging.getLogger(__name__)

RETRY_S = 1.0
"""Between two tries to reach the workstation."""
REFUSED_S = 60.0
"""The same after it has refused, for another token or version, or the process there has failed."""
SAVE_S = START_S = 300.0
"""Longest waits for the state, and for a process there to have read it."""


@dataclass(frozen=True)
class MapPlace:
    """Where the map's process runs, and the folder of its states, which is one of this machine.

    Here it may begin with the state of a file, ``begins_with``.
    """

    folder: Path
    workstation: Workstation | None = None
    begins_with: Path | None = None


class MapReturn:
    """One way back; if a part of it fails, it begins again.

    Attributes:
        path: of the state that goes there.
        saved: number of the last message that this contains, after which the journal is to be kept;
            None while there is no such state.
    """

    def __init__(self, workstation: Workstation, arguments: tuple[Any, ...], folder: Path) -> None:
        """Begin; ``arguments`` are those of ``serve_map``, without the state."""
        self.path = folder / ".live-return"
        self.saved: int | None = None
        self._workstation, self._arguments = workstation, arguments
        self._wanted, self._has_state = threading.Event(), threading.Event()
        self._closed, self._wait_s = threading.Event(), RETRY_S
        self._ready: tuple[WorkerEnd, list[Any]] | None = None
        self._thread = threading.Thread(target=self._go, name="workstation", daemon=True)
        self._thread.start()

    def step(self, ask: Callable[[Path], None]) -> tuple[WorkerEnd, list[Any]] | None:
        """The process there once it is ready, and its first answers; does not wait.

        ``ask`` lets the process here save a state.
        """
        if self._wanted.is_set():
            self._wanted.clear()
            ask(self.path)
        return self._ready

    def state_saved(self, number: int) -> None:
        """The state is written, and contains the messages up to a number."""
        self.saved = number
        self._has_state.set()

    def close(self) -> None:
        """Stay here."""
        self._closed.set()
        if self._ready is not None:
            self._ready[0].kill()

    def _go(self) -> None:
        while not self._closed.wait(self._wait_s):
            self._wait_s = RETRY_S
            if self._workstation.is_reachable():
                self._has_state.clear()
                self._wanted.set()
                if self._has_state.wait(SAVE_S) and self._start():
                    return
                self.saved = None

    def _start(self) -> bool:
        """Start a process there; whether it is ready."""
        try:
            end = self._workstation.worker("map", (*self._arguments, 0), self.path)
        except WorkstationAwayError:
            return False
        except InputError as error:
            logger.warning("%s; the map stays here", error)
            self._wait_s = REFUSED_S
            return False
        found: list[Any] = []
        for _ in range(int(START_S / 0.2)):
            found += end.receive(0.2)
            if self._closed.is_set() or not end.is_running:
                break
            if any(isinstance(message, Ready) for message in found):
                self._ready = end, found
                if self._closed.is_set():  # just now; ``close`` may not have seen it
                    end.kill()
                return True
        end.kill()
        for failure in [m for m in (*found, *end.receive()) if isinstance(m, Failure)]:
            logger.warning("the workstation's map failed: %s; the map stays here", failure.reason)
            self._wait_s = REFUSED_S
        return False
