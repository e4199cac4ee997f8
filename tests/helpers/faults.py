"""Faults for tests: full disks, time that passes at once, what is left of processes and runs."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from bmask_slam.runtime.fork_server import server_pid

TIMED = ("log.txt", "metrics.json", "trajectory.png")
"""Files of a run that hold dates or times."""
LONG_S = 1200.0
"""Longest time that a test waits for what must happen. A process of low priority needs it beside
six busy programs, which leave it a hundredth of a core."""


class Clock:
    """The clock that ``time.monotonic`` is in a module; ``pass_s`` moves it ahead at once."""

    def __init__(self) -> None:
        self._passed_s = 0.0

    def monotonic(self) -> float:
        return time.monotonic() + self._passed_s

    def pass_s(self, seconds: float) -> None:
        """Let so much time pass."""
        self._passed_s += seconds


def wait_until(happened: Callable[[], object], limit_s: float = LONG_S) -> None:
    """Wait for something; raises AssertionError if it does not happen."""
    end_s = time.monotonic() + limit_s
    while not happened():
        assert time.monotonic() < end_s, "it has not happened"
        time.sleep(0.01)


def fill(disk: Path) -> Path:
    """Fill the file system with a file, and return that."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1024))
        except OSError:
            return ballast


def children() -> set[int]:
    """Processes that this one or its fork server has started and that still run."""
    found, waiting, server = set(), [os.getpid()], server_pid()
    while waiting:
        for task in Path(f"/proc/{waiting.pop()}/task").glob("*/children"):
            with suppress(FileNotFoundError):
                pids = {int(pid) for pid in task.read_text().split()}
                found |= pids
                waiting += pids
    return set(running(sorted(found - {server})))


def frames_written(out: Path) -> int:
    """Lines of a run's frames.csv, without the head."""
    path = out / "frames.csv"
    return len(path.read_text().splitlines()) - 1 if path.is_file() else 0


def untimed_files(folder: Path) -> dict[str, object]:
    """All files of a run, without times."""
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    with (folder / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    untimed = [{k: v for k, v in row.items() if not k.endswith("_ms")} for row in rows]
    return {**files, **dict.fromkeys(TIMED), "frames.csv": untimed}


def running(pids: list[int]) -> list[int]:
    """The processes that still run, without zombies."""
    states = {}
    for pid in pids:
        path = Path(f"/proc/{pid}/stat")
        if path.is_file():
            states[pid] = path.read_text().rsplit(")", 1)[1].split()[0]
    return [pid for pid, state in states.items() if state != "Z"]
