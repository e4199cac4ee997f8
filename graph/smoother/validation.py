"""What may enter the graph: every check that keeps ISAM2 from an indeterminate system.

A landmark with one monocular view or a new pose on a few points makes the whole system
singular. `graph.factors.checks` checks each thing alone; here what passed is checked together,
before
GTSAM sees anything, and what is refused is reported with a reason.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.checks import (
    Candidates,
    check_observations,
    check_pose_factors,
    check_variables,
    describe,
)
from bmask_slam.graph.factors.factor_tables import FactorTables, ids_array
from bmask_slam.graph.factors.graph_update import (
    NO_LANDMARK,
    GraphUpdate,
    Observations,
    PosePrior,
    RefusalReason,
    Refusals,
    RefusedFactor,
    RelativePose,
)
from bmask_slam.graph.factors.observability import constrained_landmarks
from bmask_slam.graph.factors.smoother_config import SmootherConfig


@dataclass(frozen=True)
class Validated:
    """The part of an update that may enter, and what may not."""

    keyframe_ids: Ints
    poses_world_camera: Array
    landmark_ids: Ints
    points_world: Array
    observations: Observations
    pose_factors: tuple[RelativePose | PosePrior, ...]
    refused: Refusals
    refused_factors: tuple[RefusedFactor, ...]


def validate(
    update: GraphUpdate, tables: FactorTables, camera: Camera, config: SmootherConfig
) -> Validated:
    """Sort an update into what may enter and what is refused; removals are already done."""
    keyframe_rows, keyframe_reasons = check_variables(
        update.keyframe_ids, update.poses_world_camera, tables.keyframes.ids
    )
    landmark_rows, _ = check_variables(
        update.landmark_ids, update.points_world, tables.landmarks.ids
    )
    candidates = Candidates(
        update.keyframe_ids[keyframe_rows],
        update.poses_world_camera[keyframe_rows],
        update.landmark_ids[landmark_rows],
        update.points_world[landmark_rows],
        tables,
    )
    pose_factors, refused_factors = check_pose_factors(update, candidates)
    reasons = check_observations(update.observations, candidates, camera, config)
    keyframes, landmarks = _settle(update.observations, reasons, pose_factors, candidates, config)
    kept, lost = _split_by_keyframes(pose_factors, keyframes, candidates)
    fell = candidates.new_keyframes[~np.isin(candidates.new_keyframes, keyframes)]
    in_keyframes = np.isin(candidates.new_keyframes, keyframes)
    in_landmarks = np.isin(candidates.new_landmarks, landmarks)
    return Validated(
        candidates.new_keyframes[in_keyframes],
        candidates.new_poses[in_keyframes],
        candidates.new_landmarks[in_landmarks],
        candidates.new_points[in_landmarks],
        update.observations.select(reasons == 0),
        kept,
        _refusals(update, reasons, keyframe_reasons, fell),
        (*refused_factors, *lost),
    )


def _settle(
    observations: Observations,
    reasons: Ints,
    pose_factors: tuple[RelativePose | PosePrior, ...],
    candidates: Candidates,
    config: SmootherConfig,
) -> tuple[Ints, Ints]:
    """Ids of the new keyframes and landmarks that are constrained; marks the others' rows.

    A landmark that falls takes support from a keyframe and the other way round, so this is
    repeated until nothing changes; each round removes something, so it ends.
    """
    keyframes, landmarks = candidates.new_keyframes, candidates.new_landmarks
    while True:
        rows = np.flatnonzero(reasons == 0)
        accepted = observations.select(rows)
        fine = constrained_landmarks(
            accepted,
            candidates.poses(accepted.keyframe_ids),
            candidates.points(accepted.landmark_ids),
            config.min_parallax_deg,
        )
        landmarks_now = landmarks[np.isin(landmarks, fine)]
        keyframes_now = _anchored(accepted, pose_factors, keyframes, candidates, config)
        bad_landmark = np.isin(accepted.landmark_ids, np.setdiff1d(landmarks, landmarks_now))
        bad_keyframe = np.isin(accepted.keyframe_ids, np.setdiff1d(keyframes, keyframes_now))
        reasons[rows[bad_keyframe]] = RefusalReason.KEYFRAME_UNDERCONSTRAINED
        reasons[rows[bad_landmark]] = RefusalReason.LANDMARK_UNDERCONSTRAINED
        if len(landmarks_now) == len(landmarks) and len(keyframes_now) == len(keyframes):
            return keyframes, landmarks
        keyframes, landmarks = keyframes_now, landmarks_now


def _anchored(
    accepted: Observations,
    pose_factors: tuple[RelativePose | PosePrior, ...],
    keyframes: Ints,
    candidates: Candidates,
    config: SmootherConfig,
) -> Ints:
    """The new keyframes that hang together with the graph or with a prior.

    Grown from the graph's keyframes: a keyframe joins by a prior, by a relative pose to one
    that is in, or by enough observations of landmarks that the graph or one that is in sees.
    """
    inside = set(candidates.tables.keyframes.ids.tolist())
    waiting = keyframes.tolist()
    old = candidates.tables.landmarks.contains(accepted.landmark_ids)
    while True:
        seen = accepted.landmark_ids[np.isin(accepted.keyframe_ids, ids_array(inside))]
        shared = accepted.keyframe_ids[old | np.isin(accepted.landmark_ids, seen)]
        joined = [
            k
            for k in waiting
            if np.count_nonzero(shared == k) >= config.min_shared_observations
            or _held(k, pose_factors, inside)
        ]
        if not joined:
            return keyframes[np.isin(keyframes, ids_array(inside))]
        inside.update(joined)
        waiting = [k for k in waiting if k not in inside]


def _held(
    keyframe: int, pose_factors: tuple[RelativePose | PosePrior, ...], inside: set[int]
) -> bool:
    for factor in pose_factors:
        _, ids = describe(factor)
        if keyframe in ids and all(i in inside for i in ids if i != keyframe):
            return True
    return False


def _split_by_keyframes(
    pose_factors: tuple[RelativePose | PosePrior, ...],
    keyframes: Ints,
    candidates: Candidates,
) -> tuple[tuple[RelativePose | PosePrior, ...], list[RefusedFactor]]:
    inside = {*keyframes.tolist(), *candidates.tables.keyframes.ids.tolist()}
    kept = tuple(f for f in pose_factors if inside.issuperset(describe(f)[1]))
    lost = [
        RefusedFactor(*describe(f), RefusalReason.KEYFRAME_UNDERCONSTRAINED)
        for f in pose_factors
        if not inside.issuperset(describe(f)[1])
    ]
    return kept, lost


def _refusals(update: GraphUpdate, reasons: Ints, keyframe_reasons: Ints, fell: Ints) -> Refusals:
    rows = np.flatnonzero(reasons)
    bad = np.flatnonzero(keyframe_reasons)
    keyframes = np.concatenate([update.keyframe_ids[bad], fell])
    return Refusals(
        np.concatenate([update.observations.keyframe_ids[rows], keyframes]),
        np.concatenate(
            [update.observations.landmark_ids[rows], np.full(len(keyframes), NO_LANDMARK)]
        ),
        np.concatenate(
            [
                reasons[rows],
                keyframe_reasons[bad],
                np.full(len(fell), RefusalReason.KEYFRAME_UNDERCONSTRAINED),
            ]
        ),
    )
