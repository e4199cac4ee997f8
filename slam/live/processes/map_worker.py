"""Owner of the map process, which is restarted from a saved state and a journal if it dies.

Messages are kept in a journal until the process has saved a state with them. If it dies,
a new process starts from that state and gets the later messages again; tracking goes on meanwhile.
On a workstation it is the same; states come back over the network. While that is away, at the start
or later, the process is one of this machine, and then the map goes there (`map_return`).
"""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.labelling.label_views import forget_old_views
from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import Finish, Ready, Resent, SaveState, Started, StateSaved
from bmask_slam.live.processes.map_process import serve_map
from bmask_slam.live.processes.map_return import MapPlace, MapReturn
from bmask_slam.live.processes.supervision import late_start_text
from bmask_slam.live.processes.worker import (
    Failure,
    Worker,
    WorkerEnd,
    Workstation,
    WorkstationAwayError,
)

logger = logging.getLogger(__name__)

TARGET = "bmask_slam.live.processes.map_process:serve_map"
STANDBY = "bmask_slam.live.processes.map_worker:serve_later"
MAX_CRASHES = 3
"""Number of crashes after which it is not restarted, if it never got as far as before between."""


class MapWorker:
    """Sends numbered messages to the map's process, and restarts it when it dies.

    Attributes:
        crashes, losses: how often the process has died, and how often the workstation was lost.
        state: the file of the last saved state, None before the first.
        saves, saved: how many states were saved; number of the last message in the last one.
        sent: the number of the last message.
    """

    def __init__(
        self, arguments: tuple[Any, ...], replacement: Callable[[Any], Any], place: MapPlace
    ) -> None:
        """Start the process; here, if the workstation does not answer.

        Args:
            arguments: of ``serve_map``, without the state.
            replacement: called with a message of which two processes died; returns the message to
                send instead, or None.
            place: where it runs.

        Raises:
            InputError: the workstation refuses.
        """
        self.crashes = self.losses = 0
        self._place = place
        self._arguments, self._replacement = arguments, replacement
        self.state = place.begins_with
        self.saves = self.saved = 0
        self._return: MapReturn | None = None
        self._early: list[Any] = []
        self._standby: WorkerEnd | None = None  # in place of the workstation
        self._journal: dict[int, Any] = {}
        self.sent = 0
        self._crashes_in_a_row = 0
        self._is_ready = self._has_failed = False
        self._started = self._crashed_at = self._resent = 0  # numbers of messages
        self._worker = self._first()

    @property
    def workstation(self) -> str:
        """As in ``Health``."""
        if self._place.workstation is None:
            return ""
        return "connected" if self._return is None else "away"

    def workstation_health(self) -> dict[str, Any]:
        """What ``Health`` says of the workstation."""
        there = self._place.workstation
        sent, received = (
            (there.traffic.sent_bytes, there.traffic.received_bytes) if there else (0, 0)
        )
        found: dict[str, Any] = {"workstation": self.workstation, "workstation_losses": self.losses}
        return found | {"workstation_sent_bytes": sent, "workstation_received_bytes": received}

    @property
    def pid(self) -> int:
        """Process id."""
        return self._worker.pid

    def lacks(self, after: int, last: int) -> bool:
        """Whether there are messages of these numbers that no saved state contains."""
        return any(after < number <= last for number in self._journal)

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
        if isinstance(message, Finish) and self._return is not None:
            self._return.close()  # it ends where it is
            self._return = None
        self.sent += 1
        self._journal[self.sent] = message
        forget_old_views(self._journal, message)
        self._worker.send((self.sent, message))

    @property
    def has_crashed(self) -> bool:
        """Whether the process has died and is to be restarted."""
        return not self._worker.is_running and not self.given_up

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        """The answers that are not about the process itself; waits so long for the first."""
        early, self._early = self._early, []
        found = early + self._without_own(self._worker.receive(0.0 if early else timeout_s))
        if self._return is not None and self._worker.is_running:
            back = self._return.step(lambda path: self.send(SaveState(path)))
            found += self._go_back(*back) if back is not None else []
        return found

    def _go_back(self, workstation: WorkerEnd, early: list[Any]) -> list[Any]:
        """Go on with the process of the workstation; returns the last answers of that here."""
        assert self._return is not None
        begin, self._return = self._return.saved or 0, None
        self._worker.kill()
        last = self._without_own(self._worker.receive())
        self._standby = Worker("map", STANDBY)
        self._worker, self._early = workstation, self._without_own(early)
        self._resent = self.sent
        self._worker.send((0, Resent(self.sent)))
        logger.warning("the workstation is back; the map's process is there again")
        self._send_journal(begin)
        return last

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
        if self._place.workstation is not None and self._return is None and self._worker.was_killed:
            self.losses += 1
            text = "the workstation is lost; the map's process goes on here, %d messages again"
            logger.warning(text, len(self._journal))
            self._send_again()
            return
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
        """Start a process here and send it what no saved state contains."""
        self._resent, self._has_failed = self.sent, False
        arguments = (*self._arguments, self.state, self._resent)
        if self._standby is not None:
            self._worker, self._standby = self._standby, None
            self._worker.send(arguments)
        else:
            self._worker = Worker("map", TARGET, *arguments)
        if self._place.workstation is not None:
            if self._return is not None:
                self._return.close()
            self._return = self._way_back(self._place.workstation)
        self._send_journal(self.saved)

    def _send_journal(self, begin: int) -> None:
        """Send the messages after one of this number."""
        for number, message in sorted(self._journal.items()):
            if number > begin:
                self._worker.send((number, message))

    def stop(self) -> None:
        """Let the process handle what was sent, then end it."""
        self._worker.stop()

    def kill(self) -> None:
        """End the process at once."""
        if self._return is not None:
            self._return.close()
        if self._standby is not None:
            self._standby.kill()
        self._worker.kill()

    def _first(self) -> WorkerEnd:
        workstation = self._place.workstation
        if workstation is not None:
            try:
                there = workstation.worker("map", (*self._arguments, 0), None)
            except WorkstationAwayError as error:
                logger.warning("%s The map begins here and goes there once it answers", error)
                self._return = self._way_back(workstation)
            else:
                self._standby = Worker("map", STANDBY)
                return there
        return Worker("map", TARGET, *self._arguments, self.state, 0)

    def _way_back(self, workstation: Workstation) -> MapReturn:
        return MapReturn(workstation, self._arguments, self._place.folder)

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
                    self._keep_state(message)
                case Ready():
                    self._is_ready = True
                case Failure():
                    self._has_failed = True
                    logger.error("the map's process failed: %s", message.text)
                case _:
                    others.append(message)
        return others

    def _keep_state(self, message: StateSaved) -> None:
        """Forget the messages that a state contains, unless a workstation has to have them."""
        going = self._return
        if going is not None and message.path == going.path:
            going.state_saved(message.number)
            return
        self.state, self._crashes_in_a_row = message.path, 0
        self.saved = message.number
        self.saves += 1
        kept = None if going is None else going.saved
        last = message.number if kept is None else min(message.number, kept)
        self._journal = {n: m for n, m in self._journal.items() if n > last}

    def _skip(self, number: int) -> None:
        """Replace a message of which two processes died."""
        message = self._journal.pop(number, None)
        logger.error("message %d, %s, is skipped", number, type(message).__name__)
        if (instead := self._replacement(message)) is not None:
            self._journal[number] = instead


def serve_later(channel: Channel) -> None:
    """Wait, with everything loaded, for the other arguments of ``serve_map``; then do that."""
    for arguments in itertools.islice(channel.messages(), 1):
        serve_map(channel, *arguments)
