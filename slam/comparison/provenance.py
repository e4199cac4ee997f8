"""Where figures come from: commit, machine, versions, command, the experiment in full."""

from __future__ import annotations

import os
import platform
import re
import shlex
import subprocess
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from slam import __version__
from slam.comparison.experiment import OPTIONS, Configuration, Experiment
from slam.comparison.fingerprint import code_print
from slam.comparison.pool import available_cores
from slam.configuration import differences, find_config, resolve
from slam.system_config import SystemConfig

PACKAGES = ("gtsam", "numpy", "opencv-python-headless", "open3d", "scipy", "torch", "faiss-cpu")
ROOT = Path(__file__).resolve().parents[2]


def provenance(experiment: Experiment, workers: int) -> dict[str, Any]:
    """By name: plain values that can be written as JSON.

    ``workers`` jobs ran beside each other, which tells what their times are worth.
    """
    return {
        "version": __version__,
        "commit": commit(),
        "code": code_print(),
        "command": shlex.join(["bmask-slam", *sys.argv[1:]]) if sys.argv[1:] else "",
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "workers": workers,
        "machine": machine(),
        "packages": dict(_versions()),
        "configurations": {k: _changed(v) for k, v in experiment.configurations.items()},
        "experiment": _plain(asdict(experiment)),
    }


def _changed(configuration: Configuration) -> dict[str, Any]:
    """What differs from the defaults of the code, parameters by dotted path, and the options."""
    file = find_config(configuration.config) if configuration.config else None
    found = differences(resolve(SystemConfig, file, configuration.set), SystemConfig())
    options = {name: getattr(configuration, name) for name in OPTIONS}
    return found | {name: value for name, value in options.items() if value}


def commit() -> str:
    """The short hash of the checkout, "with changes" if files differ; "" without a checkout."""
    head = _git("rev-parse", "--short=12", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return f"{head} with changes" if head and changed else head


def machine() -> dict[str, str]:
    """Processor, cores, memory, system and Python."""
    found = {
        "processor": _processor(),
        "cores": str(available_cores()),
        "system": platform.platform(),
        "Python": platform.python_version(),
    }
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        size_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
        found["memory"] = f"{size_gb:.0f} GB"
    return found


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.is_file() else ""
    match = re.search(r"model name\s*:\s*(.+)", text)
    return match[1].strip() if match else platform.processor() or platform.machine()


def _versions() -> list[tuple[str, str]]:
    found = []
    for package in PACKAGES:
        try:
            found.append((package, version(package)))
        except PackageNotFoundError:
            continue
    return found


def _git(*arguments: str) -> str:
    if not (ROOT / ".git").exists():
        return ""
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
        )
    except FileNotFoundError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _plain(value: Any) -> Any:
    """Paths as text, all the way down."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
