"""Standard input, output and errors that are closed, or whose terminal or reader is gone."""

from __future__ import annotations

import errno
import io
import os
import sys
from contextlib import suppress

LAST = 2
"""The number of the last standard stream, that of errors."""


def has_stream(number: int) -> bool:
    """Whether this program was started with it; else its number may be any file's by now."""
    return (sys.__stdin__, sys.__stdout__, sys.__stderr__)[number] is not None


def copy_of_stream(number: int) -> int:
    """A copy of a standard stream; of nothing, where the owner has none."""
    if has_stream(number):
        with suppress(OSError):  # it is closed meanwhile
            return os.dup(number)
    return os.open(os.devnull, os.O_WRONLY)


def prepare_streams() -> None:
    """Let those that this program was started without lead nowhere.

    Else the next files that are opened would have their numbers, and get what libraries print. A
    letter that the output's encoding does not have is printed as its code.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
    if None not in (sys.stdin, sys.stdout, sys.stderr):
        return
    while (nowhere := os.open(os.devnull, os.O_RDWR)) <= LAST:
        os.set_inheritable(nowhere, True)
    sys.stdin = sys.stdin or os.fdopen(nowhere, encoding="utf-8", closefd=False)
    sys.stdout = sys.stdout or os.fdopen(nowhere, "w", encoding="utf-8", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(nowhere, "w", encoding="utf-8", closefd=False)


def discard_output() -> None:
    """Let the rest of what was printed go nowhere: the end of Python would fail to write it."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in filter(None, (sys.stdout, sys.stderr)):
        with suppress(OSError, ValueError):  # it is no file, as in a notebook
            os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def is_terminal_closed() -> bool:
    """Whether output goes to a terminal that is gone: it cannot even be asked for its settings."""
    import termios  # noqa: PLC0415 - Unix only

    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            termios.tcgetattr(stream.fileno())
        except termios.error as error:
            if error.args[0] == errno.EIO:
                return True
        except (OSError, ValueError):  # it is no file
            continue
    return False
