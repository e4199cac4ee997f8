"""Starts processes by forking one that has loaded their modules: 20 ms in place of a second.

The server is a new interpreter with a single thread, so that forking it is safe; Linux only, since
elsewhere system libraries do not survive a fork. Python's own ``multiprocessing.forkserver`` would
run the caller's script again in every process.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import logging
import os
import pickle
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NoReturn

from bmask_slam.runtime.stop_request import SIGNALS

logger = logging.getLogger(__name__)

IS_SUPPORTED = sys.platform == "linux"
STANDARD_STREAMS = (1, 2)
PATIENCE_S = 5.0
"""Longest time for which the end of a process waits that the server has yet to start."""
_NUMBER = struct.Struct("<i")
_POLL_S = 0.02


@dataclass(frozen=True)
class Start:
    """What a process is to run, and what it has of its owner's surroundings.

    ``target`` is ``module:function``, called with the descriptors given to `ForkServer.start`. The
    ``loaded`` module is loaded by the server before it forks, once for all processes.
    """

    target: str
    loaded: str
    environment: Mapping[str, str]
    search_path: Sequence[str]
    folder: str


class ForkedProcess:
    """A process that the server has started; its methods are those of ``subprocess.Popen``."""

    def __init__(self, server: ForkServer, status: int) -> None:
        """Take the read end of a pipe, on which the server says the pid, then the exit code."""
        self._server, self._status = server, status
        self._pid: int | None = None
        self._code: int | None = None
        self._lock = threading.RLock()

    def __del__(self) -> None:
        with suppress(OSError):
            os.close(self._status)

    @property
    def pid(self) -> int:
        """Process id, 0 if it could not be started; waits for it while the server loads."""
        with self._lock:
            if self._pid is None:
                self._pid = self._next_number() or 0
            return self._pid

    def poll(self) -> int | None:
        """The exit code, negative for a signal's number; None while it runs."""
        with self._lock:
            while self._code is None and select.select([self._status], [], [], 0)[0]:
                if self._pid is None:
                    self._pid = self._next_number() or 0
                    continue
                self._code = self._next_number()
                if self._code is None:  # the server has ended, so nobody knows its exit code
                    if self._is_there():
                        break
                    self._code = -signal.SIGKILL
            return self._code

    def wait(self, timeout_s: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while (code := self.poll()) is None:
            if end_s is not None and time.monotonic() > end_s:
                raise subprocess.TimeoutExpired("a forked process", timeout_s or 0.0)
            select.select([self._status], [], [], _POLL_S)
        return code

    def kill(self) -> None:
        """Kill it, unless it has ended; a server that does not answer is killed for it."""
        with self._lock:
            if self._pid is None and not select.select([self._status], [], [], PATIENCE_S)[0]:
                self._server.close()
        if self.pid and self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)

    def _next_number(self) -> int | None:
        data = os.read(self._status, _NUMBER.size)
        return int(_NUMBER.unpack(data)[0]) if data else None

    def _is_there(self) -> bool:
        with suppress(ProcessLookupError):
            if self._pid:
                os.kill(self._pid, 0)
                return True
        return False


class ForkServer:
    """The owner's end of a server, which ends with its owner."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Start it; ``environment`` counts while modules are loaded, as for numbers of threads."""
        self.owner = os.getpid()
        self._control, other_end = socket.socketpair()
        with other_end:
            self._process = subprocess.Popen(  # nosec B603 # this module, by number of descriptor
                [sys.executable, "-P", "-c", f"from {__name__} import serve; serve()"],
                stdin=other_end.fileno(),
                env=dict(environment),
                process_group=0,  # Ctrl-C in a terminal must reach only the owner
            )
        self.pid = self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether it runs, and is this process's own."""
        return self.owner == os.getpid() and self._process.poll() is None

    def close(self) -> None:
        """End the server; what it has started goes on."""
        self._control.close()
        if self.owner == os.getpid():
            self._process.kill()
            self._process.wait()

    def start(self, start: Start, descriptors: Sequence[int]) -> ForkedProcess:
        """Ask for a process that inherits these descriptors, and the owner's output.

        Raises:
            OSError: the server has ended.
        """
        read_end, write_end = os.pipe()
        process = ForkedProcess(self, read_end)
        streams = [_open_stream(number) for number in STANDARD_STREAMS]
        try:
            data = pickle.dumps(start)
            passed = [write_end, *streams, *descriptors]
            socket.send_fds(self._control, [_NUMBER.pack(len(data))], passed)
            self._control.sendall(data)
        finally:
            for number in (write_end, *streams):
                os.close(number)
        return process


