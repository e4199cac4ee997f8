"""Tables that grow by lines while a run goes on, such as frames.csv and events.csv."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from io import TextIOWrapper
from pathlib import Path
from typing import IO

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_lock import lock_file
from bmask_slam.graph.files.whole_file import whole_file

NO_TEXT = "backslashreplace"
"""How a file holds what is no text, such as a path in Latin-1."""


class GrowingTable:
    """A csv file to which lines are appended; each is flushed, so that a kill leaves whole lines.

    Attributes:
        file: as it was opened.
    """

    def __init__(self, path: Path, columns: tuple[str, ...], mode: str) -> None:
        """Open a file, in mode "x" a new one, in mode "a" one that may be there; OSError if not."""
        self._columns, self._is_locked = columns, False
        self._go_on(path.open(f"{mode}+", encoding="utf-8", errors=NO_TEXT, newline=""))

    def _go_on(self, file: IO[str]) -> None:
        self.file = file
        self._rows = csv.DictWriter(file, self._columns, lineterminator="\n")

    @property
    def is_removed(self) -> bool:
        """Whether the file has no name any more."""
        return os.fstat(self.file.fileno()).st_nlink == 0

    def lock(self, folder: Path) -> None:
        """Lock the file until it is closed. Raises InputError if another process holds the lock."""
        lock_file(self.file, folder)
        self._is_locked = True

    def restore(self, path: Path) -> None:
        """Write all lines to a new file, and go on there.

        Raises:
            OSError: it cannot be written whole; there is no new file, and the old one is kept open.
        """
        old = self.file
        self._go_on(written_again(old, path, self._is_locked))
        old.close()

    def begin(self, size: int) -> None:
        """Cut the file to its first bytes; one that is empty then gets its header."""
        self.file.flush()
        self.file.truncate(size)
        self.file.seek(0, os.SEEK_END)
        if not size:
            self._rows.writeheader()
            self.file.flush()

    def append(self, rows: Iterable[Mapping[str, object]]) -> None:
        """Append lines. Raises ValueError for an unknown column."""
        self._rows.writerows(rows)
        self.file.flush()

    def synced_bytes(self) -> int:
        """Write the file to disk; its size in bytes."""
        os.fsync(self.file.fileno())
        return os.fstat(self.file.fileno()).st_size

    def close(self) -> None:
        """Close the file."""
        self.file.close()


def written_again(file: IO[str], path: Path, is_locked: bool = False) -> TextIOWrapper:
    """A new file, open at its end, with all that an open UTF-8 file holds, also a removed one.

    Raises:
        OSError: it cannot be written whole; there is no new file then.
        InputError: another process holds the lock.
    """
    with whole_file(path) as temporary:
        new = temporary.open("w+", encoding="utf-8", errors=NO_TEXT, newline="")
        try:
            new.write(_contents(file))
            new.flush()
            os.fsync(new.fileno())
            if is_locked:
                lock_file(new, path.parent)
        except BaseException:
            with suppress(OSError):
                new.close()
            raise
    return new


def _contents(file: IO[str]) -> str:
    """The whole text of an open UTF-8 file, with what is buffered."""
    file.flush()
    size = os.fstat(file.fileno()).st_size
    return os.pread(file.fileno(), size, 0).decode(errors="replace")


def check_grown(path: Path, columns: tuple[str, ...], size: int) -> None:
    """Raise InputError if a file is shorter than at the checkpoint, or has other columns.

    Size 0 stands for a file that the version which wrote the checkpoint did not have.
    """
    if not size:
        return
    header, found = ",".join(columns), b""
    if path.is_file():
        found = path.read_bytes()[: max(size, 0)]
    if len(found) < size or found.partition(b"\n")[0] != header.encode():
        raise InputError(
            f"{path}: not the file of the checkpoint, which has at least {size} bytes and the "
            f"columns {header}; start the run again with --overwrite"
        )
