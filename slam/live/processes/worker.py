"""A child process that handles messages, and its owner's end of the connection.

The child is forked by a server (Linux), or a new interpreter, so that the caller's script needs no
``if __name__ == "__main__"`` and of its owner only a socket is inherited. It ends when its owner
does, for whatever reason. It stays in its owner's session, since Linux compares priorities only
within a session (autogroups).
"""

from __future__ import annotations

import gc
import importlib
import itertools
import logging
import os
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from bmask_slam.graph.errors import InputError
from bmask_slam.live.channel import Channel, ForwardedLog
from bmask_slam.live.shared_memory import SIZE, Ring, anonymous_file
from bmask_slam.runtime import fork_server
from bmask_slam.runtime.fork_server import Start
from bmask_slam.runtime.forked_process import ForkedProcess
from bmask_slam.runtime.memory import note_peak
from bmask_slam.runtime.stop_request import SIGNALS

logger = logging.getLogger(__name__)

ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
"""Each worker uses one core at most: more threads of libraries would slow tracking down."""
ENDING_S = 1.0
"""Longest time for which a process that is ending by itself is waited for."""
OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM)
"""Exit codes of a process that another one has ended."""


class WorkerEnd(Protocol):
    """The owner's end of a worker, here or on a workstation; see `Worker`."""

    @property
    def pid(self) -> int: ...
    @property
    def processor_s(self) -> float: ...
    @property
    def is_running(self) -> bool: ...
    @property
    def was_killed(self) -> bool: ...
    def send(self, message: Any) -> None: ...
    def receive(self, timeout_s: float = 0.0) -> list[Any]: ...
    def stop(self, timeout_s: float = 5.0) -> None: ...
    def kill(self) -> None: ...


class NoEnd:
    """Of a worker that has not been started yet: what is sent to it is lost."""

    pid, processor_s, is_running, was_killed = 0, 0.0, False, True

    def send(self, message: Any) -> None: ...
    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        return []

    def stop(self, timeout_s: float = 5.0) -> None: ...
    def kill(self) -> None: ...


class WorkstationAwayError(InputError):
    """The workstation does not answer; it may later."""


class Traffic(Protocol):
    """Bytes to a workstation and from it."""

    @property
    def sent_bytes(self) -> int: ...
    @property
    def received_bytes(self) -> int: ...


class Workstation(Protocol):
    """Another machine that runs workers."""

    @property
    def traffic(self) -> Traffic: ...

    def worker(self, name: str, arguments: tuple[Any, ...], state: Path | None) -> WorkerEnd:
        """Start one by its name, from a file of this machine if there is one.

        Raises:
            WorkstationAwayError: the machine cannot be reached.
            InputError: it refuses.
        """

    def is_reachable(self) -> bool:
        """Whether something answers there."""


@dataclass(frozen=True)
class Failure:
    """The last message of a worker that raised an exception: the traceback, and its last line.

    The ``reason`` of an InputError is its own text, without the exception's name.
    """

    text: str
    reason: str = ""


