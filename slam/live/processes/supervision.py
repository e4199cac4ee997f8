"""A worker that is started again when it dies or hangs, so that the live loop goes on."""

from __future__ import annotations

import logging
import queue
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.live.messages import Ready
from bmask_slam.live.processes.map_return import REFUSED_S, RETRY_S
from bmask_slam.live.processes.worker import (
    Failure,
    NoEnd,
    Worker,
    WorkerEnd,
    Workstation,
    WorkstationAwayError,
)

logger = logging.getLogger(__name__)

LEAST_SHARE, SLOWEST = 0.002, 30.0
"""A process that works gets at least this share of a processor on a busy machine, where it may
take so many times as long."""
DISTANT_S = 120.0
"""``RestartPolicy.answer_s`` of a process on a workstation, of which nobody here knows how busy it
is; whether that machine is there at all is seen by its connection."""


@dataclass(frozen=True)
class RestartPolicy:
    """When a worker counts as hanging, and how often it is started again.

    Attributes:
        start_s: longest time of its start; a busy machine needs minutes to load a network.
        answer_s: longest time without a message while it works, if it takes so much of the
            processor's time or none; one that a busy machine slows down has SLOWEST times that.
        restarts: largest number of restarts.
    """

    start_s: float = 300.0
    answer_s: float = 20.0
    restarts: int = 3


def late_start_text(name: str, waited_s: float) -> str:
    """The error text for a process that runs but is not ready in time."""
    return (
        f"the {name}'s process has not begun within {waited_s:.0f} s; is this machine overloaded? "
        "End other work and try again"
    )


class SupervisedWorker:
    """A worker, replaced by a new process when it dies or hangs.

    Attributes:
        name: of the worker, for messages.
        crashes: how often a process died or hung.
        arguments: of a process that is started in its place.
        labels: of its last ``Ready``; empty before.
        is_away: whether it is on another machine, which cannot be reached at present.
    """

    is_away = False

    def __init__(
        self, name: str, target: str, arguments: tuple[Any, ...], policy: RestartPolicy
    ) -> None:
        self.name = name
        self.crashes = 0
        self._target, self.arguments, self._policy = target, arguments, policy
        self._heard_s, self._used_s = time.monotonic(), 0.0
        self._is_ready, self.labels = False, tuple[str, ...]()
        self._early: list[Any] = []  # that came with its first message
        self._worker = self._start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._worker.pid

    @property
    def given_up(self) -> bool:
        """Whether it died too often to be restarted."""
        return self.crashes > self._policy.restarts

    def wait_until_ready(self) -> Ready:
        """Wait for its first message.

        Raises:
            InputError: it cannot start, or is not ready in time.
        """
        deadline_s = time.monotonic() + self._policy.start_s
        while True:
            is_running = self._worker.is_running
            messages = self._worker.receive(0.1)
            for number, message in enumerate(messages, 1):
                match message:
                    case Ready():
                        self._is_ready, self.labels = True, message.labels
                        self._early += messages[number:]
                        return message
                    case Failure():
                        self.close()
                        raise InputError(message.reason)
            if not is_running:
                self.close()
                raise InputError(f"the {self.name}'s process did not start; see the lines above")
            if time.monotonic() > deadline_s:
                self.close()
                raise InputError(late_start_text(self.name, self._policy.start_s))

    def send(self, message: Any, begins: bool = False) -> None:
        """Send a message; one that ``begins`` work starts the time in which it must answer."""
        if begins:
            self._now_heard()
        self._worker.send(message)

    def receive(self) -> list[Any]:
        """The messages received, without failures, which are logged, and ``Ready``."""
        messages, self._early = [*self._early, *self._worker.receive()], []
        if messages:
            self._now_heard()
            self._is_ready = True
        self._log_failures(messages)
        for message in messages:
            if isinstance(message, Ready):
                self.labels = message.labels
        return [m for m in messages if not isinstance(m, Failure | Ready)]

    def _log_failures(self, messages: list[Any]) -> None:
        for message in messages:
            if isinstance(message, Failure):
                logger.error("the %s failed: %s", self.name, message.text)

    def restart_if_needed(self, busy: bool) -> bool:
        """Restart it if it died, or sent nothing for too long while ``busy``; whether it did."""
        if self.given_up:
            return False
        if self._worker.is_running and not (busy and self._hangs()):
            return False
        self.crashes += 1
        self._heard_s, self._used_s, self._is_ready = time.monotonic(), 0.0, False
        self._worker.kill()
        self._log_failures(self._worker.receive())  # that came since
        if self.given_up:
            logger.error("the %s died %d times; it is not restarted", self.name, self.crashes)
            return False
        logger.warning("the %s died or hangs; restarted", self.name)
        self._worker = self._start()
        return True

    def close(self) -> None:
        """End the process at once."""
        self._worker.kill()

    def give_up(self) -> None:
        """End it at once, and do not start it again."""
        self.crashes = self._policy.restarts + 1
        self.close()

    def _hangs(self) -> bool:
        """Whether it has been silent for too long for one that has work."""
        silent_s = time.monotonic() - self._heard_s
        limit_s = self._policy.answer_s if self._is_ready else self._policy.start_s
        return silent_s > limit_s and not self._is_slow(silent_s, limit_s)

    def _is_slow(self, silent_s: float, limit_s: float) -> bool:
        """Whether it works, but the machine is too busy for it to have been done by now."""
        used_s = self._worker.processor_s - self._used_s
        return silent_s < SLOWEST * limit_s and LEAST_SHARE * silent_s < used_s < limit_s

    def _now_heard(self) -> None:
        self._heard_s, self._used_s = time.monotonic(), self._worker.processor_s

    def _start(self) -> WorkerEnd:
        return Worker(self.name, self._target, *self.arguments)


