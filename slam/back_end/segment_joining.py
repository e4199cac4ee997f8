"""Joining map segments: keyframes after a tracking loss are moved into the older segment."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from bmask_slam.back_end.factors import anchor
from bmask_slam.back_end.map_backend import MapBackend
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_update import RelativePose
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.tracking.relocalisation import RelocalisationConfig
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.covisibility import CovisiblePaths
from bmask_slam.world.world_map import WorldMap


def join_segment(world: WorldMap, segment: int, tracked: Tracked, recognised: Tracked) -> Tracked:
    """Move a segment into the frame of another where one of its frames was recognised.

    ``tracked`` is the frame in the moving segment, ``recognised`` the same frame in the other.
    Landmarks that both hold at one keypoint are fused. Returns the frame with all its landmarks
    in the joined map.
    """
    T_other_segment = recognised.T_world_camera @ inverse(tracked.T_world_camera)
    target = world.segment_of(recognised.landmark_ids)
    move_segment(world, segment, T_other_segment, target)
    both, a, b = np.intersect1d(
        tracked.keypoints, recognised.keypoints, assume_unique=True, return_indices=True
    )
    old, new = tracked.landmark_ids[a], recognised.landmark_ids[b]
    world.replace_landmarks(old[old != new], new[old != new])
    only = ~np.isin(tracked.keypoints, both)
    return replace(
        recognised,
        keypoints=np.concatenate([recognised.keypoints, tracked.keypoints[only]]),
        landmark_ids=np.concatenate([recognised.landmark_ids, tracked.landmark_ids[only]]),
    )


def can_join(
    back_end: MapBackend,
    segment: int,
    tracked: Tracked,
    recognised: Tracked,
    config: RelocalisationConfig,
) -> bool:
    """Whether a camera can have moved as ``join_segment`` would say, between the two segments.

    Of several rooms that look alike each is recognised as easily as the one that the camera is in;
    but between the last frame before a segment and its first keyframe it moved as ``config`` allows
    for a camera that is lost, with the drift of both segments.
    """
    world = back_end.world
    T_other_segment = recognised.T_world_camera @ inverse(tracked.T_world_camera)
    _, nearest = world.covisible(recognised.landmark_ids, 1)[0]
    own = world.in_segment(segment)
    before = [k for k in world.in_segment(nearest.segment) if k.id < own[0].id]
    if not before or not before[-1].timestamp_s < (begin_s := own[0].timestamp_s):
        return True  # there is none, or it is of another recording
    frames = back_end.history.path(world, nearest.segment, before[-1].timestamp_s, begin_s)
    stamps_s = np.append(before[-1].timestamp_s, frames.timestamps_s)
    poses = np.concatenate([before[-1].T_world_camera[None], frames.poses_world_camera])
    last = np.flatnonzero(stamps_s < begin_s)[-1]
    gap_s = begin_s - stamps_s[last]
    moved = T_other_segment @ own[0].T_world_camera - poses[last]
    paths = CovisiblePaths(world)
    ways_m = paths.length_m(own[0].id, own[-1].id) + paths.length_m(before[-1].id, nearest.id)
    return bool(np.linalg.norm(moved[:3, 3]) < config.reach_m(gap_s, ways_m))


def move_segment(world: WorldMap, segment: int, T_other_segment: Array, target: int) -> None:
    """Move all keyframes and landmarks of a segment rigidly; it becomes part of the target."""
    landmarks = world.landmarks
    moving = world.in_segment(segment)
    hosts = np.array([k.id for k in moving])
    ids = np.flatnonzero(np.isin(landmarks.host, hosts) & landmarks.in_map)
    landmarks.points_world[ids] = transform(T_other_segment, landmarks.points_world[ids])
    R_other_segment = T_other_segment[:3, :3]
    landmarks.directions[ids] = landmarks.directions[ids] @ R_other_segment.T
    landmarks.patch_views[ids] = landmarks.patch_views[ids] @ R_other_segment.T
    for keyframe in moving:
        keyframe.T_world_camera = T_other_segment @ keyframe.T_world_camera
        keyframe.segment = target


def anchors(world: WorldMap, config: SmootherConfig) -> tuple[RelativePose, ...]:
    """Weak poses between each keyframe and the next of its segment, for a graph that is built anew.

    Where segments have few landmarks in common, or a keyframe was anchored before, landmarks alone
    would not connect all keyframes, and the graph would refuse some.
    """
    return tuple(
        anchor(a, b, config)
        for segment in sorted({keyframe.segment for keyframe in world.keyframes.values()})
        for a, b in pairwise(world.in_segment(segment))
    )
