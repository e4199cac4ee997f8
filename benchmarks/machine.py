"""The circumstances of a measurement: machine, versions, commit, and a speed reference."""

from __future__ import annotations

import os
import time
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.runtime import machine
from bmask_slam.runtime.machine import versions
from bmask_slam.sequences.sequence import open_sequence

PACKAGES = ("gtsam", "numpy", "opencv-python-headless", "open3d", "scipy")
YARDSTICK_FRAMES = 40
YARDSTICK = (30, 3)  # threshold and octaves, OpenCV's defaults


def describe_machine() -> dict[str, str]:
    """Processor, cores, memory, system and versions, as text."""
    packages = ", ".join(f"{name} {number}" for name, number in versions(PACKAGES).items())
    return machine.describe_machine() | {"packages": packages}


def load_average() -> float:
    """Mean number of runnable processes during the last minute, with this one."""
    return os.getloadavg()[0]


def describe_commit(written: tuple[str, ...]) -> str:
    """The commit's short hash, with the tracked files that differ from it.

    ``written`` are paths that the benchmark writes itself; they do not count.
    """
    head, changed = machine.commit(written)
    if not head:
        return "unknown (no git checkout)"
    return head if not changed else f"{head} with changes in {', '.join(changed)}"


def resident_mb() -> float:
    """Resident memory of this process now in MB (1e6 bytes)."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def own_mb(pid: int | str) -> float:
    """Anonymous resident memory of a process in MB (1e6 bytes)."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    anonymous = next(line.split() for line in lines if line.startswith("RssAnon"))
    return int(anonymous[1]) * 1024 / 1e6


def now() -> str:
    """Date and time in UTC."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def brisk_ms(folder: Path) -> float:
    """Median time of OpenCV's BRISK, detection and description, on a sequence's first frames.

    With the library's defaults, so that times on different or busy machines can be compared.
    """
    return features_ms(cv2.BRISK_create(*YARDSTICK), folder)


def features_ms(detector: cv2.Feature2D, folder: Path) -> float:
    """Median time of detection and description on a sequence's first YARDSTICK_FRAMES frames."""
    times_ms = []
    for frame in islice(open_sequence(folder).frames(prefetch=0), YARDSTICK_FRAMES):
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        start_s = time.perf_counter()
        detector.detectAndCompute(gray, None)
        times_ms.append(1e3 * (time.perf_counter() - start_s))
    return float(np.median(times_ms))
