"""Arrays that lie in a file, for what a long session keeps and seldom reads.

The file has no name, so that it ends with the process, and lies in the folder for large temporary
files: ``TMPDIR``, else ``/var/tmp``. Arrays are read through the page cache, which the system
empties when it needs memory. They are written by calls that fail with an error where the disk is
full; what cannot be written stays in memory, and a warning says so once. Results do not depend on
where an array lies.
"""

from __future__ import annotations

import logging
import mmap
import os
import sys
import tempfile
import weakref
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Arrays, Ints

logger = logging.getLogger(__name__)

PAGE, ALIGNMENT = mmap.ALLOCATIONGRANULARITY, 64
CHUNK = 1 << 23
"""Bytes by which a file grows at least; more as it gets larger."""
HAS_FILES = sys.platform != "win32"  # where an open file can have no name
_failed: set[str] = set()


def _folder() -> str | None:
    large = Path("/var/tmp")  # nosec B108 - the file has no name there
    return None if "TMPDIR" in os.environ or not large.is_dir() else str(large)


class _File:
    """A growing file without a name, mapped for reading; it is closed with its last array."""

    def __init__(self) -> None:
        with tempfile.TemporaryFile(dir=_folder(), buffering=0) as file:
            self._descriptor = os.dup(file.fileno())
        weakref.finalize(self, os.close, self._descriptor).atexit = False
        self.size = 0
        self._maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()

    def grow(self, size: int) -> None:
        """Make the file as large; the new part is zero and takes no space yet."""
        os.ftruncate(self._descriptor, size)
        self.size = size

    def map(self, start: int) -> mmap.mmap:
        """The file from a whole page on, for reading."""
        length, access = self.size - start, mmap.ACCESS_READ
        found = mmap.mmap(self._descriptor, length, access=access, offset=start)
        self._maps.add(found)
        return found

    def write(self, data: NDArray, offset: int) -> None:
        """Write all of a contiguous array. Raises OSError."""
        left = data.reshape(-1).view(np.uint8).data
        while left:
            written = os.pwrite(self._descriptor, left, offset)
            left, offset = left[written:], offset + written

    def release(self) -> None:
        """Give back the memory of what was read; it is read again when it is needed."""
        if hasattr(mmap, "MADV_DONTNEED"):
            for mapped in list(self._maps):
                mapped.madvise(mmap.MADV_DONTNEED)


def _stays_in_memory(error: OSError) -> None:
    """Warn of an error, once of each kind."""
    reason = error.strerror or str(error)
    if reason not in _failed:
        _failed.add(reason)
        logger.warning("temporary files: %s; the map stays in memory", reason)


class _Record:
    """A part of a map of a file, as an array can be made of it; lives as long as that array."""

    def __init__(self, mapped: mmap.mmap, begin: int, size: int) -> None:
        self._mapped = np.frombuffer(mapped, np.uint8)[begin : begin + size]
        self.__array_interface__ = self._mapped.__array_interface__


