"""The graph in numpy: every factor by id, the current values, and each factor's slot in ISAM2.

ISAM2 is corrupt after a failure and cannot be saved; these tables can always be read, saved and
made into a new ISAM2. What may enter is decided in `graph.smoother.validation`, what must be
removed in `graph.smoother.removal`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, Mask, distinct, no_ids
from bmask_slam.graph.factors.graph_update import (
    PARTIAL,
    Observations,
    PosePrior,
    RelativePose,
    concatenate,
)
from bmask_slam.graph.factors.marginalised_landmarks import MarginalisedLandmarks
from bmask_slam.graph.inertial.tables import InertialTables

NO_SLOT = -1


def ids_array(ids: Iterable[int]) -> Ints:
    """Sorted distinct ids as an int64 array."""
    return np.array(sorted(set(ids)), np.int64)


class ValueTable:
    """Sorted ids with one array value each: a pose (4, 4) or a point (3,)."""

    def __init__(self, *shape: int) -> None:
        self.ids: Ints = no_ids()
        self.values: Array = np.zeros((0, *shape))

    @classmethod
    def of(cls, ids: Ints, values: Array) -> ValueTable:
        """A table of sorted ids (N,) and their values (N, ...)."""
        table = cls()
        table.ids, table.values = ids, values
        return table

    def contains(self, ids: Ints) -> Mask:
        """Mask (N,) of the ids that are in the table."""
        if not len(self.ids):
            return np.zeros(len(ids), bool)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return self.ids[at] == ids

    def get(self, ids: Ints) -> Array:
        """Values (N, ...) of ids that must be in the table."""
        return self.values[np.searchsorted(self.ids, ids)]

    def insert(self, ids: Ints, values: Array) -> None:
        """Add ids that must not be in the table yet."""
        merged = np.concatenate([self.ids, np.asarray(ids, np.int64)])
        order = np.argsort(merged, kind="stable")
        self.ids = merged[order]
        self.values = np.concatenate([self.values, values])[order]

    def remove(self, ids: Ints) -> None:
        """Remove ids; those that are not in the table are ignored."""
        keep = ~np.isin(self.ids, ids)
        self.ids, self.values = self.ids[keep], self.values[keep]


class ObservationTable:
    """Observations in growing columns; an observation keeps its row until it is removed.

    ``of_keyframe[k]`` maps landmark id to row and ``of_landmark[l]`` keyframe id to row, so
    that every removal touches only its own rows. Freed rows are used again.
    """

    def __init__(self) -> None:
        self.of_keyframe: dict[int, dict[int, int]] = {}
        self.of_landmark: dict[int, dict[int, int]] = {}
        self._free: list[int] = []
        self._columns = Observations()
        self._slots: Ints = no_ids()
        self._used = 0

    def __len__(self) -> int:
        return self._used - len(self._free)

    def add(self, observations: Observations) -> Ints:
        """Add observations; returns their rows (M,)."""
        rows = self._allocate(len(observations))
        self._columns.keyframe_ids[rows] = observations.keyframe_ids
        self._columns.landmark_ids[rows] = observations.landmark_ids
        self._columns.measurements[rows] = observations.measurements
        self._columns.sigmas_px[rows] = observations.sigmas_px
        self._slots[rows] = NO_SLOT
        for (keyframe, landmark), row in zip(
            observations.pairs.tolist(), rows.tolist(), strict=True
        ):
            self.of_keyframe.setdefault(keyframe, {})[landmark] = row
            self.of_landmark.setdefault(landmark, {})[keyframe] = row
        return rows

    def remeasure(self, observations: Observations) -> None:
        """Replace the measurements of those of the observations that are in the table.

        Of two of the same landmark in a keyframe the one nearer to the old measurement is meant.
        One without depth gets none.
        """
        given = observations.pairs.tolist()
        rows = np.array([-1 if (row := self.row(*pair)) is None else row for pair in given], int)
        new, old = observations.measurements, self._columns.measurements[rows]
        chosen = np.flatnonzero((rows >= 0) & (np.isfinite(old[:, 2]) | ~np.isfinite(new[:, 2])))
        apart = np.abs(new - old)[chosen, :2].sum(axis=1)
        chosen = chosen[np.argsort(-apart, kind="stable")]  # of those of a row the last counts
        self._columns.measurements[rows[chosen]] = new[chosen]

    def remove(self, rows: Ints) -> None:
        """Remove rows; each must be in use."""
        for keyframe, landmark in self._columns.select(rows).pairs.tolist():
            _discard(self.of_keyframe, keyframe, landmark)
            _discard(self.of_landmark, landmark, keyframe)
        self._free.extend(rows.tolist())

    def row(self, keyframe: int, landmark: int) -> int | None:
        """The row of this observation, or None."""
        return self.of_keyframe.get(keyframe, {}).get(landmark)

    def rows_of_keyframes(self, ids: Iterable[int]) -> Ints:
        """All rows of these keyframes."""
        return _rows_of(self.of_keyframe, ids)

    def rows_of_landmarks(self, ids: Iterable[int]) -> Ints:
        """All rows of these landmarks."""
        return _rows_of(self.of_landmark, ids)

    def rows_left(self, keyframes: Ints, removed: Ints) -> Ints:
        """The rows of many keyframes but for those (M,) that are removed, ascending."""
        left = np.isin(self._columns.keyframe_ids[: self._used], keyframes)
        left[self._free] = False
        left[removed] = False
        return np.flatnonzero(left)

    def all(self) -> Observations:
        """All observations, ordered by keyframe, then landmark."""
        return self.select(self.all_rows())

    def select(self, rows: Ints) -> Observations:
        """The observations in these rows."""
        return self._columns.select(rows)

    def slots(self, rows: Ints) -> Ints:
        """Slots of these rows' factors in ISAM2, NO_SLOT where there is none."""
        return self._slots[rows]

    def set_slots(self, rows: Ints, slots: Ints) -> None:
        """Set the slots of these rows' factors in ISAM2."""
        self._slots[rows] = slots

    def used_rows(self) -> Ints:
        """Every row in use, ascending."""
        used = np.ones(self._used, bool)
        used[self._free] = False
        return np.flatnonzero(used)

    def all_rows(self) -> Ints:
        """Every row in use, ordered by keyframe, then landmark: the same for equal contents."""
        rows = self.used_rows()
        columns = self._columns.select(rows)
        return rows[np.lexsort((columns.landmark_ids, columns.keyframe_ids))]

    def _allocate(self, count: int) -> Ints:
        again = [self._free.pop() for _ in range(min(count, len(self._free)))]
        fresh = range(self._used, self._used + count - len(again))
        self._used += len(fresh)
        if self._used > len(self._slots):
            self._grow(max(1024, 2 * self._used))
        return np.array([*again, *fresh], np.int64)

    def _grow(self, capacity: int) -> None:
        more = capacity - len(self._slots)
        ids, columns = np.zeros(more, np.int64), np.zeros((more, 3))
        self._columns = concatenate([self._columns, Observations(ids, ids, columns, columns)])
        self._slots = np.concatenate([self._slots, np.full(more, NO_SLOT, np.int64)])


