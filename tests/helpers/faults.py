"""Faults for tests: full disks, and what is left of processes."""

from __future__ import annotations

from pathlib import Path


def fill(disk: Path) -> Path:
    """Fill the file system with a file, and return that."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1024))
        except OSError:
            return ballast


def running(pids: list[int]) -> list[int]:
    """The processes that still run, without zombies."""
    states = {}
    for pid in pids:
        path = Path(f"/proc/{pid}/stat")
        if path.is_file():
            states[pid] = path.read_text().rsplit(")", 1)[1].split()[0]
    return [pid for pid, state in states.items() if state != "Z"]
