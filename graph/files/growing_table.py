"""Tables that grow by lines while a run goes on, such as frames.csv and events.csv."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from bmask_slam.graph.errors import InputError


class GrowingTable:
    """A csv file to which lines are appended; each is flushed, so that a kill leaves whole lines.

    Attributes:
        file: as it was opened.
    """

    def __init__(self, path: Path, columns: tuple[str, ...], mode: str) -> None:
        """Open a file, in mode "x" a new one, in mode "a" one that may be there; OSError if not."""
        self.file = path.open(mode, encoding="utf-8", newline="")
        self._rows = csv.DictWriter(self.file, columns, lineterminator="\n")

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