class DiskRecords:
    """Groups of arrays that are written once, such as the features of a keyframe.

    The space of a group is used again when none of its arrays is used any more.
    """

    def __init__(self) -> None:
        self._file: _File | None = None
        self._chunk: tuple[int, mmap.mmap] | None = None
        self._end = 0
        self._free: list[tuple[int, int, mmap.mmap, int]] = []  # size, offset, map, its start

    def stored(self, arrays: Arrays) -> Arrays:
        """Equal arrays that lie in the file and cannot be changed."""
        sizes = [-(-a.nbytes // ALIGNMENT) * ALIGNMENT for a in arrays.values()]
        if not HAS_FILES or not sum(sizes):
            return arrays
        try:
            size, offset, mapped, start = place = self._allocate(-(-sum(sizes) // PAGE) * PAGE)
            assert self._file is not None
            data = np.zeros(size, np.uint8)
            for array, at in zip(arrays.values(), np.cumsum([0, *sizes]).tolist(), strict=False):
                data[at : at + array.nbytes] = (
                    np.ascontiguousarray(array).reshape(-1).view(np.uint8)
                )
            self._file.write(data, offset)
        except OSError as error:
            _stays_in_memory(error)
            return arrays
        record = _Record(mapped, offset - start, size)
        weakref.finalize(record, self._free.append, place).atexit = False
        whole, begin, found = np.asarray(record), 0, {}
        for (name, array), length in zip(arrays.items(), sizes, strict=True):
            part = whole[begin : begin + array.nbytes]
            found[name] = part.view(array.dtype).reshape(array.shape)
            begin += length
        return found

    def release(self) -> None:
        """Give back the memory of what was read."""
        if self._file is not None:
            self._file.release()

    def _allocate(self, size: int) -> tuple[int, int, mmap.mmap, int]:
        """A free place: its size, offset, map, and where that map starts. Raises OSError."""
        fitting = [place for place in self._free if size <= place[0] <= 2 * size]
        if fitting:
            place = min(fitting, key=lambda place: place[:2])
            self._free.remove(place)
            return place
        if self._file is None:
            self._file = _File()
        if self._chunk is None or self._end + size > self._chunk[0] + len(self._chunk[1]):
            start = self._end
            self._file.grow(start + max(size, CHUNK, start // 2 // PAGE * PAGE))
            self._chunk = start, self._file.map(start)
        start, mapped = self._chunk
        self._end += size
        return size, self._end - size, mapped, start


class DiskRows:
    """A growing array (N, ...) of rows that are written alone.

    Attributes:
        rows: to be read; it is another array after ``grow`` and, if the disk is full, ``write``.
    """

    def __init__(self, count: int, shape: tuple[int, ...], dtype: Any) -> None:
        self.rows: NDArray = np.zeros((0, *shape), dtype)
        self._file: _File | None = None
        try:
            self._file = _File() if HAS_FILES else None
        except OSError as error:
            _stays_in_memory(error)
        self.grow(count)

    def grow(self, more: int) -> None:
        """Append so many rows of zeros."""
        count, old = len(self.rows) + more, self.rows
        if self._file is not None:
            size, shape = count * old.itemsize * _entries(old), (count, *old.shape[1:])
            try:
                self._file.grow(size)
                mapped = self._file.map(0)
            except OSError as error:
                self._leave_file(error)
            else:
                self.rows = np.frombuffer(mapped, old.dtype).reshape(shape)
                return
        self.rows = np.concatenate([self.rows, np.zeros((more, *old.shape[1:]), old.dtype)])

    def write(self, at: Ints, values: NDArray) -> None:
        """Set rows (M,), each given once, to values (M, ...), or one value to all."""
        if not len(at):
            return
        if self._file is not None:
            values = np.broadcast_to(values, (len(at), *self.rows.shape[1:]))
            order = np.argsort(at, kind="stable")
            values, sorted_at = np.ascontiguousarray(values[order], self.rows.dtype), at[order]
            starts = np.flatnonzero(np.diff(sorted_at, prepend=-2) != 1).tolist()
            row_bytes = self.rows.itemsize * _entries(self.rows)
            try:
                for begin, end in zip(starts, [*starts[1:], len(at)], strict=True):
                    self._file.write(values[begin:end], int(sorted_at[begin]) * row_bytes)
                return
            except OSError as error:
                self._leave_file(error)
                at = sorted_at
        self.rows[at] = values

    def release(self) -> None:
        """Give back the memory of what was read."""
        if self._file is not None:
            self._file.release()

    def _leave_file(self, error: OSError) -> None:
        _stays_in_memory(error)
        self._file, self.rows = None, np.array(self.rows)


def concatenated(pieces: Iterable[NDArray], rows: int, like: NDArray) -> NDArray:
    """Arrays, of so many rows in all and the form of another, one after the other.

    A large result lies on the disk and cannot be changed.
    """
    if not rows or rows * like.itemsize * _entries(like) < CHUNK:
        return np.concatenate([like[:0], *pieces], dtype=like.dtype)
    result, begin = DiskRows(rows, like.shape[1:], like.dtype), 0
    for piece in pieces:
        result.write(np.arange(begin, begin + len(piece)), piece)
        begin += len(piece)
    return result.rows


def _entries(rows: NDArray) -> int:
    return int(np.prod(rows.shape[1:]))
