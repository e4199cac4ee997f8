"""What an update removes, and what must be removed or anchored with it.

A removal never leaves a variable underconstrained: a landmark without a stereo view and without
parallax is removed too, and a keyframe that too few factors constrain is anchored at its current
pose (`graph.smoother.anchoring`), because frames are stored relative to it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from bmask_slam.graph.arrays import Ints, distinct, no_ids
from bmask_slam.graph.factors.factor_tables import NO_SLOT, FactorTables, ValueTable, ids_array
from bmask_slam.graph.factors.graph_update import GraphUpdate, RelativePose, RelativePoseName
from bmask_slam.graph.factors.observability import constrained_landmarks, firm_components
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.smoother.anchoring import (
    anchor_loose,
    depths_m,
    keyframes_anchored_by,
    loose_among,
    rows_in_front,
)

HOPS = 3
"""Relative poses from keyframes that lose something to those through which they may be linked."""
STILL = 0.25
"""A landmark stays while its rays' parallax is this share of what a new one must have."""


@dataclass(frozen=True)
class Removal:
    """What a removal did.

    Attributes:
        slots: in ISAM2 of the factors that were removed.
        dropped_landmarks: (N,) landmarks that were removed without being asked for.
        pose_factors: numbers of the anchors that were added to the factor tables.
        anchored_keyframes: (N,) the keyframes that they hold.
    """

    slots: list[int] = field(default_factory=list)
    dropped_landmarks: Ints = field(default_factory=no_ids)
    pose_factors: list[int] = field(default_factory=list)
    anchored_keyframes: Ints = field(default_factory=no_ids)

    def __bool__(self) -> bool:
        return bool(self.slots or self.pose_factors or len(self.dropped_landmarks))


@dataclass(frozen=True)
class _Plan:
    """What is to be removed: ids, numbers of pose factors, rows of observations.

    ``landmarks`` and ``rows`` include those of ``dropped``, which were not asked for; ``loose``
    are the keyframes that would be left underconstrained.
    """

    landmarks: Ints
    keyframes: Ints
    numbers: list[int]
    rows: Ints
    dropped: Ints
    loose: Ints


def with_lost_removed(
    update: GraphUpdate, tables: FactorTables, config: SmootherConfig, share: float = STILL
) -> GraphUpdate:
    """The update, which removes observations that hold nothing any more as well.

    A step of the optimisation may carry a landmark of no depth and little parallax past infinity or
    through its cameras, and each further step twice as far away. The Jacobian of its factors is
    zero then, or nearly so along its ray, and GTSAM fails when it next linearises them. Removed are
    observations of landmarks behind the camera, and landmarks whose rays' parallax is less than a
    ``share`` of what a new one must have.
    """
    observations = tables.observations.select(tables.observations.used_rows())
    values = tables.values_of(observations)
    lost = depths_m(*values) < config.min_depth_m
    constrained = constrained_landmarks(observations, *values, share * config.min_parallax_deg)
    lost |= ~np.isin(observations.landmark_ids, constrained)
    return _without(update, observations.pairs[lost])


def _without(update: GraphUpdate, pairs: Ints) -> GraphUpdate:
    """The update, which removes these observations as well."""
    if not len(pairs):
        return update
    return replace(update, remove_observations=np.concatenate([update.remove_observations, pairs]))


def remove(update: GraphUpdate, tables: FactorTables, config: SmootherConfig) -> Removal:
    """Carry out an update's removals on the factor tables."""
    plan = _plan(update, tables, config)
    if not (len(plan.keyframes) or len(plan.landmarks) or plan.numbers or len(plan.rows)):
        return Removal()
    removed = tables.observations.select(plan.rows)
    edges = [tables.pose_factors[number].link for number in plan.numbers]
    slots = _remove_from_tables(plan, tables)
    added = anchor_loose(plan.loose, removed, edges, tables, config)
    return Removal(slots, plan.dropped, added, keyframes_anchored_by(added, tables))


def _plan(update: GraphUpdate, tables: FactorTables, config: SmootherConfig) -> _Plan:
    table = tables.observations
    keyframes = _present(update.remove_keyframes, tables.keyframes)
    landmarks = _present(update.remove_landmarks, tables.landmarks)
    numbers = sorted(
        {
            *_numbers_of(update.remove_relative_poses, tables),
            *tables.numbers_of_keyframes(keyframes.tolist()),
        }
    )
    pairs = (table.row(k, j) for k, j in update.remove_observations.tolist())
    single = ids_array(row for row in pairs if row is not None)
    whole = np.union1d(
        table.rows_of_keyframes(keyframes.tolist()), table.rows_of_landmarks(landmarks.tolist())
    )
    rows = np.union1d(single, whole)
    dropped = _left_underconstrained(rows, landmarks, tables, config)
    rows = np.union1d(rows, table.rows_of_landmarks(dropped.tolist()))
    loose = _left_loose(rows, keyframes, numbers, tables, config)
    return _Plan(np.union1d(landmarks, dropped), keyframes, numbers, rows, dropped, loose)


