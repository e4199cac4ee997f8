"""Files and folders that appear whole or not at all.

A temporary one is made beside the target, under a name that cannot be guessed and with O_EXCL, so
that a link that lies in the folder is never followed; it is renamed to the target in the end.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_lock import take_lock

PREFIX = ".part-"
UNLOCKED_S = 10.0
"""The longest time from the making of a folder to its lock."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """An empty temporary file beside ``path``, of the same suffix, to write the content to.

    It takes the place of ``path``, of the link itself if that is one, when the block ends well,
    and is removed when it does not.

    Raises:
        InputError: ``path`` is a folder.
    """
    if path.is_dir() and not path.is_symlink():
        raise _is_folder(path)
    temporary = _temporary(path)
    with _named(path, temporary):
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        try:
            yield temporary
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def _named(path: Path, temporary: Path) -> Iterator[None]:
    """In errors of the block, the file that is to be in place of the temporary one.

    A full disk names none when it is written to.
    """
    try:
        yield
    except InputError as error:
        if str(temporary) not in str(error):
            raise
        raise InputError(str(error).replace(str(temporary), str(path))) from error
    except OSError as error:
        for which in ("filename", "filename2"):
            name = str(getattr(error, which))
            if name.startswith(str(temporary)):
                setattr(error, which, f"{path}{name.removeprefix(str(temporary))}")
        if error.filename is None and error.errno in DISK_FULL:
            error.filename = str(path)
        raise


@contextmanager
def writing(path: Path, cure: str = "free some space, or change its permissions") -> Iterator[None]:
    """For a block that writes ``path``.

    Raises:
        InputError: it cannot be written; the text gives the reason and the cure.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot be written ({reason}); {cure}") from error


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """An empty temporary folder beside ``path``; else as ``whole_file``."""
    with folder_beside(path) as temporary:
        yield temporary
        remove(path)
        os.replace(temporary, path)


@contextmanager
def folder_beside(path: Path, prefix: str = PREFIX) -> Iterator[Path]:
    """An empty temporary folder beside ``path``, which is removed at the end if it is still there.

    What killed processes left behind for the same ``path`` is removed at the beginning: the lock of
    a folder tells whether its process lives.
    """
    prefix = f"{prefix}{zlib.crc32(os.fsencode(path.name)):08x}-"
    for left in path.parent.glob(f"{prefix}*"):
        _remove_abandoned(left)
    temporary = path.with_name(f"{prefix}{secrets.token_hex(8)}")
    with _named(path, temporary):
        temporary.mkdir()
        try:
            with _locked(temporary):
                yield temporary
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _remove_abandoned(folder: Path) -> None:
    """Remove a folder that no process has locked; a young one may be about to be locked."""
    with suppress(OSError):  # gone by now, or another user's
        if time.time() - folder.lstat().st_mtime > UNLOCKED_S:
            with _locked(folder) as is_mine:
                if is_mine:
                    shutil.rmtree(folder)


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Lock a folder, but no link; False where it is locked already, or nothing can be locked."""
    if sys.platform == "win32":
        yield False
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        is_locked = False
        with suppress(OSError):  # a file system without locks
            is_locked = take_lock(descriptor)
        yield is_locked
    finally:
        os.close(descriptor)


def open_plain(path: Path, mode: str) -> IO[Any]:
    """Open a file in place to write to it, one that grows or is locked; never through a link.

    Text is UTF-8 with the line breaks that are written.

    Raises:
        InputError: the file is a link, or OSError: it cannot be written.
    """
    encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
    try:
        return open(path, mode, encoding=encoding, newline=newline, opener=_not_through_links)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise InputError(f"{path}: is a link; nothing is written through it, remove it") from error


def _not_through_links(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def remove(path: Path) -> None:
    """Remove a file, a folder with all that is in it, or a link, but nothing that it leads to."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def remove_partial(folder: Path) -> None:
    """Remove the temporary files and folders that a killed process left in a folder."""
    for path in folder.glob(f"{PREFIX}*"):
        remove(path)


def check_target(path: Path) -> None:
    """Raise InputError if a file cannot be made there, before the work of which it is the result.

    ``path`` is a folder, or a link to one, or there is no folder for it.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} is not there; make it first")
    if path.is_dir():
        raise _is_folder(path)


def _is_folder(path: Path) -> InputError:
    return InputError(f"{path}: is a folder; give the name of a file to write")


def _temporary(path: Path) -> Path:
    return path.with_name(f"{PREFIX}{secrets.token_hex(8)}{path.suffix}")
