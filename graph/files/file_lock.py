"""The lock of an open file, which its process holds as long as it lives."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import IO, Any

from bmask_slam.graph.errors import InputError


def take_lock(file: IO[Any] | int) -> bool:
    """Lock an open file, or a folder, until it is closed, or its process is killed.

    False if another process holds the lock. Windows has no such locks: always True there.
    """
    if sys.platform == "win32":
        return True
    import fcntl  # noqa: PLC0415 - Unix only

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def lock_file(file: IO[Any], folder: Path) -> None:
    """Lock a file until it is closed. Raises InputError if another process holds the lock."""
    if not take_lock(file):
        raise InputError(
            f"{folder}: a process is writing a run there; wait for it, or choose another --out"
        )
