"""The one exception that stands for broken input; everything else is a bug or a result."""


class InputError(Exception):
    """Broken input from outside: the text names the file, the value and the cure.

    The command line prints it as one line and exits with 1. Expected failures of the
    method (tracking lost, a factor refused) are results with a status, never exceptions.
    """
