"""What may enter the graph: the checks that keep ISAM2 from an indeterminate system.

A landmark with one monocular view, or a new pose that observes few points, makes the whole system
singular. `graph.factors.checks` checks each thing on its own; here all that passed is checked
together, before GTSAM gets it, and what is refused is reported with a reason.
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
)
from bmask_slam.graph.factors.factor_tables import FactorTables, ids_array
from bmask_slam.graph.factors.graph_estimate import (
    NO_LANDMARK,
    RefusalReason,
    Refusals,
    RefusedFactor,
)
from bmask_slam.graph.factors.graph_update import (
    PARTIAL,
    GraphUpdate,
    Observations,
    PosePrior,
    RelativePose,
)
from bmask_slam.graph.factors.observability import constrained_landmarks
from bmask_slam.graph.factors.smoother_config import SmootherConfig


@dataclass(frozen=True)
class Validated:
    """The part of an update that may enter, and what is refused."""

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
    """Divide an update into what may enter and what is refused; after its removals."""
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
    keyframes, landmarks = _constrained(
        update.observations, reasons, pose_factors, candidates, config
    )
    kept, lost = _split_by_keyframes(pose_factors, keyframes, candidates)
    loose = candidates.new_keyframes[~np.isin(candidates.new_keyframes, keyframes)]
    in_keyframes = np.isin(candidates.new_keyframes, keyframes)
    in_landmarks = np.isin(candidates.new_landmarks, landmarks)
    return Validated(
        candidates.new_keyframes[in_keyframes],
        candidates.new_poses[in_keyframes],
        candidates.new_landmarks[in_landmarks],
        candidates.new_points[in_landmarks],
        update.observations.select(reasons == 0),
        kept,
        _refusals(update, reasons, keyframe_reasons, loose),
        (*refused_factors, *lost),
    )


def _constrained(
    observations: Observations,
    reasons: Ints,
    pose_factors: tuple[RelativePose | PosePrior, ...],
    candidates: Candidates,
    config: SmootherConfig,
) -> tuple[Ints, Ints]:
    """Ids of the new keyframes and landmarks that are constrained; sets the others' reasons.

    A refused landmark leaves keyframes with fewer observations and the other way round, so this is
    repeated until nothing changes.
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
        keyframes_now = _connected(accepted, pose_factors, keyframes, candidates, config)
        bad_landmark = np.isin(accepted.landmark_ids, np.setdiff1d(landmarks, landmarks_now))
        bad_keyframe = np.isin(accepted.keyframe_ids, np.setdiff1d(keyframes, keyframes_now))
        reasons[rows[bad_keyframe]] = RefusalReason.KEYFRAME_UNDERCONSTRAINED
        reasons[rows[bad_landmark]] = RefusalReason.LANDMARK_UNDERCONSTRAINED
        if len(landmarks_now) == len(landmarks) and len(keyframes_now) == len(keyframes):
            return keyframes, landmarks
        keyframes, landmarks = keyframes_now, landmarks_now


def _connected(
    accepted: Observations,
    pose_factors: tuple[RelativePose | PosePrior, ...],
    keyframes: Ints,
    candidates: Candidates,
    config: SmootherConfig,
) -> Ints:
    """The new keyframes that are connected to the graph or to a prior.

    Grown from the graph's keyframes: a keyframe joins by a prior, by a relative pose to a member,
    or by enough observations of landmarks of the graph or of members.
    """
    inside = set(candidates.tables.keyframes.ids.tolist())
    waiting = keyframes.tolist()
    old = candidates.tables.landmarks.contains(accepted.landmark_ids)
    while True:
        observed_ids = accepted.landmark_ids[np.isin(accepted.keyframe_ids, ids_array(inside))]
        shared = accepted.keyframe_ids[old | np.isin(accepted.landmark_ids, observed_ids)]
        joined = [
            k
            for k in waiting
            if np.count_nonzero(shared == k) >= config.min_shared_observations
            or _joins(k, pose_factors, inside)
        ]
        if not joined:
            return keyframes[np.isin(keyframes, ids_array(inside))]
        inside.update(joined)
        waiting = [k for k in waiting if k not in inside]


def _joins(
    keyframe: int, pose_factors: tuple[RelativePose | PosePrior, ...], inside: set[int]
) -> bool:
    ends = (factor.keyframe_ids for factor in pose_factors if factor.kind not in PARTIAL)
    return any(keyframe in ids and inside.issuperset(set(ids) - {keyframe}) for ids in ends)


def _split_by_keyframes(
    pose_factors: tuple[RelativePose | PosePrior, ...], keyframes: Ints, candidates: Candidates
) -> tuple[tuple[RelativePose | PosePrior, ...], list[RefusedFactor]]:
    inside = {*keyframes.tolist(), *candidates.tables.keyframes.ids.tolist()}
    kept = tuple(f for f in pose_factors if inside.issuperset(f.keyframe_ids))
    lost = [
        RefusedFactor(f.kind, f.keyframe_ids, RefusalReason.KEYFRAME_UNDERCONSTRAINED)
        for f in pose_factors
        if not inside.issuperset(f.keyframe_ids)
    ]
    return kept, lost


def _refusals(update: GraphUpdate, reasons: Ints, keyframe_reasons: Ints, loose: Ints) -> Refusals:
    rows = np.flatnonzero(reasons)
    bad = np.flatnonzero(keyframe_reasons)
    keyframes = np.concatenate([update.keyframe_ids[bad], loose])
    return Refusals(
        np.concatenate([update.observations.keyframe_ids[rows], keyframes]),
        np.concatenate(
            [update.observations.landmark_ids[rows], np.full(len(keyframes), NO_LANDMARK)]
        ),
        np.concatenate(
            [
                reasons[rows],
                keyframe_reasons[bad],
                np.full(len(loose), RefusalReason.KEYFRAME_UNDERCONSTRAINED),
            ]
        ),
    )
