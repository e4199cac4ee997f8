"""The peak of memory counts a process's children; its threads share one heap."""

from __future__ import annotations

import errno
import platform
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bmask_slam.live.channel import Channel
from bmask_slam.live.processes.worker import Worker
from bmask_slam.runtime import memory
from bmask_slam.runtime.memory import note_peak, peak_rss_mb

HOLDS = "import sys; held = bytearray(b'1') * {size}; print('ready', flush=True); sys.stdin.read()"
SIZE = 120_000_000


@pytest.fixture(autouse=True)
def _nothing_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_noted_mb", [0.0])


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere this process's own is told alone")
def test_a_process_may_end_while_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(path: Path, pattern: str) -> Iterator[Path]:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", str(path))

    monkeypatch.setattr(memory.Path, "glob", gone)
    assert peak_rss_mb() > 1
    note_peak()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere this process's own is told alone")
def test_a_worker_that_has_ended_counts() -> None:
    """Such as the map's process of ``run --parallel``, which has ended when the run is measured."""
    before = peak_rss_mb()
    worker = Worker("holder", "test_memory:hold_until_the_end")
    while not worker.receive(1.0):
        assert worker.is_running
    worker.stop()
    assert before + 0.9e-6 * SIZE < peak_rss_mb()
    note_peak()
    assert before + 0.9e-6 * SIZE < peak_rss_mb() < before + 3e-6 * SIZE


def hold_until_the_end(channel: Channel) -> None:
    """A worker with much memory."""
    held = bytearray(b"1") * SIZE
    channel.send(len(held))
    while channel.open:
        channel.receive(1.0)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere this process's own is told alone")
def test_the_peak_counts_children_and_their_children() -> None:
    """Of a child that has children, they are counted: they have what it had when it was forked."""
    before = peak_rss_mb()
    code = HOLDS.format(size=SIZE)
    grandchild = f"import subprocess; subprocess.run([{sys.executable!r}, '-c', {code!r}])"
    for command in (code, grandchild):
        process = subprocess.Popen(
            [sys.executable, "-c", command], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert process.stdout and process.stdout.readline() == b"ready\n"
        assert before + 0.9e-6 * SIZE < peak_rss_mb() < before + 1.5e-6 * SIZE
        process.communicate()
    assert peak_rss_mb() < before + 0.5e-6 * SIZE


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators differ")
@pytest.mark.parametrize("runs_a_command", [False, True])
def test_the_threads_of_the_command_line_share_a_heap(runs_a_command: bool) -> None:
    code = (
        f"import sys; sys.path[:0] = {sys.path!r}\n"
        "from heaps import thread_uses_main_heap\n"
        "from bmask_slam.cli import main\n"
        f"{runs_a_command} and main(['info', 'nothing'])\n"
        "print(thread_uses_main_heap())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == [str(runs_a_command)], done.stderr
