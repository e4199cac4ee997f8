"""Processes: messages arrive in order; crashes are detected and leave no files."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bmask_slam.live.channel import Channel
from bmask_slam.live.processes.worker import Failure, Worker
from bmask_slam.runtime.fork_server import IS_SUPPORTED, server_pid

HERE = f"{__name__}"


def echo(channel: Channel, prefix: str) -> None:
    """Answer every message with itself."""
    logging.getLogger("slam.echo").warning("%s begins", prefix)
    for message in channel.messages():
        channel.send((prefix, message))


def fail(channel: Channel) -> None:
    for message in channel.messages():
        raise ValueError(f"cannot do {message}")


def sleep(channel: Channel) -> None:
    time.sleep(600)


def has_ended(pid: int, timeout_s: float = 60.0) -> bool:
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        if (Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]) == "Z":
            return True
        time.sleep(0.02)
    return False


def answers(worker: Worker, count: int) -> list:
    found, deadline_s = [], time.monotonic() + 60
    while len(found) < count and time.monotonic() < deadline_s:
        found += worker.receive(0.2)
    return found


def test_a_worker_is_in_its_owners_session_without_its_interrupts() -> None:
    """Priorities count within a session; Ctrl-C goes to a process group."""
    worker = Worker("echo", f"{HERE}:echo", "a")
    try:
        assert os.getsid(worker.pid) == os.getsid(0)
        assert os.getpgid(worker.pid) == worker.pid
    finally:
        worker.kill()


def test_messages_of_any_size_are_echoed_in_order(caplog) -> None:
    worker = Worker("echo", f"{HERE}:echo", "a")
    sizes = [10, 100_000, 5_000_000, 400_000, 0, *[300_000] * 12]  # more than the memory holds
    arrays = [np.arange(size) for size in sizes]
    for message in (1, *arrays, "three"):
        worker.send(message)
    first, *middle, last = answers(worker, len(arrays) + 2)
    assert (first, last) == (("a", 1), ("a", "three"))
    for (_, found), array in zip(middle, arrays, strict=True):
        np.testing.assert_array_equal(found, array)
        found[:] = 0  # it is the receiver's own
    assert worker.is_running
    worker.stop()
    assert not worker.is_running
    assert "a begins" in caplog.text
    worker.stop()


def test_messages_before_a_stop_are_processed(monkeypatch) -> None:
    worker = Worker("echo", f"{HERE}:echo", "a")
    unpack = Channel._unpack

    def unpack_slowly(self: Channel, *packed: Any) -> Any:
        time.sleep(0.005)  # the worker ends before its answers have been read
        return unpack(self, *packed)

    monkeypatch.setattr(Channel, "_unpack", unpack_slowly)
    for k in range(50):
        worker.send(k)
    worker.stop()
    assert [k for _, k in worker.receive()] == list(range(50))


def test_a_workers_error_is_raised() -> None:
    worker = Worker("fail", f"{HERE}:fail")
    worker.send("this")
    (failure,) = answers(worker, 1)
    assert isinstance(failure, Failure)
    assert "ValueError: cannot do this" in failure.text
    worker.stop()
    assert not worker.is_running


class Unreadable:
    """Raises where it is unpickled."""

    def __reduce__(self) -> tuple[type[int], tuple[str]]:
        return int, ("no number",)


def test_a_message_that_cannot_be_read_ends_the_worker(caplog) -> None:
    worker = Worker("echo", f"{HERE}:echo", "a")
    worker.send(1)
    answers(worker, 1)
    worker.send(Unreadable())
    assert has_ended(worker.pid, 30.0)
    worker.receive(1.0)
    assert any("cannot be read" in text and "no number" in text for text in caplog.messages)
    worker.stop()


def test_a_message_that_cannot_be_sent_ends_the_worker(caplog) -> None:
    worker = Worker("echo", f"{HERE}:echo", "a")
    worker.send(1)
    answers(worker, 1)
    worker.send(lambda: 0)
    assert has_ended(worker.pid, 30.0)
    assert not worker.is_running
    assert "a message between processes cannot be sent" in caplog.text and "lambda" in caplog.text
    worker.stop()


def test_a_killed_worker_is_detected_and_sending_is_safe() -> None:
    worker = Worker("echo", f"{HERE}:echo", "a")
    worker.send(1)
    answers(worker, 1)
    os.kill(worker.pid, signal.SIGKILL)
    deadline_s = time.monotonic() + 60
    while worker.is_running and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert not worker.is_running
    for _ in range(20):
        worker.send(np.zeros(100_000))
    assert worker.receive() == []
    worker.stop()


def test_what_is_sent_to_a_worker_that_has_ended_is_not_kept() -> None:
    """As the images for a workstation that is away for hours."""
    worker = Worker("echo", f"{HERE}:echo", "a")
    worker.kill()
    worker._channel.join()
    image = np.zeros(100_000)
    kept = weakref.ref(image)
    worker.send(image)
    del image
    assert kept() is None


def test_a_worker_that_does_not_end_is_killed(caplog) -> None:
    worker = Worker("sleeper", f"{HERE}:sleep")
    pid = worker.pid
    worker.stop(timeout_s=0.5)
    assert has_ended(pid)
    assert "sleeper does not end; killed" in caplog.text


def assert_echoes() -> None:
    """A worker that is started now answers."""
    worker = Worker("echo", f"{HERE}:echo", "a")
    worker.send(1)
    try:
        assert answers(worker, 1) == [("a", 1)]
    finally:
        worker.kill()


def test_a_worker_does_not_import_from_the_current_folder(tmp_path, monkeypatch) -> None:
    hostile = "from pathlib import Path; Path('ran').touch()"
    (tmp_path / "queue.py").write_text(hostile)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # as ``python -m`` does
    assert_echoes()
    assert not (tmp_path / "ran").exists()


def test_a_worker_of_an_owner_whose_folder_was_removed(tmp_path, monkeypatch) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert_echoes()


@pytest.mark.skipif(not IS_SUPPORTED, reason="needs a server")
def test_nobody_waits_for_a_worker_that_is_not_there_yet() -> None:
    Worker("echo", f"{HERE}:echo", "a").kill()  # now there is a server
    server = server_pid()
    assert server is not None
    os.kill(server, signal.SIGSTOP)
    try:
        worker = Worker("echo", f"{HERE}:echo", "a")
        found: list[float] = []
        asking = threading.Thread(target=lambda: found.append(worker.processor_s), daemon=True)
        asking.start()
        asking.join(30)
        assert found == [0.0]
    finally:
        os.kill(server, signal.SIGCONT)
    assert worker.pid
    worker.kill()


def test_ctrl_c_in_the_terminal_does_not_reach_a_worker() -> None:
    worker = Worker("echo", f"{HERE}:echo", "a")
    worker.send(1)
    answers(worker, 1)
    os.kill(worker.pid, signal.SIGINT)
    worker.send(2)
    assert answers(worker, 1) == [("a", 2)]
    assert os.getpgid(worker.pid) != os.getpgid(0)
    worker.stop()


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_a_worker_ends_with_its_owner() -> None:
    script = (
        "from bmask_slam.live.processes.worker import Worker; import time\n"
        f"w = Worker('echo', '{HERE}:echo', 'a'); w.send(1); w.receive(20)\n"
        "print(w.pid, flush=True); time.sleep(600)"
    )
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    owner = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
    )
    assert owner.stdout is not None
    pid = int(owner.stdout.readline())
    owner.kill()
    owner.wait()
    assert has_ended(pid)
