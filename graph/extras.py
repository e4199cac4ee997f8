"""Libraries that only some tasks need, which pip extras install."""

from __future__ import annotations

import importlib
from types import ModuleType

from bmask_slam.graph.errors import InputError


def import_extra(name: str, needed_by: str, extra: str, instead: str = "") -> ModuleType:
    """A module of a library that the pip extra ``extra`` installs.

    Raises:
        InputError: it is not installed. The text begins with ``needed_by``, a source or a task,
            and gives the command that installs it, and ``instead``, what else can be done.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        library = name.partition(".")[0]
        text = f"{needed_by}: needs {library}, which is not installed ({error.msg})"
        cure = f"pip install 'bmask-slam[{extra}]'"
        raise InputError(f"{text}; {cure}{f', or {instead}' if instead else ''}") from error
