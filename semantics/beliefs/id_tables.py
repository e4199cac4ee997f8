"""Tables with a row for each id that something is known of, however large ids become."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Ints, Mask, distinct


class IdTables:
    """Arrays as attributes, with rows in the order of ``_ids``, which ascend.

    Ids of landmarks are never used twice, and most landmarks are removed again, so that arrays by
    id would grow for as long as a session lasts. A subclass sets ``_ids`` and the arrays, without
    rows; ``TABLES`` has their names, and how a row is joined with that of the same thing (None: it
    is forgotten).
    """

    TABLES: ClassVar[Mapping[str, np.ufunc | None]]
    _ids: Ints

    def move(self, from_ids: Ints, to_ids: Ints) -> None:
        """Add all views of from_ids (N,) to those of to_ids (N,): each pair is one thing."""
        known, rows = self._found(from_ids)
        gained = [getattr(self, name)[rows] for name in self.TABLES]
        self.drop(from_ids)
        to = self._rows(to_ids[known])
        for (name, join), values in zip(self.TABLES.items(), gained, strict=True):
            if join is not None:
                join.at(getattr(self, name), to, values)

    def drop(self, ids: Ints) -> None:
        """Forget ids (N,)."""
        rows = self._found(ids)[1]
        if len(rows):
            self._ids = np.delete(self._ids, rows)
            for name in self.TABLES:
                setattr(self, name, np.delete(getattr(self, name), rows, axis=0))

    def _of(self, table: NDArray[Any], ids: Ints) -> NDArray[Any]:
        """A table's rows (N, ...) of any ids (N,); zeros where there is none."""
        values = np.zeros((len(ids), *table.shape[1:]), table.dtype)
        found, rows = self._found(ids)
        values[found] = table[rows]
        return values

    def _found(self, ids: Ints) -> tuple[Mask, Ints]:
        """Which of any ids (N,) have a row, and the rows (M,) of those."""
        rows = np.searchsorted(self._ids, ids)
        found: Mask = rows < len(self._ids)
        found[found] = self._ids[rows[found]] == ids[found]
        return found, rows[found]

    def _rows(self, ids: Ints) -> Ints:
        """Rows (N,) of ids (N,), which may repeat; those that have none get one of zeros."""
        new = distinct(ids[~self._found(ids)[0]])
        if len(new):
            at = np.searchsorted(self._ids, new)
            self._ids = np.insert(self._ids, at, new)
            for name in self.TABLES:
                setattr(self, name, np.insert(getattr(self, name), at, 0, axis=0))
        return np.searchsorted(self._ids, ids)
