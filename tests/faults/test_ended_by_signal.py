"""Processes that are ended: by a closed terminal, during a run and during its start."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from faults import frames_written

from bmask_slam.graph.trajectory import read_tum

FRAMES = 60
COMMAND = [sys.executable, "-m", "bmask_slam"]
USUAL = (
    "import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_DFL); "
    "os.execvp(sys.argv[1], sys.argv[1:])"
)
"""Starts a command that SIGHUP ends, also where these tests themselves run under nohup."""


@pytest.mark.parametrize("words", [("run",), ("live", "--realtime")])
def test_a_closed_terminal_ends_a_run_with_everything_saved(
    slow_office: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    """The kernel sends SIGHUP to all processes of the terminal, which can be written no more."""
    out = tmp_path / "run"
    command = [*COMMAND, *words, str(slow_office), "--segmenter", "none", "--out", str(out)]
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        ["setsid", "--ctty", sys.executable, "-c", USUAL, *command],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        pass_fds=[theirs],
    )
    os.close(theirs)
    os.set_blocking(ours, False)
    end_s = time.monotonic() + 300
    while frames_written(out) < 8 and time.monotonic() < end_s:
        try:  # a full terminal would block the run
            os.read(ours, 1 << 16)
        except BlockingIOError:
            time.sleep(0.02)
    os.close(ours)
    code = process.wait(timeout=300)
    assert code == 128 + signal.SIGHUP, (out / "log.txt").read_text()
    assert 8 <= len(read_tum(out / "trajectory.txt")) <= frames_written(out) < FRAMES
    assert {"map", "metrics.json", "landmarks.ply"} <= {path.name for path in out.iterdir()}


SLEEPER = """
import sys, time
from types import SimpleNamespace
from bmask_slam import cli

def handler(arguments):
    print("started", flush=True)
    time.sleep(60)

arguments = SimpleNamespace(handler=handler, verbose=False, command="run")
cli.make_parser = lambda: SimpleNamespace(parse_args=lambda _: arguments)
sys.exit(cli.main())
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_during_the_start_is_one_line(number: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", USUAL, sys.executable, "-c", SLEEPER],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n"
    process.send_signal(number)
    _, errors = process.communicate(timeout=300)
    assert errors == f"ended by {number.name}\n"
    assert process.returncode == 128 + number


def test_nohup_stays_in_force(slow_office: Path, tmp_path: Path) -> None:
    """A SIGHUP that is ignored when the program starts does not end it."""
    out, frames = tmp_path / "run", str(FRAMES // 2)
    words = ["run", str(slow_office), "--max-frames", frames, "--segmenter", "none"]
    command = [*COMMAND, *words, "--out", str(out)]
    process = subprocess.Popen(
        ["sh", "-c", "trap '' HUP; exec \"$@\"", "sh", *command], stderr=subprocess.DEVNULL
    )
    end_s = time.monotonic() + 300
    while frames_written(out) < 5 and time.monotonic() < end_s:
        time.sleep(0.02)
    process.send_signal(signal.SIGHUP)
    assert process.wait(timeout=300) == 0
    assert len(read_tum(out / "trajectory.txt")) == FRAMES // 2
