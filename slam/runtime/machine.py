"""The machine and the software of a result: processor, memory, versions, commit."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def describe_machine() -> dict[str, str]:
    """Processor, cores, memory, system and Python, as text."""
    found = {
        "processor": processor(),
        "cores": str(available_cores()),
        "system": platform.platform(),
        "Python": platform.python_version(),
    }
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        size_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
        found["memory"] = f"{size_gb:.0f} GB"
    return found


def processor() -> str:
    """The processor's name from Linux, otherwise from Python."""
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.is_file() else ""
    match = re.search(r"model name\s*:\s*(.+)", text)
    return match[1].strip() if match else platform.processor() or platform.machine()


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of the packages that are installed."""
    found = {}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def commit(apart: tuple[str, ...] = ()) -> tuple[str, list[str]]:
    """The short hash of the checkout and the tracked files that differ from it.

    "" and an empty list where there is no checkout. Paths ``apart`` are not compared.
    """
    head = _git("rev-parse", "--short=12", "HEAD")
    excluded = [f":(exclude){path}" for path in apart]
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", ".", *excluded)
    return head, sorted(line[3:] for line in changed.splitlines())


def _git(*arguments: str) -> str:
    if not (ROOT / ".git").exists():
        return ""
    try:
        done = subprocess.run(  # nosec B603 B607 # fixed words, in this project's checkout
            ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
        )
    except FileNotFoundError:
        return ""
    return done.stdout.rstrip() if done.returncode == 0 else ""