class Worker:
    """A running process that executes ``target``, named ``module:function``.

    The function is called with a ``Channel`` and ``arguments``, which must pickle; it should return
    when the channel's messages end.
    """

    def __init__(self, name: str, target: str, *arguments: Any) -> None:
        self.name = name
        parent_end, child_socket = socket.socketpair()
        files = [anonymous_file(SIZE) for _ in range(2)]
        try:
            self._process = _started(target, [child_socket.fileno(), *files])
            self._channel = Channel(
                Connection(parent_end.detach()), (Ring(files[0]), Ring(files[1]))
            )
        finally:
            child_socket.close()
            for file in files:
                os.close(file)
        self.send((target, arguments))

    @property
    def pid(self) -> int:
        """Process id, 0 if the process could not be started."""
        return self._process.pid

    @property
    def processor_s(self) -> float:
        """The processor's time that it has used; 0 where the system does not say, or not yet."""
        if isinstance(self._process, ForkedProcess) and not self._process.has_begun:
            return 0.0
        try:
            words = Path(f"/proc/{self.pid}/stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            return 0.0
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    @property
    def is_running(self) -> bool:
        """Whether the process runs and its connection is open."""
        return self._channel.open and self._process.poll() is None

    @property
    def was_killed(self) -> bool:
        """Whether a signal from outside ended it, rather than its own fault."""
        return self._process.poll() in OUTSIDE

    def send(self, message: Any) -> None:
        """Queue a message; does nothing once the process has ended."""
        self._channel.send(message)

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        """All messages received so far; waits for the first for at most ``timeout_s``."""
        return self._channel.receive(timeout_s)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Let it handle what was sent, receive its answers, then end it; kill it if it is slow."""
        note_peak()
        self._channel.finish(timeout_s)
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            logger.warning("%s does not end; killed", self.name)
            self.kill()
        self._channel.drain(timeout_s)
        self._channel.close()

    def kill(self) -> None:
        """Kill it. The messages that it sent before can still be received."""
        note_peak()
        if not self._channel.open:  # it is ending by itself
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(ENDING_S)
        self._process.kill()
        self._process.wait()
        self._channel.drain()
        self._channel.close()


def load_ahead(*modules: str) -> None:
    """Let modules of workers that will be started be loaded meanwhile, where they are forked."""
    if fork_server.IS_SUPPORTED:
        fork_server.load_ahead(modules, _environment())


def _environment() -> dict[str, str]:
    return os.environ | ONE_THREAD | safe_import_path()


def _started(target: str, descriptors: list[int]) -> ForkedProcess | subprocess.Popen[bytes]:
    """The process that serves a target with these descriptors."""
    environment = _environment()
    if fork_server.IS_SUPPORTED:
        module = target.partition(":")[0]
        is_own = module.startswith(f"{__name__.partition('.')[0]}.")
        start = Start(
            f"{__name__}:serve",
            module if is_own else __name__,
            environment,
            environment["PYTHONPATH"].split(os.pathsep),
            _current_folder(),
        )
        return fork_server.start_forked(start, descriptors)
    return subprocess.Popen(  # nosec B603 # this module, by number of descriptors
        [sys.executable, "-P", "-c", f"from {__name__} import serve; serve(*{descriptors})"],
        pass_fds=descriptors,
        stdin=subprocess.DEVNULL,
        env=environment,
        process_group=0,  # Ctrl-C in a terminal must reach only the owner
    )


def _current_folder() -> str:
    """Its path, empty if it has been removed."""
    with suppress(FileNotFoundError):
        return os.getcwd()
    return ""


def safe_import_path() -> dict[str, str]:
    """Environment of a child that imports from this process's folders but the current one.

    The current folder may hold foreign files, such as a downloaded recording with a ``queue.py``.
    It is kept where its user names it in PYTHONPATH.
    """
    folders = [p for p in sys.path if os.path.isabs(p)]
    here = _current_folder()
    if here:
        here = os.path.realpath(here)
        given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
        named = here in {os.path.realpath(p) for p in given if p}
        folders = [p for p in folders if named or os.path.realpath(p) != here]
    return {"PYTHONPATH": os.pathsep.join(folders), "PYTHONSAFEPATH": "1"}


def serve(connection: int, owner_ring: int, worker_ring: int) -> None:
    """Main function of the child; the first message says what to run.

    The descriptors are those of the socket, and of the shared memory in which the owner and this
    process write.
    """
    for number in SIGNALS:  # the process that started it decides
        if number is not signal.SIGTERM:
            signal.signal(number, signal.SIG_IGN)
    channel = Channel(Connection(connection), (Ring(worker_ring), Ring(owner_ring)))
    os.close(owner_ring)
    os.close(worker_ring)

    def run(first: tuple[str, tuple[Any, ...]]) -> None:
        module, _, function = first[0].partition(":")
        target: Callable[..., None] = getattr(importlib.import_module(module), function)
        gc.freeze()  # the collector need not scan all modules
        gc.enable()
        target(channel, *first[1])

    gc.disable()  # what is imported stays
    run_first(channel, run)
    sys.stdout.flush()
    os._exit(0)  # nothing is left to do, for which Python would take 0.1 s


def run_first(channel: Channel, run: Callable[[Any], None]) -> None:
    """Do what the first message says; the log and a failure go to the owner."""
    logging.getLogger().addHandler(ForwardedLog(channel))
    logging.getLogger().setLevel(logging.INFO)

    def send_failure(
        kind: type[BaseException], error: BaseException, where: TracebackType | None
    ) -> None:
        last = traceback.format_exception_only(kind, error)[-1].strip()
        reason = str(error) if isinstance(error, InputError) else last
        channel.send(Failure("".join(traceback.format_exception(kind, error, where)), reason))
        channel.finish()

    sys.excepthook = send_failure
    for first in itertools.islice(channel.messages(), 1):
        run(first)
    channel.finish()