class DistantWorker(SupervisedWorker):
    """A worker on a workstation. When that is away, it is begun as soon as that is back.

    Only failures of its own count as crashes.
    """

    def __init__(self, name: str, arguments: tuple[Any, ...], workstation: Workstation) -> None:
        """Start it, or later if the workstation does not answer. Raises InputError: it refuses."""
        self._workstation = workstation
        self._back: queue.SimpleQueue[WorkerEnd] = queue.SimpleQueue()
        self._closed, self.is_away = threading.Event(), False
        super().__init__(name, "", arguments, RestartPolicy(answer_s=DISTANT_S))

    def restart_if_needed(self, busy: bool) -> bool:
        """Whether it has been begun again; waits for nothing."""
        if self.is_away:
            with suppress(queue.Empty):
                self._worker = self._back.get_nowait()
                self.is_away, self._is_ready = False, False
                self._now_heard()
                logger.warning("the workstation is back; the %s works again", self.name)
                return True
            return False
        if self.given_up or (self._worker.is_running and not (busy and self._hangs())):
            return False
        self._log_failures(self._worker.receive())  # that came since; they are no kill
        self.crashes += not self._worker.was_killed
        self._worker.kill()
        if self.given_up:
            logger.error("the %s died %d times; it is not restarted", self.name, self.crashes)
            return False
        logger.warning("the workstation's %s is lost; it is tried again", self.name)
        self._look_for_it()
        return False

    def close(self) -> None:
        """End it at once."""
        self._closed.set()
        super().close()
        with suppress(queue.Empty):
            self._back.get_nowait().kill()

    def _look_for_it(self) -> None:
        self.is_away = True
        threading.Thread(target=self._wait_for_it, name="workstation", daemon=True).start()

    def _wait_for_it(self) -> None:
        wait_s = RETRY_S
        while not self._closed.wait(wait_s):
            try:
                end = self._there()
            except WorkstationAwayError as error:
                logger.debug("%s", error)
                wait_s = RETRY_S
                continue
            except InputError as error:
                logger.warning("%s; the %s is not used", error, self.name)
                wait_s = REFUSED_S
                continue
            self._back.put(end)
            if self._closed.is_set():
                end.kill()
            return

    def _start(self) -> WorkerEnd:
        try:
            return self._there()
        except WorkstationAwayError as error:  # the map's worker says so
            logger.info("%s", error)
            self._look_for_it()
            return NoEnd()

    def _there(self) -> WorkerEnd:
        return self._workstation.worker(self.name, self.arguments, None)