def _present(ids: Ints, table: ValueTable) -> Ints:
    """The ids that a table has, ascending."""
    return distinct(ids[table.contains(ids)])


def _numbers_of(names: Iterable[RelativePoseName], tables: FactorTables) -> list[int]:
    names_to_remove = set(names)
    numbers = tables.numbers_of_keyframes({k for name in names_to_remove for k in name[:2]})
    factors = {number: tables.pose_factors[number].factor for number in numbers}
    return [
        n for n, f in factors.items() if isinstance(f, RelativePose) and f.name in names_to_remove
    ]


def _left_underconstrained(
    rows: Ints, landmarks: Ints, tables: FactorTables, config: SmootherConfig
) -> Ints:
    """Landmarks that lose some of these rows and are not constrained by the remaining ones."""
    table = tables.observations
    hit = np.setdiff1d(table.select(rows).landmark_ids, landmarks)
    remaining = np.setdiff1d(table.rows_of_landmarks(hit.tolist()), rows)
    observations, poses, points = rows_in_front(remaining, tables, config)
    constrained = constrained_landmarks(observations, poses, points, config.min_parallax_deg)
    return np.setdiff1d(hit, constrained)


def _left_loose(
    rows: Ints, keyframes: Ints, numbers: list[int], tables: FactorTables, config: SmootherConfig
) -> Ints:
    """Keyframes that are underconstrained once rows, keyframes and pose factors are removed."""
    if _still_linked(rows, keyframes, numbers, tables, config):
        return no_ids()
    table = tables.observations
    left = np.setdiff1d(tables.keyframes.ids, keyframes)
    others = set(tables.pose_factors) - set(numbers)
    return loose_among(left, np.setdiff1d(table.used_rows(), rows), others, tables, config)


def _still_linked(
    rows: Ints, keyframes: Ints, numbers: list[int], tables: FactorTables, config: SmootherConfig
) -> bool:
    """Whether the keyframes that share what is removed stay firmly linked: a fast local test.

    Then none has become loose: the first of them on the way from a prior is linked to others, with
    which it shares as much as before, and the rest are linked to it. No prior may be removed. The
    links may lead over keyframes around them, up to ``HOPS`` relative poses away.
    """
    table, factors = tables.observations, tables.pose_factors
    if any(factors[number].is_prior for number in numbers):
        return False
    observers = table.select(table.rows_of_landmarks(np.unique(table.select(rows).landmark_ids)))
    ends = [(k, -1 - n) for n in numbers for k in factors[n].link]
    touched, group = np.concatenate(
        [
            np.stack([observers.keyframe_ids, observers.landmark_ids]),
            np.array(ends, np.int64).reshape(-1, 2).T,
        ],
        axis=1,
    )
    group = np.where(len(keyframes), 0, group)  # what a keyframe shared is linked through it
    left = ~np.isin(touched, keyframes)
    touched, group = touched[left], group[left]
    if not len(touched):  # partial factors alone
        return True
    near, group = np.unique(touched), np.unique(group, return_inverse=True)[1]
    for _ in range(HOPS + 1):
        edges = set(tables.numbers_of_keyframes(near.tolist())) - set(numbers)
        links = [factors[number].link for number in sorted(edges)]
        observed = table.select(table.rows_left(near, rows))
        part = firm_components(near, observed, links, config.min_left_observations)
        parts = part[np.searchsorted(near, touched)]
        if group.max() + 1 == len(np.unique(group * len(near) + parts)):
            return True
        wider = np.union1d(near, ids_array(k for link in links for k in link))
        if len(wider) == len(near):
            return False
        near = wider
    return False


def _remove_from_tables(plan: _Plan, tables: FactorTables) -> list[int]:
    slots = tables.observations.slots(plan.rows).tolist()
    slots += [tables.pose_factors[number].slot for number in plan.numbers]
    tables.observations.remove(plan.rows)
    tables.remove_pose_factors(plan.numbers)
    tables.landmarks.remove(plan.landmarks)
    tables.keyframes.remove(plan.keyframes)
    return sorted(slot for slot in slots if slot != NO_SLOT)
