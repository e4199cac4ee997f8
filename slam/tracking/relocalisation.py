"""Finding the camera in the map without a prior: after tracking was lost, or to join segments."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.features.descriptor_index import DescriptorIndex
from bmask_slam.features.matching import MatchConfig, consistent_rotation, match_brute_force
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import make_pose
from bmask_slam.tracking.results import Tracked, TrackingStatus
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.local_map import LocalMapConfig, local_landmarks
from bmask_slam.world.world_map import Keyframe, WorldMap


@dataclass(frozen=True)
class RelocalisationConfig:
    """``candidates`` keyframes with the most votes, at least ``min_votes``, are tried.

    A pose needs ``min_inliers``. After ``patience_frames`` lost frames a new map segment is begun,
    if the frame has ``min_new_points`` with depth.
    """

    candidates: int = 4
    min_votes: float = 2.0
    min_matches: int = 15
    min_inliers: int = 30
    reprojection_px: float = 4.0
    patience_frames: int = 10
    min_new_points: int = 100
    match: MatchConfig = field(
        default_factory=lambda: MatchConfig(max_distance=110, ratio=0.85, max_angle_rad=0.5)
    )


def relocalise(
    features: Features,
    candidates: list[Keyframe],
    world: WorldMap,
    tracker: Tracker,
    config: RelocalisationConfig,
    local_map: LocalMapConfig,
) -> Tracked | None:
    """The frame tracked against the first candidate that fits; None if none does.

    Descriptors are matched without a prior, the pose is found by P3P in RANSAC (OpenCV, whose
    random numbers are seeded, so that runs repeat), then refined on that keyframe's local map.
    """
    for keyframe in candidates[: config.candidates]:
        T_world_camera = _pose_from(keyframe, features, world, tracker, config)
        if T_world_camera is None:
            continue
        _, observed = world.observed(keyframe)
        local_ids = local_landmarks(world, observed, local_map)
        tracked = tracker.refine(features, T_world_camera, local_ids, world)
        enough = len(tracked.landmark_ids) >= config.min_inliers
        if tracked.status is not TrackingStatus.LOST and enough:
            return tracked
    return None


def similar_keyframes(
    features: Features, keyframes: list[Keyframe], places: DescriptorIndex, min_votes: float
) -> list[Keyframe]:
    """The keyframes that a frame's descriptors vote for, by falling votes."""
    wanted = {keyframe.id: keyframe for keyframe in keyframes}
    votes = places.votes(features.descriptors, set(places.keyframe_ids) - wanted.keys())
    return [wanted[k] for k in votes.keyframe_ids[votes.scores >= min_votes].tolist()]


def _pose_from(
    keyframe: Keyframe,
    features: Features,
    world: WorldMap,
    tracker: Tracker,
    config: RelocalisationConfig,
) -> Array | None:
    keypoints, ids = world.observed(keyframe)
    known = np.ascontiguousarray(keyframe.features.descriptors[keypoints])
    matches = match_brute_force(features.descriptors, known, config.match)
    if config.match.max_angle_rad is not None:
        turn = (
            features.angles_rad[matches.query]
            - keyframe.features.angles_rad[keypoints[matches.train]]
        )
        matches = consistent_rotation(matches, turn, config.match.max_angle_rad)
    if len(matches) < config.min_matches:
        return None
    found, rotation, t, inliers = cv2.solvePnPRansac(
        world.landmarks.points_world[ids[matches.train]],
        features.pixels[matches.query],
        tracker.camera.K,
        None,
        reprojectionError=config.reprojection_px,
        iterationsCount=200,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < config.min_matches:
        return None
    R_camera_world = cv2.Rodrigues(rotation)[0]
    return make_pose(R_camera_world.T, -R_camera_world.T @ t[:, 0])
