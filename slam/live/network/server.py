"""What runs on a workstation: a process for each worker of a robot that knows the token."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.live.channel import Channel
from bmask_slam.live.network.carrying import CarriedFiles, Outbox
from bmask_slam.live.network.connection import CODE_BYTES, Connection, Keys, admit
from bmask_slam.live.processes.segmentation import serve_segmenter
from bmask_slam.live.processes.worker import ONE_THREAD, run_first, safe_import_path
from bmask_slam.runtime.scratch import scratch_folder

logger = logging.getLogger(__name__)

HANDSHAKE_S = 5.0
MAX_HANDSHAKES, MAX_WORKERS = 8, 16
_POLL_S = 0.2


@dataclass(frozen=True)
class _Child:
    """A process, and for whom it works."""

    process: subprocess.Popen[bytes]
    robot: str


class WorkstationServer:
    """Accepts robots; each connection that is admitted gets a process of its own.

    Attributes:
        port: it listens on.
    """

    def __init__(self, host: str, port: int, token: bytes) -> None:
        """Listen. Raises InputError: the address cannot be used."""
        try:
            infos = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
            self._end = socket.create_server(infos[0][4][:2], family=infos[0][0], backlog=16)
        except (OSError, UnicodeError) as error:  # UnicodeError: no name of a host
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{host}:{port}: {reason}") from error
        self.port = int(self._end.getsockname()[1])
        self._token = token
        self._closed = threading.Event()
        self._children: list[_Child] = []
        self._open = threading.Semaphore(MAX_HANDSHAKES)
        self._waiting: list[socket.socket] = []  # for their handshakes, the oldest first
        self._handshakes = ThreadPoolExecutor(MAX_HANDSHAKES, "handshake")

    def serve(self, ends: Callable[[], bool] = lambda: False) -> None:
        """Accept until ``close``, or until ``ends``."""
        self._end.settimeout(_POLL_S)
        while not self._closed.is_set() and not ends():
            self._reap()
            try:
                end, address = self._end.accept()
            except TimeoutError:
                continue
            except OSError as error:  # closed, or too many files are open, or the network fails
                if not self._closed.is_set():
                    logger.warning("nobody can be admitted at present: %s", error)
                    self._closed.wait(_POLL_S)
                continue
            if not self._open.acquire(blocking=False):  # who knows the token needs no time
                for oldest in self._waiting[:1]:
                    _end(oldest)
                self._open.acquire()
            self._waiting.append(end)
            self._handshakes.submit(self._admit, end, str(address[0]))

    def close(self) -> None:
        """End it and all workers; from any thread."""
        self._closed.set()
        self._end.close()
        self._handshakes.shutdown(wait=True)
        for child in self._children:
            child.process.kill()
            child.process.wait()

    def _admit(self, end: socket.socket, robot: str) -> None:
        """Start a process for who knows the token, within HANDSHAKE_S."""
        timer = threading.Timer(HANDSHAKE_S, lambda: _end(end))
        timer.start()
        try:
            with closing(end):
                end.settimeout(HANDSHAKE_S)
                keys = admit(end, self._token)
                self._waiting.remove(end)
                timer.cancel()
                if keys is None:
                    logger.warning("%s: refused; another token or version", robot)
                elif len(self._children) >= MAX_WORKERS:
                    logger.warning("%s: refused; %d workers run", robot, MAX_WORKERS)
                elif not self._closed.is_set():
                    self._children.append(_Child(_started(end, keys), robot))
        except OSError as error:
            logger.info("%s: gone before it was admitted (%s)", robot, error)
        finally:
            timer.cancel()
            if end in self._waiting:
                self._waiting.remove(end)
            self._open.release()

    def _reap(self) -> None:
        for child in [c for c in self._children if c.process.poll() is not None]:
            self._children.remove(child)
            logger.info("%s: process %d has ended", child.robot, child.process.pid)


def _end(end: socket.socket) -> None:
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)


def _started(end: socket.socket, keys: Keys) -> subprocess.Popen[bytes]:
    """A process that has the connection; it gets the keys over a pipe, which nobody else reads."""
    code = f"from {__name__} import work; work({end.fileno()})"
    child = subprocess.Popen(  # nosec B603 # this module, by number of descriptor
        [sys.executable, "-P", "-c", code],
        pass_fds=[end.fileno()],
        stdin=subprocess.PIPE,
        env=os.environ | ONE_THREAD | safe_import_path(),
        process_group=0,
    )
    assert child.stdin is not None
    with child.stdin as pipe:
        pipe.write(keys.sending + keys.receiving)
    logger.info("process %d has begun", child.pid)
    return child


def work(descriptor: int) -> None:
    """Main function of a worker's process."""
    data = sys.stdin.buffer.read(2 * CODE_BYTES)
    if len(data) < 2 * CODE_BYTES:  # who had the keys has ended; an empty one would be anyone's
        return
    end = socket.socket(fileno=descriptor)
    connection = Connection(end, Keys(data[:CODE_BYTES], data[CODE_BYTES:]))
    channel = Channel(connection, None, Outbox())
    with scratch_folder() as folder:

        def run(first: tuple[str, tuple[Any, ...], Any]) -> None:
            _run(channel, folder, *first)

        run_first(channel, run)


def _run(channel: Channel, folder: Path, name: str, arguments: tuple[Any, ...], state: Any) -> None:
    """Do a worker's work until its owner ends."""
    if name == "map":
        from bmask_slam.live.processes.map_process import serve_map  # noqa: PLC0415 - takes 1 s

        path = None
        if state is not None:
            path = folder / "state"
            state.tofile(path)
        camera, config, names, resent = arguments
        files: Any = CarriedFiles(channel, folder)
        serve_map(files, camera, config, names, path, resent)
    elif name == "segmenter":
        serve_segmenter(channel, *arguments)
    else:
        raise InputError(f"{name}: no work of a workstation")
