"""Large arrays between two processes: copied once into memory that both see, and once out of it.

The memory is a file without a name, which one process inherits from the other; the system frees
it with the last of them, however they end.
"""

from __future__ import annotations

import mmap
import os
import tempfile

import numpy as np

SIZE = 16 << 20
"""Bytes of one direction: some keyframes' images. Address space, until it is written to."""
_HEADER = 64
_ALIGNMENT = 64


def nameless_file(size: int) -> int:
    """A descriptor of a file of so many bytes that no folder lists."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("bmask-slam")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor


class Ring:
    """Bytes from one writer to one reader, in order; what finds no room is refused at once.

    Positions count all bytes ever written. The writer alone knows where it is; where the reader is
    stands in the header, a word that the machine writes at once.
    """

    def __init__(self, descriptor: int) -> None:
        """Over a file of at least a header's size, which may be closed afterwards."""
        self._map = mmap.mmap(descriptor, 0)
        self._read = np.frombuffer(self._map, np.uint64, 1)
        self._bytes = np.frombuffer(self._map, np.uint8, offset=_HEADER)
        self._written = 0

    def put(self, data: memoryview) -> int | None:
        """Copy bytes in; where they lie, for ``take``, or None where there is no room."""
        size, capacity = data.nbytes, len(self._bytes)
        begin = -(-self._written // _ALIGNMENT) * _ALIGNMENT
        if begin % capacity + size > capacity:  # not over the end
            begin = -(-begin // capacity) * capacity
        read = int(self._read[0])
        oldest = begin if read >= self._written else read
        if begin + size - oldest > capacity:
            return None
        place = begin % capacity
        self._bytes[place : place + size] = np.frombuffer(data, np.uint8)
        self._written = begin + size
        return begin

    def take(self, begin: int, size: int) -> bytearray:
        """Copy bytes out, in the order in which they were put; their room is free again."""
        place = begin % len(self._bytes)
        data = bytearray(self._bytes[place : place + size])
        self._read[0] = begin + size
        return data
