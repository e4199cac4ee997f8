"""A worker that is started again when it dies or hangs: it costs its work, never the loop."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.live.messages import Ready
from bmask_slam.live.processes.worker import Failure, Worker

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Patience:
    """When a worker counts as hanging, and how often it is started again.

    Attributes:
        start_s: how long it may take to start; a busy machine needs minutes to load a network.
        answer_s: how long it may be silent over its work.
        restarts: at most.
    """

    start_s: float = 300.0
    answer_s: float = 20.0
    restarts: int = 3


def late_start(name: str, waited_s: float) -> str:
    """What is said of a process that lives but has not begun in time."""
    return (
        f"the {name}'s process has not begun within {waited_s:.0f} s; is this machine overloaded? "
        "End other work and try again"
    )


class SupervisedWorker:
    """A worker and its successors.

    Attributes:
        deaths: how often one died or hung.
    """

    def __init__(self, name: str, target: str, arguments: tuple[Any, ...], rules: Patience) -> None:
        self.name = name
        self.deaths = 0
        self._target, self._arguments, self._rules = target, arguments, rules
        self._heard_s = time.monotonic()
        self._is_ready = False
        self._worker = self._start()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._worker.pid

    @property
    def given_up(self) -> bool:
        """Whether it died too often to be started again."""
        return self.deaths > self._rules.restarts

    def first_words(self) -> Ready:
        """Wait until it can work. Raises InputError, with its own words, if it cannot."""
        deadline_s = time.monotonic() + self._rules.start_s
        while True:
            alive = self._worker.alive
            for message in self._worker.receive(0.1):
                match message:
                    case Ready():
                        self._is_ready = True
                        return message
                    case Failure():
                        self.close()
                        raise InputError(message.text.strip().splitlines()[-1])
            if not alive:
                self.close()
                raise InputError(f"the {self.name}'s process did not start; see the lines above")
            if time.monotonic() > deadline_s:
                self.close()
                raise InputError(late_start(self.name, self._rules.start_s))

    def send(self, message: Any, begins: bool = False) -> None:
        """Give it a message; one that ``begins`` work is what its answer is waited for from."""
        if begins:
            self._heard_s = time.monotonic()
        self._worker.send(message)

    def receive(self) -> list[Any]:
        """What has come but for failures, which are logged, and a successor's first words."""
        messages = self._worker.receive()
        if messages:
            self._heard_s = time.monotonic()
            self._is_ready = True
        for message in messages:
            if isinstance(message, Failure):
                logger.error("the %s failed: %s", self.name, message.text)
        return [m for m in messages if not isinstance(m, Failure | Ready)]

    def was_restarted(self, busy: bool) -> bool:
        """Start it again if it has died, or was silent for too long while ``busy``."""
        if self.given_up:
            return False
        silent_s = time.monotonic() - self._heard_s
        limit_s = self._rules.answer_s if self._is_ready else self._rules.start_s
        if self._worker.alive and not (busy and silent_s > limit_s):
            return False
        self.deaths += 1
        self._heard_s, self._is_ready = time.monotonic(), False
        self._worker.kill()
        if self.given_up:
            logger.error("the %s died %d times and is given up", self.name, self.deaths)
            return False
        logger.warning("the %s died or hangs; started again", self.name)
        self._worker = self._start()
        return True

    def close(self) -> None:
        """End the process at once."""
        self._worker.kill()

    def _start(self) -> Worker:
        return Worker(self.name, self._target, *self._arguments)
