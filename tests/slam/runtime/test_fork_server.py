"""Forked processes: surroundings, exit codes, and what happens when the server is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from faults import LONG_S, running, wait_until

from bmask_slam.runtime import fork_server
from bmask_slam.runtime.fork_server import (
    IS_SUPPORTED,
    ForkedProcess,
    ForkServer,
    Start,
    server_pid,
    start_forked,
)

pytestmark = pytest.mark.skipif(not IS_SUPPORTED, reason="needs Linux")


@pytest.fixture
def server() -> Iterator[ForkServer]:
    server = ForkServer(os.environ)
    yield server
    server.close()


def started(
    server: ForkServer, function: str, folder: Path, loaded: str = "bmask_slam"
) -> tuple[ForkedProcess, int]:
    """A process that runs a function of this module, and the read end of its pipe."""
    read_end, write_end = os.pipe()
    try:
        return server.start(start_of(function, folder, loaded), [write_end]), read_end
    finally:
        os.close(write_end)


def start_of(function: str, folder: Path, loaded: str = "bmask_slam") -> Start:
    environment = os.environ | {"BMASK_SLAM_TEST": "set"}
    return Start(f"{__name__}:{function}", loaded, environment, sys.path, str(folder))


def says_where_it_is(pipe: int) -> None:
    words = os.getcwd(), os.environ["BMASK_SLAM_TEST"], str("numpy" in sys.modules)
    os.write(pipe, "\n".join(words).encode())


def exits_with_3(pipe: int) -> None:
    sys.stdout.flush()
    os._exit(3)


def fails(pipe: int) -> None:
    raise ValueError("cannot")


def waits(pipe: int) -> None:
    os.write(pipe, b"begun")
    time.sleep(2 * LONG_S)


@pytest.mark.parametrize(("loaded", "has_numpy"), [("bmask_slam", False), ("numpy", True)])
def test_a_process_has_its_owners_surroundings_and_the_servers_modules(
    server: ForkServer, tmp_path: Path, loaded: str, has_numpy: bool
) -> None:
    process, pipe = started(server, "says_where_it_is", tmp_path, loaded)
    assert process.wait(LONG_S) == 0
    with os.fdopen(pipe) as said:
        assert said.read().split("\n") == [str(tmp_path), "set", str(has_numpy)]


def test_a_module_that_cannot_be_loaded_is_left_to_the_process(
    server: ForkServer, tmp_path: Path
) -> None:
    process, pipe = started(server, "says_where_it_is", tmp_path, "bmask_slam.nothing")
    assert process.wait(LONG_S) == 0
    os.close(pipe)


def test_an_exit_code_and_a_failure_are_reported(
    server: ForkServer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for function, code in (("exits_with_3", 3), ("fails", 1)):
        process, pipe = started(server, function, tmp_path)
        os.close(pipe)
        assert process.wait(LONG_S) == code
    assert "ValueError: cannot" in capfd.readouterr().err


def test_a_process_can_be_killed_and_waited_for(server: ForkServer, tmp_path: Path) -> None:
    process, pipe = started(server, "waits", tmp_path)
    assert os.read(pipe, 5) == b"begun"
    assert process.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.05)
    process.kill()
    assert process.wait(LONG_S) == -signal.SIGKILL
    process.kill()
    assert os.read(pipe, 1) == b"", "nothing else holds the pipe"
    os.close(pipe)


def test_a_process_survives_its_server_and_its_end_is_noticed(
    server: ForkServer, tmp_path: Path
) -> None:
    process, pipe = started(server, "waits", tmp_path)
    assert os.read(pipe, 5) == b"begun"
    os.kill(server.pid, signal.SIGKILL)
    wait_until(lambda: not server.is_running)
    assert process.poll() is None
    process.kill()
    assert process.wait(LONG_S) == -signal.SIGKILL
    os.close(pipe)


def test_a_process_that_was_asked_of_a_dead_server_has_ended(
    server: ForkServer, tmp_path: Path
) -> None:
    os.kill(server.pid, signal.SIGSTOP)
    process, pipe = started(server, "waits", tmp_path)
    os.kill(server.pid, signal.SIGKILL)
    assert process.wait(LONG_S) == -signal.SIGKILL
    assert process.pid == 0
    process.kill()
    os.close(pipe)


def test_a_server_that_hangs_is_killed_for_a_process_that_is_to_end(
    server: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fork_server, "PATIENCE_S", 0.1)
    os.kill(server.pid, signal.SIGSTOP)
    process, pipe = started(server, "waits", tmp_path)
    assert process.poll() is None
    process.kill()
    assert process.wait(LONG_S) == -signal.SIGKILL
    assert not server.is_running
    os.close(pipe)


def test_a_killed_server_is_replaced(tmp_path: Path) -> None:
    pids = []
    for _ in range(2):
        process = start_forked(start_of("exits_with_3", tmp_path), [0])
        assert process.wait(LONG_S) == 3
        pids.append(pid := server_pid() or 0)
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda pid=pid: not running([pid]))
    assert pids[0] != pids[1]


def test_the_server_ends_with_its_owner() -> None:
    script = (
        "import os, time; from bmask_slam.runtime.fork_server import ForkServer\n"
        "print(ForkServer(os.environ).pid, flush=True); time.sleep(600)"
    )
    owner = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    with owner.stdout as said:
        pid = int(said.readline())
    owner.kill()
    owner.wait()
    wait_until(lambda: not Path(f"/proc/{pid}").exists())
