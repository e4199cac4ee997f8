"""The heap on huge pages, where GTSAM's trees of many small blocks are looked up faster.

A tree of some thousand landmarks is spread over hundreds of MB in blocks of about 100 bytes. With
pages of 4 kB the processor cannot keep the addresses of all of them, and each step through the tree
waits for one. Linux gives pages of 2 MB to a program that asks for them; glibc's malloc asks only
with ``GLIBC_TUNABLES=glibc.malloc.hugetlb=1``, which must be set before the program starts.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import sys
from pathlib import Path

GROWTH_BYTES = 32 << 20
"""The heap grows by so much at once, so that most of it is asked for before it is used."""
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3  # malloc.h
_MADV_HUGEPAGE = 14  # sys/mman.h


class _Heap:
    """The heap of this process.

    Attributes:
        libc: None where there are no huge pages to ask for.
        advised: end of the part for which they were asked.
    """

    libc: ctypes.CDLL | None = None
    advised = 0


def use_huge_pages() -> None:
    """Ask for huge pages for all of the heap, and for what it grows by at each further call."""
    if not _Heap.advised and _is_supported():
        _Heap.libc, _Heap.advised = _glibc(), _heap_start()
    if (libc := _Heap.libc) is None or (end := libc.sbrk(0)) == _Heap.advised:
        return
    begin = min(_Heap.advised, end)  # it may have shrunk
    if end > begin and libc.madvise(begin, end - begin, _MADV_HUGEPAGE):
        _Heap.libc = None  # the kernel has none
    _Heap.advised = end


def _is_supported() -> bool:
    """Whether malloc is glibc's, and its user has not set it."""
    is_glibc = sys.platform == "linux" and platform.libc_ver()[0] == "glibc"
    return is_glibc and "glibc.malloc" not in os.environ.get("GLIBC_TUNABLES", "")


def _heap_start() -> int:
    """Where the heap begins, or 1 if that is not known."""
    found = re.search(r"^([0-9a-f]+)-.*\[heap\]$", Path("/proc/self/maps").read_text(), re.M)
    return int(found[1], 16) if found else 1


def _glibc() -> ctypes.CDLL | None:
    """The library, set so that the heap grows in large steps and seldom shrinks.

    Which ends malloc's own adaptation: blocks below 32 MB, its limit, then come from the heap.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    libc.sbrk.argtypes, libc.sbrk.restype = [ctypes.c_ssize_t], ctypes.c_size_t
    libc.madvise.argtypes = [ctypes.c_size_t, ctypes.c_size_t, ctypes.c_int]
    settings = {
        _M_MMAP_THRESHOLD: 32 << 20,
        _M_TRIM_THRESHOLD: 8 * GROWTH_BYTES,
        _M_TOP_PAD: GROWTH_BYTES,
    }
    return libc if all(libc.mallopt(*setting) for setting in settings.items()) else None
