"""The one place that imports Open3D."""

from __future__ import annotations

import ctypes
from functools import cache
from types import ModuleType

from bmask_slam.graph.extras import import_extra


@cache
def load_open3d() -> ModuleType:
    """Import Open3D, with its dependency libusb-1.0 taken from the wheel ``libusb_package``.

    Raises:
        InputError: the pip extra "render" is not installed.

    Open3D's shared library links to ``libusb-1.0.so.0``, which small machines do not have. A
    library of that name that is already loaded with global symbols satisfies the linker.
    """
    libusb_package = import_extra("libusb_package", "rendering", "render")
    library = libusb_package.get_library_path()
    if library is not None:
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    return import_extra("open3d", "rendering", "render")