class _Shared:
    """The server of this process's workers."""

    lock = threading.Lock()
    server: ForkServer | None = None


def start_forked(start: Start, descriptors: Sequence[int]) -> ForkedProcess:
    """Start a process by this process's one server, which is started when it is first needed."""
    with _Shared.lock:
        if _Shared.server is not None and _Shared.server.is_running:
            with suppress(OSError):  # it ends just now
                return _Shared.server.start(start, descriptors)
        _Shared.server = ForkServer(start.environment)
        atexit.register(_Shared.server.close)
        return _Shared.server.start(start, descriptors)


def server_pid() -> int | None:
    """Process id of this process's server, if there is one."""
    return None if _Shared.server is None else _Shared.server.pid


def _open_stream(number: int) -> int:
    """A copy of a standard stream; of nothing, where the owner has closed it."""
    try:
        return os.dup(number)
    except OSError:
        return os.open(os.devnull, os.O_WRONLY)


def serve() -> None:
    """Main function of the server; its standard input is the socket to its owner."""
    for number in SIGNALS:  # the process that started it decides
        if number is not signal.SIGTERM:
            signal.signal(number, signal.SIG_IGN)
    gc.disable()  # what is loaded stays
    control = socket.socket(fileno=os.dup(0))
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    statuses: dict[int, int] = {}
    while True:
        ready, _, _ = select.select([control.fileno(), woken], [], [])
        if woken in ready:
            os.read(woken, 1 << 12)
            _report_ended(statuses)
        if control.fileno() in ready:
            if (received := _receive(control)) is None:
                return
            _fork(*received, statuses, [control.fileno(), woken, wake])


def _fork(
    start: Start, passed: Sequence[int], statuses: dict[int, int], own: Sequence[int]
) -> None:
    """Load what is asked for, fork, and tell the owner the new process's id."""
    status, *inherited = passed
    with suppress(Exception):  # the process will report it
        importlib.import_module(start.loaded)
    gc.freeze()  # the collector leaves alone what all processes share
    try:
        pid = os.fork()
    except OSError as error:
        logger.warning("a process cannot be started: %s", error)
        os.close(status)
    else:
        if pid == 0:
            signal.set_wakeup_fd(-1)
            for number in (*own, status, *statuses.values()):
                os.close(number)
            _run(start, inherited)
        statuses[pid] = status
        with suppress(OSError):  # the child does it as well; nobody knows who is first
            os.setpgid(pid, pid)
        _write(status, pid)
    for number in inherited:
        os.close(number)


def _receive(control: socket.socket) -> tuple[Start, list[int]] | None:
    """The next request and its descriptors; None once the owner has ended."""
    size, descriptors, _, _ = socket.recv_fds(control, _NUMBER.size, 16)
    if not size:
        return None
    data = control.recv(_NUMBER.unpack(size)[0], socket.MSG_WAITALL)
    return pickle.loads(data), descriptors  # nosec B301 # from the owner


def _report_ended(statuses: dict[int, int]) -> None:
    """Tell the owner the exit codes of the processes that have ended."""
    with suppress(ChildProcessError):
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            status = statuses.pop(ended[0])
            _write(status, os.waitstatus_to_exitcode(ended[1]))
            os.close(status)


def _write(status: int, number: int) -> None:
    with suppress(OSError):  # the owner no longer listens
        os.write(status, _NUMBER.pack(number))


def _run(start: Start, passed: Sequence[int]) -> NoReturn:
    """Be the process: take the owner's surroundings, and do what is asked."""
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        with suppress(OSError):
            os.setpgid(0, 0)
        for number, stream in zip(STANDARD_STREAMS, passed, strict=False):
            os.dup2(stream, number)
            os.close(stream)
        with suppress(OSError):  # the folder is gone
            os.chdir(start.folder)
        os.environ.clear()
        os.environ.update(start.environment)
        sys.path[:] = start.search_path
        module, _, function = start.target.partition(":")
        getattr(importlib.import_module(module), function)(*passed[len(STANDARD_STREAMS) :])
        sys.stdout.flush()
        os._exit(0)  # nothing is left to do, for which Python would take 0.1 s
    except BaseException as error:  # noqa: BLE001 - nothing is above it
        sys.excepthook(type(error), error, error.__traceback__)
    os._exit(1)
