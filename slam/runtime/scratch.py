"""Temporary folders of processes, also of those that are killed."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bmask_slam.graph.files.file_lock import take_lock

_PREFIX, _LOCK = "bmask-slam-scratch-", "in-use"


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A new temporary folder, which is removed at the end.

    Those that killed processes left behind are removed at the beginning: the lock of a file in the
    folder tells whether its process lives.
    """
    _remove_abandoned()
    with tempfile.TemporaryDirectory(prefix=_PREFIX, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        with (folder / f"{_LOCK}.new").open("w", encoding="utf-8") as file:
            take_lock(file)
            (folder / f"{_LOCK}.new").rename(folder / _LOCK)  # locked by the time it can be seen
            yield folder


def _remove_abandoned() -> None:
    if sys.platform == "win32":  # it has no locks
        return
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):  # gone by now, or another user's
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            with (folder / _LOCK).open("r+", encoding="utf-8") as file:
                if take_lock(file):
                    shutil.rmtree(folder, ignore_errors=True)
