"""What leaves the graph, and what must leave or be held with it.

A removal never leaves a variable underconstrained: a landmark without a stereo view and
without parallax goes too; a keyframe with too few shared landmarks is tied loosely to the
neighbour that shared most with it ("bridge"), because frames are stored relative to it and
nothing tracked before is thrown away; a part of the graph left without any prior gets one at
its current estimate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from graph.geometry import inverse
from graph.shadow import NO_SLOT, Shadow, ids_array
from graph.smoother_config import SmootherConfig
from graph.support import constrained_landmarks, diagonal_covariance
from graph.updates import GraphUpdate, IntArray, Observations, PosePrior, RelativePose


@dataclass(frozen=True)
class Removal:
    """What a removal did.

    Attributes:
        slots: places in ISAM2 of the factors that left.
        dropped_landmarks: (N,) landmarks that went without being asked for.
        pose_factors: numbers of the bridges and priors that were added to the shadow.
        bridged_keyframes: (N,) the keyframes that they hold.
    """

    slots: list[int] = field(default_factory=list)
    dropped_landmarks: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    pose_factors: list[int] = field(default_factory=list)
    bridged_keyframes: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __bool__(self) -> bool:
        return bool(self.slots or self.pose_factors or len(self.dropped_landmarks))


def remove(update: GraphUpdate, shadow: Shadow, config: SmootherConfig) -> Removal:
    """Carry out an update's removals on the shadow."""
    keyframes = set(update.remove_keyframes.tolist()) & set(shadow.keyframes.ids.tolist())
    landmarks = set(update.remove_landmarks.tolist()) & set(shadow.observations.of_landmark)
    numbers = _numbers_to_remove(update, keyframes, shadow)
    rows = _rows_to_remove(update, keyframes, landmarks, shadow)
    if not (keyframes or landmarks or numbers or len(rows)):
        return Removal()
    dropped = _left_underconstrained(rows, landmarks, shadow, config)
    rows = np.union1d(rows, shadow.observations.rows_of_landmarks(dropped.tolist()))
    touched = _touched_keyframes(rows, numbers, shadow) - keyframes
    gone = shadow.observations.select(rows)
    edges = [shadow.pose_factors[number].keyframes for number in numbers]
    slots = _take_out(rows, numbers, shadow)
    shadow.landmarks.remove(ids_array([*landmarks, *dropped.tolist()]))
    shadow.keyframes.remove(ids_array(keyframes))
    loose = [k for k in sorted(touched) if not _is_supported(k, shadow, config)]
    bridges = [_bridge_to_best(k, gone, edges, shadow, config) for k in loose]
    added = shadow.add_pose_factors([edge for edge in bridges if edge is not None])
    added += anchor_components(shadow, config)
    return Removal(slots, dropped, added, keyframes_held_by(added, shadow))


def anchor_components(shadow: Shadow, config: SmootherConfig) -> list[int]:
    """Give each connected part of the graph without a prior one; numbers of the new priors."""
    ids = shadow.keyframes.ids
    if not len(ids):
        return []
    labels = _component_labels(shadow)
    fixed = {
        int(labels[np.searchsorted(ids, f.keyframes[0])])
        for f in shadow.pose_factors.values()
        if f.is_prior
    }
    _, first = np.unique(labels, return_index=True)
    loose = [ids[i] for i in sorted(first.tolist()) if int(labels[i]) not in fixed]
    return shadow.add_pose_factors([prior_here(int(k), shadow, config) for k in loose])


def prior_here(keyframe: int, shadow: Shadow, config: SmootherConfig) -> PosePrior:
    """A prior at a keyframe's current estimate, with the sigmas of the first pose's prior."""
    covariance = diagonal_covariance(
        config.prior_sigma_rotation_rad, config.prior_sigma_translation_m
    )
    T_world_camera = shadow.keyframes.get(np.array([keyframe]))[0]
    return PosePrior(keyframe, T_world_camera, covariance)


def bridge(a: int, b: int, shadow: Shadow, config: SmootherConfig) -> RelativePose:
    """A loose relative pose between two keyframes at their current estimates."""
    T_world_a, T_world_b = shadow.keyframes.get(np.array([a, b]))
    covariance = diagonal_covariance(
        config.bridge_sigma_rotation_rad, config.bridge_sigma_translation_m
    )
    return RelativePose(a, b, inverse(T_world_a) @ T_world_b, covariance, kind="bridge")


def _numbers_to_remove(update: GraphUpdate, keyframes: set[int], shadow: Shadow) -> list[int]:
    wanted = set(update.remove_relative_poses)
    edges = shadow.numbers_of_keyframes({k for edge in wanted for k in edge[:2]})
    named = []
    for number in edges:
        factor = shadow.pose_factors[number].factor
        if isinstance(factor, RelativePose):
            edge = (factor.keyframe_a, factor.keyframe_b, factor.kind)
            named += [number] if edge in wanted else []
    return sorted({*named, *shadow.numbers_of_keyframes(keyframes)})


