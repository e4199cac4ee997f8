"""Forked processes: surroundings, exit codes, and what happens when the server is killed."""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from faults import LONG_S, running, wait_until
from heaps import thread_uses_main_heap

from bmask_slam.runtime import forked_process
from bmask_slam.runtime.fork_server import (
    IS_SUPPORTED,
    ForkServer,
    Start,
    load_ahead,
    server_pid,
    start_forked,
)
from bmask_slam.runtime.forked_process import ForkedProcess

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


def says_whose_heap(pipe: int) -> None:
    os.write(pipe, str(thread_uses_main_heap()).encode())


def says_who_loaded(pipe: int) -> None:
    os.write(pipe, str(sys.modules["noted"].loaded_by).encode())


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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators differ")
def test_the_threads_of_a_process_share_a_heap(server: ForkServer, tmp_path: Path) -> None:
    process, pipe = started(server, "says_whose_heap", tmp_path)
    assert process.wait(LONG_S) == 0
    with os.fdopen(pipe) as said:
        assert said.read() == "True"


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
    monkeypatch.setattr(forked_process, "PATIENCE_S", 0.1)
    os.kill(server.pid, signal.SIGSTOP)
    process, pipe = started(server, "waits", tmp_path)
    assert process.poll() is None
    process.kill()
    assert process.wait(LONG_S) == -signal.SIGKILL
    assert not server.is_running
    os.close(pipe)


def test_a_server_that_hangs_later_is_killed_too(
    server: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forked_process, "PATIENCE_S", 0.1)
    process, pipe = started(server, "waits", tmp_path)
    assert os.read(pipe, 5) == b"begun"
    os.kill(server.pid, signal.SIGSTOP)
    process.kill()
    assert process.wait(LONG_S) == -signal.SIGKILL
    assert not server.is_running
    os.close(pipe)


@pytest.fixture
def orphans() -> Iterator[None]:
    """Orphans become children of this process, which does not wait for them."""
    become_reaper = ctypes.CDLL(None).prctl
    assert become_reaper(36, 1, 0, 0, 0) == 0
    yield
    become_reaper(36, 0, 0, 0, 0)


@pytest.mark.usefixtures("orphans")
def test_an_orphan_that_nobody_waits_for_has_ended(server: ForkServer, tmp_path: Path) -> None:
    """As in a container whose first process waits for no orphans."""
    process, pipe = started(server, "waits", tmp_path)
    assert os.read(pipe, 5) == b"begun"
    os.kill(server.pid, signal.SIGKILL)
    wait_until(lambda: not server.is_running)
    process.kill()
    assert process.wait(LONG_S) == -signal.SIGKILL
    assert os.waitpid(process.pid, 0)[1] == signal.SIGKILL
    os.close(pipe)


def test_a_server_that_hangs_stops_nobody_who_asks(server: ForkServer, tmp_path: Path) -> None:
    """Also where the environment is larger than what a socket holds."""
    os.kill(server.pid, signal.SIGSTOP)
    large = {f"BMASK_SLAM_TEST_{k}": "x" * 10_000 for k in range(200)}
    start = Start("os:getcwd", "os", os.environ | large, sys.path, str(tmp_path))
    found: list[ForkedProcess] = []
    asking = threading.Thread(target=lambda: found.append(server.start(start, [])), daemon=True)
    asking.start()
    asking.join(30)
    assert found
    assert not found[0].has_begun
    os.kill(server.pid, signal.SIGCONT)
    assert found[0].wait(LONG_S) == 0
    assert found[0].has_begun


def test_an_owner_without_output(tmp_path: Path) -> None:
    """Its files have the numbers of the standard streams, and are not taken for them."""
    script = (
        "import os, sys; from bmask_slam.runtime.fork_server import ForkServer, Start\n"
        "start = Start('library:warn', 'os', dict(os.environ), sys.path, '/')\n"
        "files = [os.open(os.devnull, os.O_RDONLY) for _ in range(2)]\n"
        "server = ForkServer(os.environ)\n"
        "[os.close(file) for file in files]\n"
        "process = server.start(start, [])\n"
        "found = process.wait(300), process.pid\n"
        "open(sys.argv[1], 'w').write(str(found))"
    )
    (tmp_path / "library.py").write_text("import os\ndef warn(): os.write(2, b'a warning')")
    told = tmp_path / "told"
    words = ["/bin/sh", "-c", 'exec "$@" >&- 2>&-', "sh", sys.executable, "-c", script, str(told)]
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths}
    subprocess.run(words, check=True, timeout=LONG_S, env=environment)
    code, pid = told.read_text().strip("()").split(", ")
    assert code == "0"
    assert 0 < int(pid) <= int(Path("/proc/sys/kernel/pid_max").read_text())


def test_an_owner_with_more_than_a_thousand_files(server: ForkServer, tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    opened = [os.open(os.devnull, os.O_RDONLY)]
    try:
        if hard != resource.RLIM_INFINITY and hard < 1100:
            pytest.skip("so many files are not allowed")
        while opened[-1] < 1030:
            opened.append(os.dup(opened[0]))
        process, pipe = started(server, "exits_with_3", tmp_path)
        assert process.wait(LONG_S) == 3
        os.close(pipe)
    finally:
        for descriptor in opened:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_replaced_server_leaves_no_files(tmp_path: Path) -> None:
    counts = []
    for _ in range(3):
        process = start_forked(start_of("exits_with_3", tmp_path), [0])
        assert process.wait(LONG_S) == 3
        del process
        counts.append(len(os.listdir("/proc/self/fd")))
        pid = server_pid() or 0
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda pid=pid: not running([pid]))
    assert counts[1] == counts[2]


def test_modules_are_loaded_ahead(tmp_path: Path) -> None:
    """By the server that processes are forked from; one that is not there keeps nobody."""
    (tmp_path / "noted.py").write_text("import os; loaded_by = os.getpid()")
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    if (before := server_pid()) is not None:
        os.kill(before, signal.SIGKILL)
        wait_until(lambda: not running([before]))
    load_ahead(["no_such_module", "noted"], os.environ | {"PYTHONPATH": paths})
    read_end, write_end = os.pipe()
    process = start_forked(start_of("says_who_loaded", tmp_path), [write_end])
    os.close(write_end)
    with os.fdopen(read_end) as pipe:
        assert pipe.read() == str(server_pid())
    assert process.wait(LONG_S) == 0


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


def test_the_server_ends_with_an_owner_that_has_forked() -> None:
    """A process that a user's program forks by itself does not keep the server."""
    script = (
        "import os, sys, time\n"
        "from bmask_slam.runtime.fork_server import Start, server_pid, start_forked\n"
        "start = Start('os:getcwd', 'os', dict(os.environ), sys.path, '/')\n"
        "start_forked(start, []).wait(300)\n"
        "first, child = server_pid(), os.fork()\n"
        "if child == 0:\n"
        "    assert server_pid() is None\n"
        "    assert start_forked(start, []).wait(300) == 0\n"
        "    print(first, os.getpid(), flush=True)\n"
        "time.sleep(600)"
    )
    owner = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    with owner.stdout as said:
        server, child = map(int, said.readline().split())
    assert running([server])
    owner.kill()
    owner.wait()
    try:
        wait_until(lambda: not running([server]))
        assert running([child])
    finally:
        os.kill(child, signal.SIGKILL)
