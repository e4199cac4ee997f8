"""Messages between two processes over a socket, with one thread for each direction.

Messages are pickled; large arrays in them go through shared memory, if the processes have some.
Neither side waits for the other: there is a queue of messages to send and one of received messages.
The channel ends when the other process does, for whatever reason.
"""

from __future__ import annotations

import logging
import os
import pickle
import queue
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any, Protocol

from bmask_slam.live.shared_memory import Ring

logger = logging.getLogger(__name__)

LARGE = 1 << 15
"""Bytes from which on an array goes through shared memory."""
END = object()
"""Put behind the last message."""


class Connection(Protocol):
    """What carries pickles and their buffers, as multiprocessing's Connection does."""

    def fileno(self) -> int: ...
    def send(self, obj: Any, /) -> None: ...
    def recv(self) -> Any: ...


class Queue(Protocol):
    """What holds messages until they are sent."""

    def put(self, item: Any, /) -> None: ...
    def get(self) -> Any: ...


class Channel:
    """One end of the connection; received log records are handled at once, not queued.

    Attributes:
        open: False once the other side has ended or this one was closed.
    """

    def __init__(
        self,
        connection: Connection,
        rings: tuple[Ring, Ring] | None,
        outbox: Queue | None = None,
    ) -> None:
        """Use a connection, and the rings to write to and to read from, if there are some.

        ``outbox``: holds what is to be sent, if not in its order.
        """
        self.open = True
        self._connection = connection
        self._rings = rings
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._outbox: Queue = queue.SimpleQueue() if outbox is None else outbox
        self._sender = threading.Thread(target=self._send_all, daemon=True)
        self._reader = threading.Thread(target=self._read_all, daemon=True)
        self._sender.start()
        self._reader.start()

    def send(self, message: Any) -> None:
        """Queue a message to be sent in order; does nothing once the channel has ended."""
        if self._sender.is_alive():  # else nothing would take it out again
            self._outbox.put(message)

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        """All messages received so far; waits for the first for at most ``timeout_s``."""
        found: list[Any] = []
        deadline_s = time.monotonic() + timeout_s
        with suppress(queue.Empty):
            while True:
                left_s = 0.0 if found else max(deadline_s - time.monotonic(), 0.0)
                message = self._inbox.get(block=left_s > 0.0, timeout=left_s or None)
                if message is END:
                    self._inbox.put(END)
                    break
                found.append(message)
        return found

    def messages(self) -> Iterator[Any]:
        """Each message as it arrives, until the other side ends."""
        while (message := self._inbox.get()) is not END:
            yield message

    def finish(self, timeout_s: float = 5.0) -> None:
        """Send the queued messages, then end this direction."""
        self._outbox.put(END)
        self._sender.join(timeout_s)

    def drain(self, timeout_s: float = 1.0) -> None:
        """Receive what the other side sent before it ended."""
        self._reader.join(timeout_s)

    def join(self) -> None:
        """Wait until both directions have ended, after which the connection may be closed."""
        self._sender.join()
        self._reader.join()

    def close(self) -> None:
        """End both directions at once."""
        self.open = False
        self._outbox.put(END)
        self._shutdown(socket.SHUT_RDWR)

    def _send_all(self) -> None:
        try:
            while (message := self._outbox.get()) is not END:
                self._connection.send(self._pack(message))
        except OSError:  # the other side has ended
            self.open = False
        except Exception:  # without this message, the other side would wait for ever
            self.open = False
            logger.exception("a message between processes cannot be sent")
        self._shutdown(socket.SHUT_WR)

    def _read_all(self) -> None:
        try:
            while True:
                message = self._unpack(*self._connection.recv())
                if isinstance(message, logging.LogRecord):
                    logging.getLogger(message.name).handle(message)
                else:
                    self._inbox.put(message)
        except (EOFError, OSError):  # the other side has ended
            pass
        except Exception:  # a message that this side cannot read, as after a change of its files
            logger.exception("a message between processes cannot be read")
        self.open = False
        self._inbox.put(END)

    def _pack(self, message: Any) -> tuple[bytes, Sequence[Any]]:
        """The pickled message and its large buffers: (position, size) in the ring, or bytes."""
        buffers: list[memoryview] = []

        def keep_small(buffer: pickle.PickleBuffer) -> bool:
            raw = buffer.raw()
            if raw.nbytes < LARGE:
                return True
            buffers.append(raw)
            return False

        data = pickle.dumps(message, protocol=5, buffer_callback=keep_small)
        if self._rings is None:
            return data, buffers
        places = ((self._rings[0].write(raw), raw) for raw in buffers)
        return data, [bytes(raw) if at is None else (at, raw.nbytes) for at, raw in places]

    def _unpack(self, data: bytes, places: Sequence[Any]) -> Any:
        buffers = [
            bytearray(place)
            if self._rings is None or isinstance(place, bytes)
            else self._rings[1].read(*place)
            for place in places
        ]
        return pickle.loads(data, buffers=buffers)  # nosec B301 # of a child, or authenticated

    def _shutdown(self, how: int) -> None:
        with suppress(OSError), socket.socket(fileno=os.dup(self._connection.fileno())) as end:
            end.shutdown(how)


class ForwardedLog(logging.Handler):
    """Sends log records through a channel, to the process that writes log files."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.exc_info:
            text += "\n" + logging.Formatter().formatException(record.exc_info)
        place = record.name, record.levelno, record.pathname, record.lineno
        self._channel.send(logging.LogRecord(*place, text, None, None))
