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
from bmask_slam.tracking.motion_model import MotionModel
from bmask_slam.tracking.results import Tracked, TrackingStatus
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.covisibility import CovisiblePaths
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.local_map import LocalMapConfig, local_landmarks
from bmask_slam.world.map_editor import MapReader
from bmask_slam.world.world_map import WorldMap


@dataclass(frozen=True)
class RelocalisationConfig:
    """``candidates`` keyframes with the most votes, at least ``min_votes``, are tried.

    A pose needs ``min_inliers``, and must be within reach of the last one: ``near_m``, what
    ``max_speed_m_s`` allows, and ``drift_m_per_m`` of the way through the map between the two.
    After ``patience_frames`` lost frames a new map segment is begun, if the frame has
    ``min_new_points`` with depth.
    """

    candidates: int = 4
    min_votes: float = 2.0
    min_matches: int = 15
    min_inliers: int = 30
    reprojection_px: float = 4.0
    patience_frames: int = 10
    min_new_points: int = 100
    near_m: float = 0.5
    max_speed_m_s: float = 3.0
    drift_m_per_m: float = 0.05
    match: MatchConfig = field(
        default_factory=lambda: MatchConfig(max_distance=110, ratio=0.85, max_angle_rad=0.5)
    )

    def reach_m(self, time_s: float, way_m: float = 0.0) -> float:
        """How far a lost camera can have come in a time, over a way through the map."""
        return self.near_m + self.max_speed_m_s * time_s + self.drift_m_per_m * way_m


def relocalise(
    features: Features,
    keyframes: list[Keyframe],
    map_reader: MapReader,
    tracker: Tracker,
    config: RelocalisationConfig,
    local_map: LocalMapConfig,
) -> Tracked | None:
    """The frame tracked against the most similar of the keyframes that fits; None if none does.

    Descriptors are matched without a prior, the pose is found by P3P in RANSAC (OpenCV, whose
    random numbers are seeded, so that runs repeat), then refined on that keyframe's local map.
    """
    world = map_reader.world
    similar = similar_keyframes(features, keyframes, map_reader.places, config.min_votes)
    for keyframe in similar[: config.candidates]:
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


def is_within_reach(
    motion: MotionModel,
    T_world_camera: Array,
    world: WorldMap,
    ends: tuple[Keyframe, Keyframe | None],
    config: RelocalisationConfig,
) -> bool:
    """Whether the camera can be at a pose (4, 4) after its last one, for all that the map drifts.

    Of several rooms that look alike each is recognised as easily as the one that the camera is in.
    ``ends`` are the keyframes near the pose and near the last one. All is within reach where there
    is no last one.
    """
    moved_m = np.linalg.norm(T_world_camera[:3, 3] - motion.T_world_last[:3, 3])
    if not moved_m > config.reach_m(motion.ago_s) or ends[1] is None:  # NaN: no time of a last pose
        return True
    way_m = CovisiblePaths(world).length_m(ends[0].id, ends[1].id)
    return bool(moved_m < config.reach_m(motion.ago_s, way_m))


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
