"""Which libraries are installed and can be loaded, and what those cost that are not there."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import requires

from bmask_slam.runtime.machine import available_cores, versions

CORE = "core"
PROJECT = "bmask-slam"
PURPOSES: dict[str, tuple[str, float | None, float | None]] = {
    CORE: ("run --segmenter none, live, evaluate, compare, optimise, export", 0.19, 0.63),
    "semantics": ("labels and objects: run and live by default, segment, train", 0.2, 0.9),
    "dense": ("dense maps: map, run --map, live --map, a map for nav2", 0.2, 0.9),
    "render": ("render, compare rendered", 0.38, 1.1),
    "view": ("view, live --view, --serve", 0.16, 0.5),
    "foxglove": ("--foxglove of view and live", 0.02, 0.05),
    "ray": ("segmentation on other machines, --ray", 0.08, 0.25),
    "ros": ("ROS bags and MCAP files", 0.01, 0.03),
    "ros2": ("live ros2:, without ROS", 0.02, 0.05),
    "pandas": ("Comparison.to_pandas", 0.02, 0.1),
    "completion": ("tab completion of shells", 0.0, 0.0),
    "realsense": ("live realsense:", 0.01, 0.04),
    "oak": ("live oak:", 0.1, 0.36),
    "azure": ("live azure:, with the Azure Kinect SDK", None, None),
    "record3d": ("live record3d:, recordings of Record3D", 0.001, 0.001),
}
"""What an extra is for, and its download and disk in GB (docs/install.md); None: not measured."""
APART = ("all", "dev", "docs")
"""Extras that only name others, or are for work on this project."""
IMPORTED_AS = {
    "opencv-python-headless": "cv2",
    "faiss-cpu": "faiss",
    "pillow": "PIL",
    "rerun-sdk": "rerun",
    "foxglove-sdk": "foxglove",
}
REQUIREMENT = re.compile(r"^([\w.-]+).*?(?:;.*extra == ['\"]([\w-]+)['\"])?$")
LOAD_S = 120.0
LOADING = """
import importlib, json, sys
from bmask_slam.graph.extras import load_libusb
load_libusb()
for name in sys.argv[1:]:
    print("\\n" + json.dumps([name, None]), flush=True)
    try:
        importlib.import_module(name)
    except BaseException as error:
        print("\\n" + json.dumps([name, f"{type(error).__name__}: {error}"[:200]]), flush=True)
    else:
        print("\\n" + json.dumps([name, ""]), flush=True)
"""
Loader = Callable[[Sequence[str]], dict[str, str]]


@dataclass(frozen=True)
class Package:
    """A library: its version, "" where it is not installed, and why it cannot be loaded, or ""."""

    name: str
    version: str
    error: str = ""

    @property
    def works(self) -> bool:
        """Whether it is there and can be loaded."""
        return bool(self.version) and not self.error


@dataclass(frozen=True)
class Extra:
    """A pip extra, or the core.

    Attributes:
        purpose: the commands that need it.
        packages: its libraries.
        install: the command that installs it.
        download_gb, disk_gb: of all of it; None where that was not measured.
    """

    name: str
    purpose: str
    packages: tuple[Package, ...]
    install: str
    download_gb: float | None
    disk_gb: float | None

    @property
    def missing(self) -> tuple[str, ...]:
        """Libraries that are not installed."""
        return tuple(p.name for p in self.packages if not p.version)

    @property
    def broken(self) -> tuple[Package, ...]:
        """Libraries that are installed and cannot be loaded."""
        return tuple(p for p in self.packages if p.error)


def find_extras(load: Loader | None = None) -> tuple[Extra, ...]:
    """The core and every extra, as the installed program names them; each library is loaded."""
    load = load or load_apart
    needed = needed_packages(requires(PROJECT) or [])
    found = versions({name for names in needed.values() for name in names})
    with ThreadPoolExecutor(available_cores()) as pool:
        checked = pool.map(
            lambda names: load([import_name(n) for n in names if n in found]), needed.values()
        )
        errors = {name: error for part in checked for name, error in part.items()}
    return tuple(_extra(name, names, found, errors) for name, names in needed.items())


def needed_packages(requirements: Sequence[str]) -> dict[str, list[str]]:
    """Distributions by extra (CORE first), of the requirements in a package's metadata."""
    needed: dict[str, list[str]] = {CORE: []}
    for text in requirements:
        match = REQUIREMENT.match(text)
        if match and match[2] not in APART and match[1] != PROJECT:
            needed.setdefault(match[2] or CORE, []).append(match[1])
    return needed


def import_name(distribution: str) -> str:
    """The module of a distribution."""
    return IMPORTED_AS.get(distribution, distribution.replace("-", "_"))


def load_apart(names: Sequence[str]) -> dict[str, str]:
    """Load modules in a process of their own: why one cannot be loaded by its name, "" if it can.

    A library that was built for another processor ends the whole process; the others are then
    loaded in a new one.
    """
    left = list(names)
    errors: dict[str, str] = {}
    while left:
        try:
            done = subprocess.run(  # nosec B603 # fixed code, names of our own table
                [sys.executable, "-P", "-c", LOADING, *left],
                capture_output=True, encoding="utf-8", errors="replace",
                timeout=LOAD_S, check=False,
            )  # fmt: skip
            output, code = done.stdout, done.returncode
        except subprocess.TimeoutExpired as late:
            output, code = _text(late.stdout), None
        told = dict(json.loads(line) for line in output.splitlines() if line.startswith('["'))
        ended = {name for name, error in told.items() if error is None} or set(left) - set(told)
        errors |= {name: error for name, error in told.items() if error is not None}
        errors |= {name: _end(code) for name in sorted(ended)[:1]}
        left = [name for name in left if name not in errors]
    return errors


def _text(output: str | bytes | None) -> str:
    return output.decode(errors="replace") if isinstance(output, bytes) else output or ""


def _end(code: int | None) -> str:
    """What the end of a process says that loaded a library."""
    if code is None:
        return f"does not load within {LOAD_S:g} s"
    if code == -signal.SIGILL:
        return "ends Python with SIGILL: it is built for another processor"
    name = signal.Signals(-code).name if code < 0 else f"status {code}"
    return f"ends Python with {name}"


def _extra(name: str, names: list[str], found: dict[str, str], errors: dict[str, str]) -> Extra:
    packages = tuple(Package(n, found.get(n, ""), errors.get(import_name(n), "")) for n in names)
    purpose, download_gb, disk_gb = PURPOSES.get(name, ("", None, None))
    of = "" if name == CORE else f"[{name}]"
    return Extra(name, purpose, packages, f"pip install '{PROJECT}{of}'", download_gb, disk_gb)
