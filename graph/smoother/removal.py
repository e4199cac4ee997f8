"""What leaves the graph, and what must leave or be held with it.

A removal never leaves a variable underconstrained. Either it is refused as a whole, with the
reasons, or a landmark without a stereo view and without parallax goes too, and a keyframe that
lost its hold is held where it is (`graph.smoother.anchoring`), because frames are stored relative
to it and
nothing tracked before is thrown away.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.factors.factor_tables import NO_SLOT, FactorTables, ids_array
from bmask_slam.graph.factors.graph_update import (
    NO_KEYFRAME,
    NO_LANDMARK,
    GraphUpdate,
    PosePrior,
    RefusalReason,
    Refusals,
    RelativePoseName,
    RemovalPolicy,
    RemovalReport,
)
from bmask_slam.graph.factors.observability import constrained_landmarks, firm_parts
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.smoother.anchoring import (
    anchor_loose,
    keyframes_held_by,
    loose_among,
    rows_in_front,
)


def _no_ids() -> Ints:
    return np.zeros(0, np.int64)


@dataclass(frozen=True)
class Removal:
    """What a removal did.

    Attributes:
        slots: places in ISAM2 of the factors that left.
        dropped_landmarks: (N,) landmarks that went without being asked for.
        pose_factors: numbers of the bridges and priors that were added to the shadow.
        bridged_keyframes: (N,) the keyframes that they hold.
        report: what went as asked, or why not.
    """

    slots: list[int] = field(default_factory=list)
    dropped_landmarks: Ints = field(default_factory=_no_ids)
    pose_factors: list[int] = field(default_factory=list)
    anchored_keyframes: Ints = field(default_factory=_no_ids)
    report: RemovalReport = field(default_factory=RemovalReport)

    def __bool__(self) -> bool:
        return bool(self.slots or self.pose_factors or len(self.dropped_landmarks))


@dataclass(frozen=True)
class _Plan:
    """What would leave: ids, numbers of pose factors, rows (with those of ``dropped``).

    ``single`` are the rows asked for one by one, ``loose`` the keyframes that would be left
    without a hold.
    """

    landmarks: Ints
    keyframes: Ints
    numbers: list[int]
    rows: Ints
    single: Ints
    dropped: Ints = field(default_factory=_no_ids)
    loose: Ints = field(default_factory=_no_ids)


def remove(update: GraphUpdate, tables: FactorTables, config: SmootherConfig) -> Removal:
    """Carry out an update's removals on the shadow, or refuse them as its policy says."""
    plan = _plan(update, tables, config)
    if not (len(plan.keyframes) or len(plan.landmarks) or plan.numbers or len(plan.rows)):
        return Removal()
    if update.removal_policy is RemovalPolicy.REFUSE and (len(plan.dropped) or len(plan.loose)):
        return Removal(report=RemovalReport(refused=_reasons(plan, tables)))
    gone = tables.observations.select(plan.rows)
    edges = [tables.pose_factors[number].keyframes for number in plan.numbers]
    report = _report(plan, update, tables)
    slots = _take_out(plan, tables)
    added = anchor_loose(plan.loose, gone, edges, tables, config)
    return Removal(slots, plan.dropped, added, keyframes_held_by(added, tables), report)


def _plan(update: GraphUpdate, tables: FactorTables, config: SmootherConfig) -> _Plan:
    table = tables.observations
    keyframes = np.intersect1d(update.remove_keyframes, tables.keyframes.ids)
    landmarks = np.intersect1d(update.remove_landmarks, tables.landmarks.ids)
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
    return _Plan(landmarks, keyframes, numbers, rows, single, dropped, loose)


def _numbers_of(names: Iterable[RelativePoseName], tables: FactorTables) -> list[int]:
    wanted = set(names)
    numbers = tables.numbers_of_keyframes({k for name in wanted for k in name[:2]})
    return [number for number in numbers if _name(number, tables) in wanted]


def _name(number: int, tables: FactorTables) -> RelativePoseName | None:
    factor = tables.pose_factors[number].factor
    if isinstance(factor, PosePrior):
        return None
    return factor.keyframe_a, factor.keyframe_b, factor.kind


