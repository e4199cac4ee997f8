"""What a measurement was made on and with: machine, versions, commit, and a yardstick of speed."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import time
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from slam.sequences import open_sequence

PACKAGES = ("gtsam", "numpy", "opencv-python-headless", "open3d", "scipy")
YARDSTICK_FRAMES = 40
YARDSTICK = (30, 3)  # threshold and octaves, OpenCV's defaults


def describe_machine() -> dict[str, str]:
    """Processor, cores, memory, system and versions, as text."""
    versions = []
    for package in PACKAGES:
        try:
            versions.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return {
        "processor": processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 1e9:.0f} GB",
        "system": platform.platform(),
        "Python": platform.python_version(),
        "packages": ", ".join(versions),
    }


def processor() -> str:
    """The processor's name as Linux gives it, else what Python knows."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        match = re.search(r"model name\s*:\s*(.+)", info.read_text(encoding="utf-8"))
        if match:
            return match[1].strip()
    return platform.processor() or platform.machine()


def load_average() -> float:
    """Processes that wanted to run during the last minute, this one's included."""
    return os.getloadavg()[0]


def describe_commit(root: Path, written: tuple[str, ...]) -> str:
    """The commit's short hash; says so when tracked files differ from it.

    ``written`` are paths that the benchmark writes itself; they do not count.
    """
    head = _git(root, "rev-parse", "--short=12", "HEAD")
    if not head:
        return "unknown (no git checkout)"
    excluded = [f":(exclude){path}" for path in written]
    changed = _git(root, "status", "--porcelain", "--untracked-files=no", "--", ".", *excluded)
    files = sorted(line[3:] for line in changed.splitlines())
    return head if not files else f"{head} with changes in {', '.join(files)}"


def _git(root: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, text=True, check=False
        )
    except FileNotFoundError:
        return ""
    return done.stdout.rstrip() if done.returncode == 0 else ""


def now() -> str:
    """Date and time in UTC."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def brisk_ms(folder: Path) -> float:
    """Median time of OpenCV's BRISK, detection and description, on a sequence's first frames.

    What the library alone takes at its own defaults, whatever ours are, so that times on different
    machines, or on one that is busy, can be set in relation.
    """
    brisk = cv2.BRISK_create(*YARDSTICK)
    times_ms = []
    for frame in islice(open_sequence(folder).frames(prefetch=0), YARDSTICK_FRAMES):
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        start_s = time.perf_counter()
        brisk.detectAndCompute(gray, None)
        times_ms.append(1e3 * (time.perf_counter() - start_s))
    return float(np.median(times_ms))
