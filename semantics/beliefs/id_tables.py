"""Tables with a row for each id that something is known of, however large ids become."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from bmask_slam.graph.arrays import Ints, Mask


class IdTables:
    """Arrays as attributes whose names are in ``TABLES``, with rows in the order of ``_ids``.

    Ids of landmarks are never used twice, and most landmarks are removed again, so that arrays by
    id would grow for as long as a session lasts. A subclass sets the arrays, without rows.
    """

    TABLES: ClassVar[tuple[str, ...]]

    def __init__(self) -> None:
        self._ids: Ints = np.zeros(0, np.int64)

    def _found(self, ids: Ints) -> tuple[Mask, Ints]:
        """Which of any ids (N,) have a row, and the rows (M,) of those."""
        rows = np.searchsorted(self._ids, ids)
        found: Mask = rows < len(self._ids)
        found[found] = self._ids[rows[found]] == ids[found]
        return found, rows[found]

    def _rows(self, ids: Ints) -> Ints:
        """Rows (N,) of ids (N,), which may repeat; those that have none get one of zeros."""
        new = np.unique(ids[~self._found(ids)[0]])
        if len(new):
            at = np.searchsorted(self._ids, new)
            self._ids = np.insert(self._ids, at, new)
            for name in self.TABLES:
                setattr(self, name, np.insert(getattr(self, name), at, 0, axis=0))
        return np.searchsorted(self._ids, ids)

    def _remove(self, ids: Ints) -> None:
        """Remove the rows of those ids (N,) that have one."""
        rows = self._found(ids)[1]
        if len(rows):
            self._ids = np.delete(self._ids, rows)
            for name in self.TABLES:
                setattr(self, name, np.delete(getattr(self, name), rows, axis=0))
