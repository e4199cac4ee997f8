"""Owner of the map process, which is restarted from a saved state and a journal if it dies.

Messages are kept in the journal until the process has saved a state that contains them. If it dies,
a new process starts from that state and gets the later messages again; tracking goes on meanwhile.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.live.messages import Ready, Started, StateSaved
from bmask_slam.live.processes.supervision import late_start_text
from bmask_slam.live.processes.worker import Failure, Worker

logger = logging.getLogger(__name__)

TARGET = "bmask_slam.live.processes.map_process:serve_map"
MAX_CRASHES = 3
"""Number of crashes after which it is not restarted, if it never got as far as before between."""


class MapWorker:
    """Sends numbered messages to the map's process, and restarts it when it dies.

    Attributes:
        crashes: how often the process has died.
        state: the file of the last saved state, None before the first.
        saves: how many states were saved.
    """

    def __init__(self, arguments: tuple[Any, ...], replacement: Callable[[Any], Any]) -> None:
        """Start the process.

        Args:
            arguments: of ``serve_map``, without the state.
            replacement: called with a message of which two processes died; returns the message to
                send instead, or None.
        """
        self.crashes = 0
        self._arguments, self._replacement = arguments, replacement
        self.state: Path | None = None
        self.saves = 0
        self._journal: dict[int, Any] = {}
        self._number = 0
        self._crashes_in_a_row = 0
        self._is_ready = self._has_failed = False
        self._started = self._crashed_at = self._resent = 0  # numbers of messages
        self._worker = self._start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._worker.pid

    @property
    def given_up(self) -> bool:
        """Whether the process died too often to be restarted."""
        return self._crashes_in_a_row >= MAX_CRASHES

    @property
    def busy(self) -> bool:
        """Whether there are messages that no saved state contains."""
        return bool(self._journal)

    def send(self, message: Any) -> None:
        """Send a message, which is sent again to a new process if this one dies."""
        self._number += 1
        self._journal[self._number] = message
        self._worker.send((self._number, message))

    @property
    def has_crashed(self) -> bool:
        """Whether the process has died and is to be restarted."""
        return not self._worker.is_running and not self.given_up

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        """The answers that are not about the process itself; waits so long for the first."""
        return self._without_own(self._worker.receive(timeout_s))

    def receive_last(self) -> list[Any]:
        """The answers that the process sent before it died; to be applied before ``restart``."""
        self._worker.kill()
        return self.receive()

    def wait_until_ready(self, timeout_s: float) -> None:
        """Wait for the first message of the process.

        Raises:
            InputError: it cannot start, or is not ready in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while not self._is_ready:
            if self.given_up:
                self.kill()
                raise InputError("the map's process did not start; see the lines above")
            if time.monotonic() > deadline_s:
                self.kill()
                raise InputError(late_start_text("map", timeout_s))
            self.receive(0.1)
            if self.has_crashed:
                self.receive_last()
                self.restart()

    def restart(self) -> None:
        """Start a new process from the last saved state, and send the later messages again."""
        self.crashes += 1
        self._crashes_in_a_row += 1
        if self.given_up:
            logger.error(
                "the map's process died %d times in a row; it is not restarted", MAX_CRASHES
            )
            return
        # one that failed may have taken so long to end that it was killed then
        if self._has_failed or not self._worker.was_killed:  # a message may be the cause
            if self._crashed_at == self._started > 0:
                self._skip(self._started)
            self._crashed_at = self._started
        logger.warning(
            "the map's process died; restarted, %d messages are sent again", len(self._journal)
        )
        self._send_again()

    def try_again(self) -> None:
        """Restart it although it died too often: at the end of a run there is time for that."""
        logger.warning("the map's process is started a last time")
        self._crashes_in_a_row = 0
        self._send_again()

    def _send_again(self) -> None:
        """Start a process and send it what no saved state contains."""
        self._resent, self._has_failed = self._number, False
        self._worker = self._start()
        for number, message in sorted(self._journal.items()):
            self._worker.send((number, message))

    def stop(self) -> None:
        """Let the process handle what was sent, then end it."""
        self._worker.stop()

    def kill(self) -> None:
        """End the process at once."""
        self._worker.kill()

    def _start(self) -> Worker:
        return Worker("map", TARGET, *self._arguments, self.state, self._resent)

    def _without_own(self, messages: list[Any]) -> list[Any]:
        """Handle the messages about the process itself; returns the others."""
        others = []
        for message in messages:
            match message:
                case Started():
                    self._started = message.number
                    if message.number > self._resent:
                        self._crashes_in_a_row = 0
                case StateSaved():
                    self._journal = {n: m for n, m in self._journal.items() if n > message.number}
                    self.state, self._crashes_in_a_row = message.path, 0
                    self.saves += 1
                case Ready():
                    self._is_ready = True
                case Failure():
                    self._has_failed = True
                    logger.error("the map's process failed: %s", message.text)
                case _:
                    others.append(message)
        return others

    def _skip(self, number: int) -> None:
        """Replace a message of which two processes died."""
        message = self._journal.pop(number, None)
        logger.error("message %d, %s, is skipped", number, type(message).__name__)
        if (instead := self._replacement(message)) is not None:
            self._journal[number] = instead