@dataclass
class PoseFactor:
    """A relative pose or a prior with its slot in ISAM2."""

    factor: RelativePose | PosePrior
    slot: int = NO_SLOT

    @property
    def keyframes(self) -> tuple[int, ...]:
        """Ids of the keyframes it involves: one for a prior, else two."""
        return self.factor.keyframe_ids

    @property
    def link(self) -> tuple[int, ...]:
        """The keyframes that it holds to each other, or to the world; none if it is partial."""
        return () if self.factor.kind in PARTIAL else self.factor.keyframe_ids

    @property
    def is_prior(self) -> bool:
        """Whether it is a prior on a keyframe."""
        return isinstance(self.factor, PosePrior)


@dataclass
class OwnFactor:
    """A factor of GTSAM that a user has made, the ids of its variables, and its slot in ISAM2."""

    factor: Any
    keyframes: tuple[int, ...]
    landmarks: tuple[int, ...]
    slot: int = NO_SLOT


class FactorTables:
    """Values, observations, pose factors (priors, relative poses) and own ones by number.

    Observations of marginalised landmarks are in ``marginalised``; pose factors replace them.
    """

    def __init__(self) -> None:
        self.keyframes = ValueTable(4, 4)
        self.landmarks = ValueTable(3)
        self.observations = ObservationTable()
        self.pose_factors: dict[int, PoseFactor] = {}
        self.pose_factors_of: dict[int, set[int]] = {}
        self.marginalised = MarginalisedLandmarks()
        self.own_factors: dict[int, OwnFactor] = {}
        self.next_own = 0  # number that no own factor has had
        self.inertial = InertialTables()
        self._next_number = 0

    def __len__(self) -> int:
        """Number of factors."""
        others = len(self.own_factors) + len(self.inertial.factors)
        return len(self.observations) + len(self.pose_factors) + others

    def add_pose_factors(self, factors: Iterable[RelativePose | PosePrior]) -> list[int]:
        """Add relative poses and priors; returns their numbers."""
        numbers = []
        for factor in factors:
            number = self._next_number
            self._next_number += 1
            self.pose_factors[number] = PoseFactor(factor)
            for keyframe in self.pose_factors[number].keyframes:
                self.pose_factors_of.setdefault(keyframe, set()).add(number)
            numbers.append(number)
        return numbers

    def remove_pose_factors(self, numbers: Iterable[int]) -> None:
        """Remove relative poses and priors."""
        for number in numbers:
            for keyframe in self.pose_factors.pop(number).keyframes:
                others = self.pose_factors_of[keyframe]
                others.discard(number)
                if not others:
                    del self.pose_factors_of[keyframe]

    @property
    def own_keyframes(self) -> set[int]:
        """The keyframes of a user's factors."""
        return {k for own in self.own_factors.values() for k in own.keyframes}

    def has_variables(self, own: OwnFactor) -> bool:
        """Whether the variables of a user's factor are in the graph."""
        keyframes, landmarks = np.array(own.keyframes, int), np.array(own.landmarks, int)
        has_keyframes = self.keyframes.contains(keyframes).all()
        return bool(has_keyframes and self.landmarks.contains(landmarks).all())

    def numbers_of_keyframes(self, ids: Iterable[int]) -> list[int]:
        """Numbers of the pose factors that involve these keyframes, ascending."""
        return sorted(set().union(*(self.pose_factors_of.get(k, set()) for k in ids)))

    def values_of(self, observations: Observations) -> tuple[Array, Array]:
        """The poses (N, 4, 4) and points (N, 3) of observations (N)."""
        poses = self.keyframes.get(observations.keyframe_ids)
        return poses, self.landmarks.get(observations.landmark_ids)

    def relative_poses(self, kind: str) -> tuple[RelativePose, ...]:
        """The relative poses of a kind, in the order in which they were added."""
        factors = (entry.factor for _, entry in sorted(self.pose_factors.items()))
        return tuple(f for f in factors if isinstance(f, RelativePose) and f.kind == kind)


def _discard(index: dict[int, dict[int, int]], first: int, second: int) -> None:
    inner = index[first]
    del inner[second]
    if not inner:
        del index[first]


def _rows_of(index: dict[int, dict[int, int]], ids: Iterable[int]) -> Ints:
    return distinct(np.array([r for i in ids for r in index.get(i, {}).values()], np.int64))
