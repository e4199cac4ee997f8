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
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NoReturn

from bmask_slam.runtime.forked_process import NUMBER, ForkedProcess
from bmask_slam.runtime.memory import keep_little_memory
from bmask_slam.runtime.standard_streams import copy_of_stream, has_stream
from bmask_slam.runtime.stop_request import SIGNALS

logger = logging.getLogger(__name__)

IS_SUPPORTED = sys.platform == "linux"
STANDARD_STREAMS = (1, 2)
MAX_PASSED = 16
"""Largest number of descriptors of a request."""


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
                stdout=None if has_stream(1) else subprocess.DEVNULL,
                stderr=None if has_stream(2) else subprocess.DEVNULL,
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
        process = ForkedProcess(self.close, read_end)
        passed = [write_end]
        try:
            for number in STANDARD_STREAMS:
                passed.append(copy_of_stream(number))
            self._ask(start, [*passed, *descriptors])
        finally:
            for number in passed:
                os.close(number)
        return process

    def load(self, modules: Sequence[str]) -> None:
        """Ask it to load modules; returns at once. Raises OSError if it has ended."""
        self._ask(tuple(modules), [])

    def _ask(self, request: Start | tuple[str, ...], descriptors: Sequence[int]) -> None:
        asked = _in_memory(pickle.dumps(request))
        try:
            socket.send_fds(self._control, [b"\0"], [asked, *descriptors])
        finally:
            os.close(asked)


class _Shared:
    """The server of this process's workers."""

    lock = threading.Lock()
    server: ForkServer | None = None


def start_forked(start: Start, descriptors: Sequence[int]) -> ForkedProcess:
    """Start a process by this process's one server, which is started when it is first needed."""
    with _Shared.lock:
        try:
            return _running_server(start.environment).start(start, descriptors)
        except OSError:  # it ends just now
            _close_shared()
            return _running_server(start.environment).start(start, descriptors)


def load_ahead(modules: Sequence[str], environment: Mapping[str, str]) -> None:
    """Let this process's server, which may begin by that, load modules; returns at once.

    ``environment`` as for `ForkServer`. What fails is left to those who will need a process.
    """
    with _Shared.lock, suppress(OSError):
        _running_server(environment).load(modules)


def _running_server(environment: Mapping[str, str]) -> ForkServer:
    """This process's server; a new one where none runs."""
    if _Shared.server is None or not _Shared.server.is_running:
        _close_shared()
        _Shared.server = ForkServer(environment)
    return _Shared.server


def _close_shared() -> None:
    """Let the server end, at the end of its owner."""
    if _Shared.server is not None:
        _Shared.server.close()


def _forget_shared() -> None:
    """A process that the owner forks by itself has no server, nor keeps its owner's alive."""
    _close_shared()
    _Shared.server, _Shared.lock = None, threading.Lock()


if IS_SUPPORTED:
    atexit.register(_close_shared)
    os.register_at_fork(after_in_child=_forget_shared)


def server_pid() -> int | None:
    """Process id of this process's server, if there is one."""
    return None if _Shared.server is None else _Shared.server.pid


def _in_memory(data: bytes) -> int:
    """A file that holds data of any size, so that sending it waits for nobody."""
    descriptor = os.memfd_create("bmask-slam")
    with os.fdopen(descriptor, "wb", closefd=False) as file:
        file.write(data)
    os.lseek(descriptor, 0, os.SEEK_SET)
    return descriptor


def serve() -> None:
    """Main function of the server; its standard input is the socket to its owner."""
    for number in SIGNALS:  # the process that started it decides
        if number is not signal.SIGTERM:
            signal.signal(number, signal.SIG_IGN)
    gc.disable()  # what is loaded stays
    keep_little_memory()
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
            request, passed = received
            if isinstance(request, Start):
                _load(request.loaded)
                _fork(request, passed, statuses, [control.fileno(), woken, wake])
            else:
                _load(*request)


def _fork(
    start: Start, passed: Sequence[int], statuses: dict[int, int], own: Sequence[int]
) -> None:
    """Fork, and tell the owner the new process's id."""
    status, *inherited = passed
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


def _load(*modules: str) -> None:
    """Load modules; the processes will report those that cannot be."""
    for module in modules:
        with suppress(Exception):
            importlib.import_module(module)


def _receive(control: socket.socket) -> tuple[Start | tuple[str, ...], list[int]] | None:
    """The next request, a process or modules, and its descriptors; None: the owner has ended."""
    said, passed, _, _ = socket.recv_fds(control, 1, MAX_PASSED)
    if not said:
        return None
    asked, *others = passed
    with os.fdopen(asked, "rb") as file:
        return pickle.load(file), others  # nosec B301 # from the owner


def _report_ended(statuses: dict[int, int]) -> None:
    """Tell the owner the exit codes of the processes that have ended."""
    with suppress(ChildProcessError):
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            status = statuses.pop(ended[0], None)
            if status is not None:  # else a library has started it
                _write(status, os.waitstatus_to_exitcode(ended[1]))
                os.close(status)


def _write(status: int, number: int) -> None:
    with suppress(OSError):  # the owner no longer listens
        os.write(status, NUMBER.pack(number))


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
