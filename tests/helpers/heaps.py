"""Where a thread's memory comes from."""

from __future__ import annotations

import ctypes
import threading
from pathlib import Path


def thread_uses_main_heap() -> bool:
    """Whether what a new thread allocates is in the heap of the process's first thread."""
    allocate = ctypes.CDLL(None).malloc
    allocate.restype = ctypes.c_void_p
    places: list[int] = []
    thread = threading.Thread(target=lambda: places.append(allocate(ctypes.c_size_t(50_000))))
    thread.start()
    thread.join()
    maps = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    heaps = [line.split()[0].split("-") for line in maps if line.endswith("[heap]")]
    return any(int(first, 16) <= places[0] < int(end, 16) for first, end in heaps)
