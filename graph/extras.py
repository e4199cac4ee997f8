"""Libraries that only some tasks need, which pip extras install."""

from __future__ import annotations

import ctypes
import importlib
from importlib.util import find_spec
from types import ModuleType

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import in_short


def import_extra(name: str, needed_by: str, extra: str, instead: str = "") -> ModuleType:
    """A module of a library that the pip extra ``extra`` installs.

    Raises:
        InputError: it is not installed, or cannot be loaded. The text begins with ``needed_by``, a
            source or a task, and gives the command that installs it, and ``instead``, what else
            can be done.
    """
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as error:  # OSError: a shared library that is not there
        library = name.partition(".")[0]
        missing = isinstance(error, ModuleNotFoundError) and error.name == library
        what = "which is not installed" if missing else "which cannot be loaded"
        text = f"{needed_by}: needs {library}, {what} ({in_short(error)})"
        cure = f"pip install 'bmask-slam[{extra}]'"
        if not missing:
            cure = f"remove it, and {cure}"
        raise InputError(f"{text}; {cure}{f', or {instead}' if instead else ''}") from error


def check_extra(name: str, needed_by: str, extra: str, instead: str = "") -> None:
    """As ``import_extra``, of a library that another process will load: whether it is installed.

    Raises:
        InputError: it is not.
    """
    if find_spec(name) is None:
        import_extra(name, needed_by, extra, instead)


def import_dense(needed_by: str) -> None:
    """Import what a dense map needs. Raises InputError as ``import_extra``."""
    for library in ("torch", "numba"):
        import_extra(library, needed_by, "dense")


def load_libusb() -> None:
    """Load libusb-1.0 of the wheel ``libusb_package``, if that is installed.

    Libraries link to ``libusb-1.0.so.0``, which small machines do not have. A library of that name
    that is already loaded with global symbols satisfies the linker.
    """
    try:
        path = importlib.import_module("libusb_package").get_library_path()
    except ImportError:
        return
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
