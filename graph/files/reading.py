"""Files from elsewhere, read in bounds: plain files of a size, lines and tables of a length.

A file may come from a stranger: it may be a pipe that never ends, or hold bytes that are no UTF-8
or one line of a gigabyte. Every reader of text begins here.
"""

from __future__ import annotations

import csv
import errno
import io
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from bmask_slam.graph.errors import InputError

MAX_BYTES = 1 << 30
MAX_TEXT_BYTES = 1 << 28
MAX_LINE = 1 << 16
NOT_THE_FILE = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EIO)
"""Errors of the machine; another file would fail as well."""
SMALL_BYTES, MAX_RATIO = 1 << 28, 100
"""A file may unpack to so many bytes, or to so many times its own."""


def in_short(error: BaseException) -> str:
    """What an error says, on one short line; what a file holds may be in it at any length."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def check_unpacked(unpacked: int, packed: int) -> None:
    """Refuse what unpacks to far more bytes than it takes packed. Raises ValueError."""
    if unpacked > max(SMALL_BYTES, MAX_RATIO * packed):
        raise ValueError(f"{packed} bytes that unpack to {unpacked} or more")


def read_bytes(path: Path, cure: str, limit: int = MAX_BYTES) -> bytes:
    """The content of a plain file.

    Raises:
        InputError: no such file, a folder or a device, one that cannot be read, or one that is
            larger than ``limit`` bytes; the line ends with the ``cure``.
        OSError: the machine has no descriptors or memory left, or its disk fails.
    """
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise InputError(f"{path}: is no plain file; {cure}")
            if found.st_size > limit:
                raise InputError(
                    f"{path}: {found.st_size / 1e9:.1f} GB, more than {limit / 1e9:.2g} GB; {cure}"
                )
            return file.read()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; {cure}") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        if isinstance(error, OSError) and error.errno in NOT_THE_FILE:
            error.filename = error.filename or str(path)  # which reading does not say
            raise
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({reason}); {cure}") from error


def _without_waiting(path: str, flags: int) -> int:
    """Open a file; a pipe without a writer does not make the program wait."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def read_text(path: Path, cure: str, limit: int = MAX_TEXT_BYTES) -> str:
    """The content of a text file; bytes that are no UTF-8 are replaced.

    Raises:
        InputError: as ``read_bytes``.
    """
    return read_bytes(path, cure, limit).decode("utf-8-sig", errors="replace")


def read_lines(path: Path, cure: str, comments: bool = False) -> Iterator[tuple[int, str]]:
    """Number and stripped text of each line that is not empty, nor, unless asked, a # comment.

    Raises:
        InputError: as ``read_bytes``, or a line of more than 65 536 characters.
    """
    lines = io.StringIO(read_text(path, cure), newline=None)
    for number, line in enumerate(lines, start=1):
        if len(line) > MAX_LINE:
            raise InputError(f"{path}:{number}: a line of {len(line)} characters; {cure}")
        text = line.strip()
        if text and (comments or not text.startswith("#")):
            yield number, text


def read_table(
    path: Path, needed: tuple[str, ...], cure: str, growing: bool = False
) -> dict[str, tuple[str, ...]]:
    """The columns of a csv file as texts by name; of a ``growing`` one without a line cut off.

    Raises:
        InputError: as ``read_bytes``, a needed column that is missing, or a line of another length.
    """
    text = read_text(path, cure)
    whole = text[: text.rfind("\n") + 1] if growing else text
    try:
        header, *rows = list(csv.reader(io.StringIO(whole, newline=""))) or [[]]
    except csv.Error as error:
        raise InputError(f"{path}: no table ({error}); {cure}") from error
    missing = [name for name in needed if name not in header]
    if missing or any(len(row) != len(header) for row in rows):
        what = f"no column {missing[0]}" if missing else "a line with too few or too many values"
        raise InputError(f"{path}: {what}; {cure}")
    columns = zip(*rows, strict=True) if rows else [()] * len(header)
    return dict(zip(header, columns, strict=True))
