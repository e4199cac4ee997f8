"""Sums of the rows of an array by group, as normal equations need them."""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse import csr_array

from bmask_slam.graph.arrays import Array, Ints


class GroupSums:
    """Adds up rows (M, ...) of the same group, one of ``count`` for each row (M,)."""

    def __init__(self, groups: Ints, count: int) -> None:
        rows = np.arange(len(groups))
        self._chosen = csr_array((np.ones(len(rows)), (groups, rows)), shape=(count, len(rows)))

    def __call__(self, rows: Array) -> Array:
        """Sums (count, ...) of the rows (M, ...)."""
        sums = self._chosen @ rows.reshape(len(rows), math.prod(rows.shape[1:]))
        return np.asarray(sums).reshape(len(sums), *rows.shape[1:])
