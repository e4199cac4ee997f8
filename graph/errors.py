"""The exception for broken input from outside."""

import difflib
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

MAX_MESSAGE = 2000
MAX_LINE = 450
"""Characters of a line that a user is shown: what a file holds may be of any length."""


class InputError(Exception):
    """Broken input from outside: the message names the file, the value and the cure.

    The command line prints it as one line and exits with 1. Expected failures of the
    method (tracking lost, a factor refused) are results with a status, never exceptions.
    What a file holds may be of any length: of a long message the middle is left out.
    """

    def __init__(self, message: str = "") -> None:
        if len(message) > MAX_MESSAGE:
            message = f"{message[: MAX_MESSAGE // 2]} ... {message[-MAX_MESSAGE // 2 :]}"
        super().__init__(message)


@contextmanager
def naming(where: str, cure: str = "") -> Iterator[None]:
    """Put ``where`` before, and a ``cure`` after, what an InputError of the block says."""
    try:
        yield
    except InputError as error:
        raise InputError("; ".join(filter(None, (f"{where}: {error}", cure)))) from error


def one_line(message: str) -> str:
    """A message as a line of at most ``MAX_LINE`` characters."""
    line = " ".join(message.split())
    return line if len(line) <= MAX_LINE else f"{line[: MAX_LINE - 3]}..."


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: "; did you mean X?", or "" if none is near."""
    near = difflib.get_close_matches(word[:MAX_NAME], list(known), 1, 0.6)
    return f"; did you mean {near[0]}?" if near else ""


MAX_NAME = 100
MAX_NUMBER = 1e100
"""Largest number in a text file: its square is a number too."""
MAX_WHOLE = 2**63 - 1


def finite_number(text: str, where: str) -> float:
    """The finite number in a word; ``where`` is its file and line, for the message."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) <= MAX_NUMBER:
        raise InputError(
            f"{where}: {text[:40]!r} is not a finite number; correct or remove the line"
        )
    return number


def is_whole(text: str) -> bool:
    """Whether a word is a whole number from 0 to 2^63 - 1."""
    return text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= MAX_WHOLE


def whole_number(text: str, where: str) -> int:
    """The whole number, from 0 on, in a word; ``where`` is its file and line, for the message."""
    if not is_whole(text):
        raise InputError(
            f"{where}: {text[:40]!r} is not a whole number from 0 on; correct or remove the line"
        )
    return int(text)