def _left_underconstrained(
    rows: Ints, landmarks: Ints, tables: FactorTables, config: SmootherConfig
) -> Ints:
    """Landmarks that lose some of these rows and are not held by what remains."""
    table = tables.observations
    hit = np.setdiff1d(table.select(rows).landmark_ids, landmarks)
    remaining = np.setdiff1d(table.rows_of_landmarks(hit.tolist()), rows)
    observations, poses, points = rows_in_front(remaining, tables, config)
    held = constrained_landmarks(observations, poses, points, config.min_parallax_deg)
    return np.setdiff1d(hit, held)


def _left_loose(
    rows: Ints,
    keyframes: Ints,
    numbers: list[int],
    tables: FactorTables,
    config: SmootherConfig,
) -> Ints:
    """Keyframes without a hold once rows, keyframes and pose factors are gone."""
    if _still_linked(rows, keyframes, numbers, tables, config):
        return np.zeros(0, np.int64)
    table = tables.observations
    left = np.setdiff1d(tables.keyframes.ids, keyframes)
    others = set(tables.pose_factors) - set(numbers)
    return loose_among(left, np.setdiff1d(table.used_rows(), rows), others, tables, config)


def _still_linked(
    rows: Ints,
    keyframes: Ints,
    numbers: list[int],
    tables: FactorTables,
    config: SmootherConfig,
) -> bool:
    """Whether those who shared what leaves still hang firmly together, a look nearby.

    Then nothing has become loose: the first of them on the way from a prior hung on others,
    with which it shares as much as before, and the rest hang on it. A prior must not leave.
    """
    table, factors = tables.observations, tables.pose_factors
    if any(factors[number].is_prior for number in numbers):
        return False
    sharers = table.select(table.rows_of_landmarks(np.unique(table.select(rows).landmark_ids)))
    ends = [(k, -1 - n) for n in numbers for k in factors[n].keyframes]
    touched, group = np.concatenate(
        [
            np.stack([sharers.keyframe_ids, sharers.landmark_ids]),
            np.array(ends, np.int64).reshape(-1, 2).T,
        ],
        axis=1,
    )
    group = np.where(len(keyframes), 0, group)  # what a keyframe shared is linked through it
    left = ~np.isin(touched, keyframes)
    touched, group = touched[left], group[left]
    near = np.unique(touched)
    edges = set(tables.numbers_of_keyframes(near.tolist())) - set(numbers)
    part = firm_parts(
        near,
        table.select(np.setdiff1d(table.rows_of_keyframes(near.tolist()), rows)),
        [factors[number].keyframes for number in sorted(edges)],
        config.min_shared_observations,
    )[np.searchsorted(near, touched)]
    return len(np.unique(group)) == len(np.unique(np.stack([group, part]), axis=1).T)


def _reasons(plan: _Plan, tables: FactorTables) -> Refusals:
    """One line for each landmark and keyframe that a refused removal would leave loose."""
    unfixed = any(tables.pose_factors[number].is_prior for number in plan.numbers)
    reason = RefusalReason.PART_UNFIXED if unfixed else RefusalReason.KEYFRAME_UNDERCONSTRAINED
    count_l, count_k = len(plan.dropped), len(plan.loose)
    return Refusals(
        np.concatenate([np.full(count_l, NO_KEYFRAME), plan.loose]),
        np.concatenate([plan.dropped, np.full(count_k, NO_LANDMARK)]),
        np.repeat([RefusalReason.LANDMARK_UNDERCONSTRAINED, reason], [count_l, count_k]),
    )


def _report(plan: _Plan, update: GraphUpdate, tables: FactorTables) -> RemovalReport:
    single = tables.observations.select(plan.single)
    wanted = set(update.remove_relative_poses)
    names = (_name(number, tables) for number in plan.numbers)
    return RemovalReport(
        plan.landmarks,
        plan.keyframes,
        np.stack([single.keyframe_ids, single.landmark_ids], axis=1),
        tuple(name for name in names if name in wanted),
    )


def _take_out(plan: _Plan, tables: FactorTables) -> list[int]:
    slots = tables.observations.slots(plan.rows).tolist()
    slots += [tables.pose_factors[number].slot for number in plan.numbers]
    tables.observations.remove(plan.rows)
    tables.remove_pose_factors(plan.numbers)
    tables.landmarks.remove(np.union1d(plan.landmarks, plan.dropped))
    tables.keyframes.remove(plan.keyframes)
    return sorted(slot for slot in slots if slot != NO_SLOT)
