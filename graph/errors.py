"""The exception for broken input from outside."""

import math


class InputError(Exception):
    """Broken input from outside: the message names the file, the value and the cure.

    The command line prints it as one line and exits with 1. Expected failures of the
    method (tracking lost, a factor refused) are results with a status, never exceptions.
    """


def finite_number(text: str, where: str) -> float:
    """The finite number in a word; ``where`` is its file and line, for the message."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(
            f"{where}: {text[:40]!r} is not a finite number; correct or remove the line"
        )
    return number
