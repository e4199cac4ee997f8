"""The one place that imports Open3D."""

from __future__ import annotations

from functools import cache
from types import ModuleType

from bmask_slam.graph.extras import import_extra, load_libusb


@cache
def load_open3d() -> ModuleType:
    """Import Open3D, with its dependency libusb-1.0 taken from the wheel ``libusb_package``.

    Raises:
        InputError: the pip extra "render" is not installed.
    """
    import_extra("libusb_package", "rendering", "render")
    load_libusb()
    return import_extra("open3d", "rendering", "render")
