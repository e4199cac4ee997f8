"""The owner's end of a process that a `fork_server.ForkServer` has started for it."""

from __future__ import annotations

import os
import select
import signal
import struct
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

NUMBER = struct.Struct("<i")
"""What the server writes to the pipe: the process id, then the exit code."""
PATIENCE_S = 5.0
"""Longest time for which the end of a process waits for an answer of the server."""
_POLL_S = 0.02


class ForkedProcess:
    """A process that the server has started; its methods are those of ``subprocess.Popen``."""

    def __init__(self, end_server: Callable[[], None], status: int) -> None:
        """Take the read end of a pipe, on which the server says the pid, then the exit code.

        ``end_server`` is called if the server does not answer.
        """
        self._end_server, self._status = end_server, status
        self._pid: int | None = None
        self._began: bytes | None = None
        self._code: int | None = None
        self._is_orphan = False
        self._lock = threading.Lock()

    def __del__(self) -> None:
        with suppress(OSError):
            os.close(self._status)

    @property
    def has_begun(self) -> bool:
        """Whether ``pid`` is known, so that asking for it waits for nothing."""
        self.poll()
        return self._pid is not None

    @property
    def pid(self) -> int:
        """Process id, 0 if it could not be started; waits for it while the server loads."""
        while not self.has_begun:
            _is_readable(self._status, _POLL_S)
        return self._pid or 0

    def poll(self) -> int | None:
        """The exit code, negative for a signal's number; None while it runs."""
        with self._lock:
            while self._code is None and _is_readable(self._status, 0.0):
                number = self._next_number()
                if self._pid is None:
                    self._pid = number or 0
                    self._began = _beginning(self._pid)
                elif number is not None:
                    self._code = number
                elif self._is_there():  # the server has ended, so nobody knows its exit code
                    self._is_orphan = True
                    break
                else:
                    self._code = -signal.SIGKILL
            return self._code

    def wait(self, timeout_s: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while (code := self.poll()) is None:
            if end_s is not None and time.monotonic() > end_s:
                raise subprocess.TimeoutExpired("a forked process", timeout_s or 0.0)
            if self._is_orphan:  # the pipe has ended: it is always readable
                time.sleep(_POLL_S)
            else:
                _is_readable(self._status, _POLL_S)
        return code

    def kill(self) -> None:
        """Kill it, unless it has ended; a server that does not answer is killed for it."""
        if not self.has_begun and not _is_readable(self._status, PATIENCE_S):
            self._end_server()
        if self.pid and self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
            if not _is_readable(self._status, PATIENCE_S):
                self._end_server()

    def _next_number(self) -> int | None:
        data = os.read(self._status, NUMBER.size)
        return int(NUMBER.unpack(data)[0]) if data else None

    def _is_there(self) -> bool:
        return self._began is not None and _beginning(self._pid or 0) == self._began


def _is_readable(descriptor: int, timeout_s: float) -> bool:
    """Wait so long for data, or for their end; ``select`` would refuse descriptors from 1024 on."""
    waiting = select.poll()
    waiting.register(descriptor, select.POLLIN)
    return bool(waiting.poll(1e3 * timeout_s))


def _beginning(pid: int) -> bytes | None:
    """When a process began, by which another one of the same id differs; None if it has ended.

    One that nobody has waited for, as in a container whose first process does not, has ended too.
    """
    try:
        words = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return None
    return None if words[0] in (b"Z", b"X") else words[19]
