"""Memory of this process, and settings by which it pauses less."""

from __future__ import annotations

import ctypes
import gc
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

NO_MEMORY = ("failed to map segment", "annot allocate memory", "can't start new thread")
"""What the dynamic linker and Python say where there is no memory for a library or a thread."""
SWITCH_S = 0.0005
"""Longest time that another thread keeps Python's lock, which tracking needs often in a frame."""
ALLOCATOR = {-8: 1, -1: 16 << 20, -3: 16 << 20}
"""Parameters of glibc's ``mallopt``. M_ARENA_MAX: one heap for all threads, since each keeps what
was freed in it; Python's lock lets few of them allocate at once. M_TRIM_THRESHOLD: bytes kept at
the end of the heap, by default up to 64 MB. M_MMAP_THRESHOLD: larger blocks are given back when
they are freed; with 4 MB a run takes 3 % longer, since their pages are new each time."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that there is no memory, or that a limit of it was reached."""
    return isinstance(error, MemoryError) or any(text in str(error) for text in NO_MEMORY)


_noted_mb = [0.0]
"""Largest peak that was noted."""


def peak_rss_mb() -> float:
    """Largest resident memory so far in MB (1e6 bytes), with that of the processes it has.

    Linux's VmHWM, each process at its own peak; of one with children, such as the server that
    workers are forked from, these have its memory too. Those that have ended count if their peak
    was noted. Elsewhere getrusage, which on Linux would count the parent's memory too, of this
    process alone.
    """
    if own := _linux_peak_mb(os.getpid()):
        leaves_mb = sum(_peak_of_leaves_mb(child) for child in _children(os.getpid()))
        return max(_noted_mb[0], own + leaves_mb)
    import resource  # noqa: PLC0415 - Unix only

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024) / 1e6


def note_peak() -> None:
    """Note the peak so far: to be called before a process ends, whose own is gone then."""
    _noted_mb[0] = peak_rss_mb()


def _linux_peak_mb(pid: int) -> float:
    """Peak of a process; 0 where it is not told, or the process has ended."""
    with suppress(OSError):
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
        if match := re.search(r"VmHWM:\s+(\d+) kB", status):
            return int(match[1]) * 1024 / 1e6
    return 0.0


def _children(pid: int) -> list[int]:
    """Process ids of a process's children; those seen so far, if it ends meanwhile."""
    found: list[int] = []
    with suppress(OSError):
        for path in Path(f"/proc/{pid}/task").glob("*/children"):
            with suppress(OSError):
                found += map(int, path.read_text(encoding="ascii").split())
    return found


def _peak_of_leaves_mb(pid: int) -> float:
    """The peaks of a process's descendants that have no children, or its own if it has none."""
    children = _children(pid)
    return sum(map(_peak_of_leaves_mb, children)) if children else _linux_peak_mb(pid)


def memory_limit_bytes() -> int | None:
    """How much memory this process may reserve (``ulimit -v``); None without such a limit."""
    if sys.platform == "win32":
        return None
    import resource  # noqa: PLC0415 - Unix only

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def keep_little_memory() -> None:
    """Let this process return more of what it frees to the system, from its start on."""
    if set_parameter := _of_glibc("mallopt"):
        for parameter, value in ALLOCATOR.items():
            set_parameter(parameter, value)


def give_back_memory() -> None:
    """Return freed memory to the system; glibc would keep that of freed images."""
    if trim := _of_glibc("malloc_trim"):
        trim(0)


def _of_glibc(name: str) -> Callable[..., int] | None:
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None


@contextmanager
def short_pauses() -> Iterator[None]:
    """Set the interpreter and faiss for short pauses of this process; restore them at the end.

    A setting that already is as wanted, for instance by another live system, is left alone.
    """
    import faiss  # noqa: PLC0415 - loads slowly

    switch_s, threads = sys.getswitchinterval(), faiss.omp_get_max_threads()
    with ExitStack() as restore:
        if switch_s > SWITCH_S:
            sys.setswitchinterval(SWITCH_S)
            restore.callback(sys.setswitchinterval, switch_s)
        if threads > 1:  # a second thread would wait for a core, and tracking for that thread
            faiss.omp_set_num_threads(1)
            restore.callback(faiss.omp_set_num_threads, threads)
        if not gc.get_freeze_count():  # scanning all modules would stop tracking for 0.1 s
            gc.freeze()
            restore.callback(gc.unfreeze)
        yield
