"""A workstation as the robot sees it: where it is, and workers that run there."""

from __future__ import annotations

import logging
import re
import socket
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import MapSaved
from bmask_slam.live.network.carrying import FilePiece, Outbox, file_data, store
from bmask_slam.live.network.connection import (
    BEAT_S,
    Connection,
    default_token_file,
    introduce,
    read_token,
)
from bmask_slam.live.processes.worker import Failure, WorkstationAwayError

logger = logging.getLogger(__name__)

PORT = 7717
CONNECT_S = 2.0
STOP_S = 0.1
SILENT_S = 1.5
"""A machine that acknowledges nothing for so long is away. Much longer, and tracking is lost."""
_ADDRESS = re.compile(r"(?:\[([^][]+)\]|([^][:]+))(?::([0-9]{1,5}))?")
CURE = "does bmask-slam workstation --host ADDRESS run there?"


@dataclass
class Traffic:
    """Bytes on the wire since the start, of all connections that have been."""

    connections: list[Connection] = field(default_factory=list)
    _ended: tuple[int, int] = (0, 0)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, connection: Connection) -> None:
        """Count a connection; of those that are closed only the bytes are kept."""
        with self._lock:
            closed = [one for one in self.connections if one.fileno() < 0]
            sent, received = self._ended
            self._ended = (
                sent + sum(one.sent_bytes for one in closed),
                received + sum(one.received_bytes for one in closed),
            )
            self.connections = [one for one in self.connections if one not in closed]
            self.connections.append(connection)

    @property
    def sent_bytes(self) -> int:
        """To the workstation."""
        with self._lock:
            return self._ended[0] + sum(one.sent_bytes for one in self.connections)

    @property
    def received_bytes(self) -> int:
        """From it."""
        with self._lock:
            return self._ended[1] + sum(one.received_bytes for one in self.connections)


@dataclass(frozen=True)
class Workstation:
    """Another machine, on which `bmask-slam workstation` runs.

    Attributes:
        host, port: its address.
        token: what it must know, and this machine too.
        traffic: what was sent and received.
    """

    host: str
    port: int = PORT
    token: bytes = field(default=b"", repr=False)
    traffic: Traffic = field(default_factory=Traffic, compare=False, repr=False)

    @classmethod
    def of(cls, address: str, token_file: Path | None = None) -> Workstation:
        """That of HOST or HOST:PORT, with the token of a file.

        HOST may be an address of IPv6, which needs [brackets] where a port follows.

        Raises:
            InputError: the address or the token is none.
        """
        is_bare = address.count(":") > 1 and "[" not in address  # of IPv6, without a port
        found = _ADDRESS.fullmatch(f"[{address}]" if is_bare else address)
        port = int(found[3] or PORT) if found else 0
        if found is None or not 0 < port < 1 << 16:
            raise InputError(
                f"--workstation {address}: no address; write HOST or HOST:PORT, as [::1]:{PORT}"
            )
        token = read_token(token_file or default_token_file())
        return cls(found[1] or found[2], port, token)

    def is_reachable(self) -> bool:
        """Whether something answers there."""
        try:
            socket.create_connection((self.host, self.port), CONNECT_S).close()
        except OSError:
            return False
        return True

    def worker(
        self, name: str, arguments: tuple[Any, ...], state: Path | None = None
    ) -> DistantEnd:
        """Start a worker there, from a file of this machine if there is one.

        Raises:
            WorkstationAwayError: the workstation cannot be reached.
            InputError: it has another token or version, ``host`` is no name of one, or the file
                cannot be read.
        """
        data = None if state is None else file_data(state)
        host = f"[{self.host}]" if ":" in self.host else self.host
        where = f"the workstation {host}:{self.port}"
        try:
            end = socket.create_connection((self.host, self.port), CONNECT_S)
            try:
                connection = Connection(end, introduce(end, self.token))
            except BaseException:
                end.close()
                raise
        except UnicodeError as error:
            raise InputError(f"{where} cannot be reached ({error}); {CURE}") from error
        except OSError as error:
            reason = error.strerror or error
            raise WorkstationAwayError(f"{where} cannot be reached ({reason}); {CURE}") from error
        self.traffic.add(connection)
        return DistantEnd(connection, (name, arguments, data))


class DistantEnd:
    """The owner's end of a worker on a workstation; it has ended when the connection has."""

    pid, processor_s = 0, 0.0

    def __init__(self, connection: Connection, first: tuple[str, tuple[Any, ...], Any]) -> None:
        self._connection = connection  # keeps its socket open
        self._channel = Channel(connection, None, Outbox())
        self._failed = False
        self._channel.send(first)
        threading.Thread(target=self._beat, name="beat", daemon=True).start()

    def _beat(self) -> None:
        """Show that this end lives; when it has ended, give its descriptor back."""
        with suppress(OSError):
            while self._channel.open:
                self._connection.beat()
                time.sleep(BEAT_S)
        self._channel.join()
        self._connection.close()

    @property
    def is_running(self) -> bool:
        """Whether the connection is open, and the other machine acknowledges what is sent."""
        if self._channel.open and self._connection.silent_s > SILENT_S:
            self._channel.close()
        return self._channel.open

    @property
    def was_killed(self) -> bool:
        """Whether it ended without saying why: the network, or the other machine."""
        return not self._channel.open and not self._failed

    def send(self, message: Any) -> None:
        """Queue a message; does nothing once the connection has ended."""
        self._channel.send(message)

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        """All messages so far; waits for the first for at most ``timeout_s``.

        Files are written before the messages that say so are given.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            received = self._channel.receive(max(deadline_s - time.monotonic(), 0.0))
            found = []
            for message in received:
                one = self._stored(message) if isinstance(message, FilePiece) else message
                self._failed |= isinstance(one, Failure)
                found += [] if one is None else [one]
            if found or not received:
                return found

    def _stored(self, piece: FilePiece) -> Any | None:
        def fail(error: OSError | InputError) -> Any | None:
            logger.warning("%s: cannot be written (%s)", piece.path, error)
            is_map = isinstance(piece.message, MapSaved)
            return replace(piece.message, failure=str(error)) if is_map else None

        return store(piece, fail)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Send what is queued, and end it."""
        self._channel.finish(timeout_s)
        self._channel.close()

    def kill(self) -> None:
        """End it at once. What it sent before can still be received."""
        self._channel.drain(0.0 if self._channel.open else STOP_S)
        self._channel.close()
