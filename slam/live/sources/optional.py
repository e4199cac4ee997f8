"""Libraries that only some sources need."""

from __future__ import annotations

import importlib
from types import ModuleType

from bmask_slam.graph.errors import InputError


def import_optional(name: str, extra: str, source: str) -> ModuleType:
    """A module of a library that the pip extra installs.

    Raises:
        InputError: it is not installed; names the source that needs it and the cure.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"{source}: needs {name.partition('.')[0]} ({error}); pip install 'bmask-slam[{extra}]'"
        ) from error
