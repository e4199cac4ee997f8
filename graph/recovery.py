"""What to take out of the graph after ISAM2 failed.

GTSAM names a variable near the place where elimination broke down, which need not be the
cause: a new pose on one point is reported as that point. So the causes that can be seen are
looked for first, and the named variable is dropped only when there is none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graph.camera import Camera
from graph.gates import reprojection
from graph.pruning import bridge, remove
from graph.shadow import Shadow, ids_array
from graph.smoother_config import SmootherConfig
from graph.solver import Variable
from graph.support import constrained_landmarks
from graph.updates import GraphUpdate, IntArray


@dataclass(frozen=True)
class Repair:
    """What a repair took out of the shadow, and whom it tied loosely."""

    dropped_landmarks: IntArray
    dropped_keyframes: IntArray
    bridged_keyframes: IntArray

    @property
    def changed(self) -> bool:
        """Whether it did anything; if not, trying again would fail again."""
        return bool(
            len(self.dropped_landmarks)
            or len(self.dropped_keyframes)
            or len(self.bridged_keyframes)
        )


def repair(
    named: Variable | None,
    new_keyframes: IntArray,
    shadow: Shadow,
    camera: Camera,
    config: SmootherConfig,
) -> Repair:
    """Take out what makes the system singular; ``new_keyframes`` go rather than be bridged."""
    landmarks = _loose_landmarks(shadow, camera, config)
    loose = _loose_keyframes(shadow, config)
    if named is not None and not len(landmarks) and not len(loose):
        landmarks = ids_array([named[1]] if named[0] == "landmark" else [])
        loose = ids_array([named[1]] if named[0] == "keyframe" else [])
    bridged_before = {
        k
        for f in shadow.pose_factors.values()
        if not f.is_prior and getattr(f.factor, "kind", "") == "bridge"
        for k in f.keyframes
    }
    dropped = ids_array(k for k in loose.tolist() if k in new_keyframes or k in bridged_before)
    removal = remove(
        GraphUpdate(remove_landmarks=landmarks, remove_keyframes=dropped), shadow, config
    )
    tied = _tie(np.setdiff1d(loose, dropped), shadow, config)
    return Repair(
        np.union1d(landmarks, removal.dropped_landmarks),
        dropped,
        np.union1d(tied, removal.bridged_keyframes),
    )


def _loose_landmarks(shadow: Shadow, camera: Camera, config: SmootherConfig) -> IntArray:
    """Landmarks that the views in front of a camera do not constrain."""
    seen = shadow.observations.select(shadow.observations.all_rows())
    poses = shadow.keyframes.get(seen.keyframe_ids)
    points = shadow.landmarks.get(seen.landmark_ids)
    depth_m, _ = reprojection(seen, poses, points, camera)
    useful = depth_m >= config.min_depth_m
    held = constrained_landmarks(
        seen.select(useful), poses[useful], points[useful], config.min_parallax_deg
    )
    return np.setdiff1d(shadow.landmarks.ids, held)


def _loose_keyframes(shadow: Shadow, config: SmootherConfig) -> IntArray:
    """Keyframes that no chain of enough shared landmarks or relative poses ties to a prior."""
    ids = shadow.keyframes.ids
    seen = shadow.observations.select(shadow.observations.all_rows())
    keyframe = np.searchsorted(ids, seen.keyframe_ids)
    landmark = np.searchsorted(shadow.landmarks.ids, seen.landmark_ids)
    edges = [np.searchsorted(ids, f.keyframes) for f in shadow.pose_factors.values()]
    tied = np.zeros(len(ids), bool)
    tied[[edge[0] for edge in edges if len(edge) == 1]] = True
    while True:
        known = np.zeros(len(shadow.landmarks.ids), bool)
        known[landmark[tied[keyframe]]] = True
        shared = np.bincount(keyframe[known[landmark]], minlength=len(ids))
        now = tied | (shared >= config.min_shared_observations)
        for edge in edges:
            now[edge] |= now[edge].any()
        if (now == tied).all():
            return ids[~tied]
        tied = now


def _tie(loose: IntArray, shadow: Shadow, config: SmootherConfig) -> IntArray:
    """Bridge loose keyframes to firm ones, one at a time: one bridge may hold a whole part."""
    bridged: list[int] = []
    while len(loose):
        firm = np.setdiff1d(shadow.keyframes.ids, loose)
        if not len(firm):
            break
        k = int(loose[0])
        nearest = int(firm[np.argmin(np.abs(firm - k))])
        shadow.add_pose_factors([bridge(nearest, k, shadow, config)])
        bridged.append(k)
        loose = np.intersect1d(loose[1:], _loose_keyframes(shadow, config))
    return ids_array(bridged)
