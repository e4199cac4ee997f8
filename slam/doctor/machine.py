"""Memory, disk, limits and the GPU of this machine, as far as this program needs them."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.runtime.machine import describe_machine
from bmask_slam.runtime.memory import memory_limit_bytes

MEMINFO, CGROUP, SHM = Path("/proc/meminfo"), Path("/sys/fs/cgroup"), Path("/dev/shm")  # nosec B108
TORCH_S = 120.0
TORCH = """
import json, torch
seen = torch.cuda.is_available()
count = torch.cuda.device_count() if seen else 0
print(json.dumps({
    "version": torch.__version__, "built_for": torch.version.cuda or "CPU",
    "gpus": [torch.cuda.get_device_name(k) for k in range(count)],
}))
"""
MIN_MEMORY_GB, MIN_DISK_GB, MIN_FILES = 2.0, 1.0, 1024
"""Less is a problem: a run of a room with the light network takes 1 to 2 GB."""


@dataclass(frozen=True)
class Machine:
    """What a run may use; None where the system does not say.

    Attributes:
        hardware: processor, cores, system, Python and memory, as text.
        memory_gb: that is free for this process.
        disk_gb: free, by folder: the working folder, and the one of temporary files.
        open_files: how many a process may have.
        address_gb: limit of ``ulimit -v``; None without one.
        shm_gb: free in /dev/shm.
        load: how many processes wanted a core in the last minute.
    """

    hardware: dict[str, str]
    memory_gb: float | None
    disk_gb: dict[str, float]
    open_files: int | None
    address_gb: float | None
    shm_gb: float | None
    load: float | None = None

    def problems(self) -> list[str]:
        """What stands in the way of a run, each with its cure."""
        found = []
        if self.memory_gb is not None and self.memory_gb < MIN_MEMORY_GB:
            found.append(f"{self.memory_gb:.1f} GB of memory are free; close other programs")
        for folder, free in self.disk_gb.items():
            if free < MIN_DISK_GB:
                found.append(f"{folder}: {free:.1f} GB are free; free some, or set TMPDIR")
        if self.open_files is not None and self.open_files < MIN_FILES:
            found.append(f"a process may open {self.open_files} files; ulimit -n 4096")
        return found


@dataclass(frozen=True)
class Torch:
    """torch as it is installed: ``built_for`` is a version of CUDA or "CPU"; GPUs by name."""

    version: str
    built_for: str
    gpus: tuple[str, ...]


def find_machine() -> Machine:
    """This machine, now."""
    limit = memory_limit_bytes()
    return Machine(
        describe_machine(),
        free_memory_gb(),
        free_disk_gb(),
        _open_files(),
        None if limit is None else limit / 1e9,
        shutil.disk_usage(SHM).free / 1e9 if SHM.is_dir() else None,
        os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    )


def free_disk_gb() -> dict[str, float]:
    """Free space by folder; a folder that is not there, since it was removed, is left out."""
    found = {}
    for folder in (Path.cwd, _scratch):
        with suppress(OSError):
            name = str(folder())
            found[name] = shutil.disk_usage(name).free / 1e9
    return found


def _scratch() -> Path:
    """What graph/files/disk_arrays.py writes to; here its free space is asked, no more."""
    large = Path("/var/tmp")  # nosec B108
    is_told = "TMPDIR" in os.environ or not large.is_dir()
    return Path(tempfile.gettempdir()) if is_told else large


def free_memory_gb() -> float | None:
    """Memory that is free, or that a container's limit leaves, if that is less.

    What the container has read of files counts as free: it is given up before a limit is reached.
    """
    sizes = []
    if MEMINFO.is_file():
        match = re.search(r"MemAvailable:\s+(\d+) kB", MEMINFO.read_text(encoding="ascii"))
        sizes += [int(match[1]) * 1024] if match else []
    files = [CGROUP / "memory.max", CGROUP / "memory.current"]
    if all(file.is_file() for file in files):
        most, used = (file.read_text(encoding="ascii").strip() for file in files)
        if most.isdecimal() and used.isdecimal():
            sizes.append(int(most) - int(used) + _read_of_files())
    return min(sizes) / 1e9 if sizes else None


def _read_of_files() -> int:
    """Bytes of files that a container keeps in memory and has not used lately."""
    file = CGROUP / "memory.stat"
    text = file.read_text(encoding="ascii") if file.is_file() else ""
    match = re.search(r"^inactive_file (\d+)$", text, re.MULTILINE)
    return int(match[1]) if match else 0


def find_torch() -> Torch | None:
    """torch and the GPUs that it sees, asked in a process of its own; None if it does not load."""
    try:
        done = subprocess.run(  # nosec B603 # fixed code
            [sys.executable, "-P", "-c", TORCH],
            capture_output=True, encoding="utf-8", errors="replace", timeout=TORCH_S, check=False,
        )  # fmt: skip
        told = json.loads(done.stdout.splitlines()[-1])
    except (subprocess.TimeoutExpired, ValueError, IndexError):
        return None
    return Torch(told["version"], told["built_for"], tuple(told["gpus"]))


def _open_files() -> int | None:
    if sys.platform == "win32":
        return None
    import resource  # noqa: PLC0415 - Unix only

    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]