def _rows_to_remove(
    update: GraphUpdate, keyframes: Iterable[int], landmarks: Iterable[int], shadow: Shadow
) -> IntArray:
    table = shadow.observations
    pairs = [table.row(k, j) for k, j in update.remove_observations.tolist()]
    single = np.array(sorted({row for row in pairs if row is not None}), np.int64)
    whole = np.union1d(table.rows_of_keyframes(keyframes), table.rows_of_landmarks(landmarks))
    return np.union1d(single, whole)


def _left_underconstrained(
    rows: IntArray, landmarks: set[int], shadow: Shadow, config: SmootherConfig
) -> IntArray:
    """Landmarks that lose some of these rows and are not held by what remains."""
    table = shadow.observations
    hit = np.setdiff1d(table.select(rows).landmark_ids, ids_array(landmarks))
    remaining = np.setdiff1d(table.rows_of_landmarks(hit.tolist()), rows)
    observations = table.select(remaining)
    held = constrained_landmarks(
        observations,
        shadow.keyframes.get(observations.keyframe_ids),
        shadow.landmarks.get(observations.landmark_ids),
        config.min_parallax_deg,
    )
    return np.setdiff1d(hit, held)


def _touched_keyframes(rows: IntArray, numbers: list[int], shadow: Shadow) -> set[int]:
    """Keyframes that lose a factor, directly or as the other observer of a landmark."""
    observations = shadow.observations.select(rows)
    touched = set(observations.keyframe_ids.tolist())
    for landmark in np.unique(observations.landmark_ids).tolist():
        touched.update(shadow.observations.of_landmark[landmark])
    for number in numbers:
        touched.update(shadow.pose_factors[number].keyframes)
    return touched


def _bridge_to_best(
    keyframe: int,
    gone: Observations,
    edges: list[tuple[int, ...]],
    shadow: Shadow,
    config: SmootherConfig,
) -> RelativePose | None:
    """A bridge to the keyframe that shared most with this one before the removal.

    ``gone`` and ``edges`` are what the removal took. Without any, the nearest id is taken.
    """
    shared: Counter[int] = Counter(k for edge in edges if keyframe in edge for k in edge)
    lost = gone.landmark_ids[gone.keyframe_ids == keyframe]
    kept = shadow.observations.of_keyframe.get(keyframe, {})
    for landmark in {*lost.tolist(), *kept}:
        shared.update(shadow.observations.of_landmark.get(landmark, {}).keys())
    shared.update(gone.keyframe_ids[np.isin(gone.landmark_ids, lost)].tolist())
    others = [k for k in shadow.keyframes.ids.tolist() if k != keyframe]
    if not others:
        return None
    best = min(others, key=lambda k: (-shared[k], abs(k - keyframe), k))
    return bridge(best, keyframe, shadow, config)


def _take_out(rows: IntArray, numbers: list[int], shadow: Shadow) -> list[int]:
    slots = shadow.observations.slots(rows).tolist()
    slots += [shadow.pose_factors[number].slot for number in numbers]
    shadow.observations.remove(rows)
    shadow.remove_pose_factors(numbers)
    return sorted(slot for slot in slots if slot != NO_SLOT)


def _is_supported(keyframe: int, shadow: Shadow, config: SmootherConfig) -> bool:
    if shadow.pose_factors_of.get(keyframe):
        return True
    table, shared = shadow.observations, 0
    for landmark in table.of_keyframe.get(keyframe, {}):
        shared += len(table.of_landmark[landmark]) > 1
        if shared >= config.min_shared_observations:
            return True
    return False


def keyframes_held_by(numbers: list[int], shadow: Shadow) -> IntArray:
    """The keyframes (N,) that these bridges and priors were made for."""
    return ids_array(shadow.pose_factors[number].keyframes[-1] for number in numbers)


def _component_labels(shadow: Shadow) -> IntArray:
    """The number (K,) of the connected part that each keyframe is in."""
    ids, landmark_ids = shadow.keyframes.ids, shadow.landmarks.ids
    seen = shadow.observations.select(shadow.observations.used_rows())
    edges = [f.keyframes for f in shadow.pose_factors.values() if not f.is_prior]
    pairs = np.array(edges, np.int64).reshape(-1, 2)
    starts = np.concatenate([seen.keyframe_ids, pairs[:, 0]])
    ends = np.concatenate(
        [
            len(ids) + np.searchsorted(landmark_ids, seen.landmark_ids),
            np.searchsorted(ids, pairs[:, 1]),
        ]
    )
    size = len(ids) + len(landmark_ids)
    links = coo_array(
        (np.ones(len(starts), np.int8), (np.searchsorted(ids, starts), ends)), (size, size)
    )
    return connected_components(links, directed=False)[1][: len(ids)].astype(np.int64)
