"""Large arrays between two processes: copied once into shared memory, and once out of it.

The memory is an anonymous file, whose descriptor one process inherits from the other; the operating
system frees it when both have ended, however they end.
"""

from __future__ import annotations

import mmap
import os
import tempfile

import numpy as np

SIZE = 16 << 20
"""Bytes for one direction: some keyframes' images. Pages are allocated when they are written."""
_HEADER = 64
_ALIGNMENT = 64


def anonymous_file(size: int) -> int:
    """The descriptor of an anonymous file of ``size`` bytes."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("bmask-slam")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor


class Ring:
    """A ring buffer for one writer and one reader; data that does not fit is refused at once.

    Positions count all bytes ever written. The writer keeps its own position; the reader's position
    is in the header, a 64-bit word that the machine writes atomically.
    """

    def __init__(self, descriptor: int) -> None:
        """Map a file that is larger than the header; its descriptor may be closed afterwards."""
        self._map = mmap.mmap(descriptor, 0)
        self._position = np.frombuffer(self._map, np.uint64, 1)
        self._bytes = np.frombuffer(self._map, np.uint8, offset=_HEADER)
        self._written = 0

    def write(self, data: memoryview) -> int | None:
        """Copy bytes in; returns their position, for ``read``, or None if there is no room."""
        size, capacity = data.nbytes, len(self._bytes)
        begin = -(-self._written // _ALIGNMENT) * _ALIGNMENT
        read = int(self._position[0])
        is_empty = read >= self._written
        if is_empty or begin % capacity + size > capacity:  # at the first page: few are used then
            begin = -(-begin // capacity) * capacity
        oldest = begin if is_empty else read
        if begin + size - oldest > capacity:
            return None
        place = begin % capacity
        self._bytes[place : place + size] = np.frombuffer(data, np.uint8)
        self._written = begin + size
        return begin

    def read(self, begin: int, size: int) -> bytearray:
        """Copy bytes out, in the order in which they were written, and free their room."""
        place = begin % len(self._bytes)
        data = bytearray(self._bytes[place : place + size])
        self._position[0] = begin + size
        return data
