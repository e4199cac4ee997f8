"""Loops over pixels and voxels, compiled by numba."""

from __future__ import annotations

from collections.abc import Callable

import numba


def compiled(function: Callable) -> Callable:
    """The function compiled when it is first called; kept on disk where there is a place for it.

    It divides as numpy does: by 0 to inf or NaN. What was kept is used as long as the file of the
    function stays the same, whatever changes here.
    """
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # neither beside the source nor in the user's cache
        return numba.njit(nogil=True, error_model="numpy")(function)
