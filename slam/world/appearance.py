"""What landmarks look like: columns that only landmarks in the map have, since most are removed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.features.patch_alignment import PATCH_PX
from bmask_slam.graph.arrays import Array, Image, Ints
from bmask_slam.graph.files.disk_arrays import DiskRows

PATCHES = 4  # of a landmark: views from one walk past it, of which each patch serves a range
Columns = dict[str, tuple[tuple[int, ...], type, float]]  # shape of a row, type, value of new rows

APPEARANCE: Columns = {
    "descriptors": ((8,), np.uint64, 0),
    "directions": ((3,), np.float64, 0.0),
    "extent": ((), np.float64, 0.0),
    "angles_rad": ((), np.float64, 0.0),
    "colours": ((3,), np.uint8, 0),
    "patches": ((PATCHES, PATCH_PX, PATCH_PX), np.uint8, 0),
    "patch_views": ((PATCHES, 3), np.float64, np.nan),
}
ON_DISK = "patches"  # 1.2 of the 1.4 kB of a row


@dataclass
class Revisions:
    """When each row (R,) was last written, by a count that rises whenever a reader asks."""

    rows: Ints = field(default_factory=lambda: np.zeros(1, np.int32))
    now: int = 1


class Appearance:
    """A column over landmark ids that has rows only for landmarks in the map.

    Row 0 is a placeholder for all removed landmarks: it stays zero when it is written.
    """

    def __init__(self, column: NDArray | DiskRows, row: Ints, revisions: Revisions) -> None:
        self._column, self._row_of, self._revisions = column, row, revisions

    @property
    def _rows(self) -> NDArray:
        column = self._column
        return column.rows if isinstance(column, DiskRows) else column

    def __len__(self) -> int:
        return len(self._row_of)

    def __getitem__(self, ids: Any) -> NDArray:
        return self._rows[self._row_of[ids]]

    def __setitem__(self, ids: Any, values: Any) -> None:
        column = self._column
        self._revisions.rows[self._row_of[ids]] = self._revisions.now
        if isinstance(column, DiskRows):
            at = np.atleast_1d(self._row_of[ids])
            values = np.broadcast_to(values, (len(at), *column.rows.shape[1:]))
            column.write(at[at > 0], values[at > 0])
            return
        placeholder = column[0].copy()
        column[self._row_of[ids]] = values
        column[0] = placeholder

    def pick(self, ids: Ints, which: Ints) -> NDArray:
        """Entry which[k] of the row of ids[k]."""
        return self._rows[self._row_of[ids], which]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        return np.array(self._rows[self._row_of], dtype)


@dataclass(frozen=True, eq=False)
class Patches:
    """Image patches of some landmarks, for sub-pixel registration; see LandmarkTable.

    Attributes:
        images: (N, PATCHES, 17, 17) uint8.
        views: (N, PATCHES, 3) m, NaN where there is none.
    """

    images: Image
    views: Array

    def __getitem__(self, rows: Any) -> Patches:
        return Patches(self.images[rows], self.views[rows])


class AppearanceTable:
    """The rows of the appearance of all landmarks in the map; rows that are free are used again.

    Row 0 is a placeholder. Image patches lie on the disk, the other columns in memory.

    Attributes:
        revisions: of the rows.
    """

    def __init__(self) -> None:
        self._columns: dict[str, NDArray | DiskRows] = {
            name: DiskRows(1, shape, dtype) if name == ON_DISK else filled(1, column)
            for name, column in APPEARANCE.items()
            for shape, dtype, _ in (column,)
        }
        self.revisions = Revisions()
        self._free: list[int] = []

    def __len__(self) -> int:
        """Number of rows, also of those that are free."""
        column = self._columns[ON_DISK]
        return len(column.rows if isinstance(column, DiskRows) else column)

    def views(self, row: Ints) -> dict[str, Appearance]:
        """The columns by name, over landmark ids (N,) whose rows are given."""
        return {
            name: Appearance(column, row, self.revisions) for name, column in self._columns.items()
        }

    def reserve(self, count: int) -> bool:
        """Make room for so many more landmarks; whether the columns are other ones now."""
        missing, capacity = count - len(self._free), len(self)
        if missing <= 0:
            return False
        more = max(missing, capacity // 4)  # a row takes 1.4 kB
        for name, column in self._columns.items():
            if isinstance(column, DiskRows):
                column.grow(more)
            else:
                new = filled(more, APPEARANCE[name])
                self._columns[name] = np.concatenate([column, new])
        known = self.revisions.rows
        self.revisions.rows = np.concatenate([known, np.zeros(more, known.dtype)])
        self._free += range(capacity + more - 1, capacity - 1, -1)
        return True

    def take(self, count: int) -> Ints:
        """So many free rows."""
        rows = np.array(self._free[len(self._free) - count :][::-1], np.int64)
        del self._free[len(self._free) - count :]
        return rows

    def clear(self, rows: Ints) -> None:
        """Free rows (M,), each given once, and set them to what new ones hold."""
        for name, column in self._columns.items():
            if isinstance(column, DiskRows):
                column.write(rows, np.zeros((), np.uint8))
            else:
                column[rows] = APPEARANCE[name][2]
        self._free += rows[::-1].tolist()

    def release_memory(self) -> None:
        """Give back the memory of what was read from the disk."""
        for column in self._columns.values():
            if isinstance(column, DiskRows):
                column.release()


def filled(count: int, column: tuple[tuple[int, ...], type, float]) -> NDArray:
    """So many new rows of a column."""
    shape, dtype, fill = column
    return np.full((count, *shape), fill, dtype)
