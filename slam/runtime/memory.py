"""Memory of this process."""

from __future__ import annotations

import ctypes
import re
import sys
from pathlib import Path


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far in MB (1e6 bytes).

    Linux's VmHWM; elsewhere getrusage, which on Linux would count the parent's memory too.
    """
    status = Path("/proc/self/status")
    if status.exists():
        match = re.search(r"VmHWM:\s+(\d+) kB", status.read_text(encoding="ascii"))
        if match:
            return int(match[1]) * 1024 / 1e6
    import resource  # noqa: PLC0415 - Unix only

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024) / 1e6


def give_back_memory() -> None:
    """Return freed memory to the system; glibc would keep that of freed images."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
