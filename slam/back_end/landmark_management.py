"""Landmarks and keyframes over time: how they are made, fused and culled."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from bmask_slam.back_end.triangulation import TriangulationConfig
from bmask_slam.features.matching import Matches, WindowIndex
from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.tracking.pose.pose_optimisation import CHI2_2DOF, CHI2_3DOF, residuals
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.covisibility import MIN_SHARED
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.landmark_table import Patches
from bmask_slam.world.local_map import LocalMapConfig, local_landmarks
from bmask_slam.world.world_map import WorldMap


@dataclass(frozen=True)
class MappingConfig:
    """How many landmarks are made and which are kept.

    ``fuse_neighbours`` covisible keyframes are searched for the new landmarks. A landmark is
    culled if, up to ``probation_keyframes`` after it was made, it was found in less than
    ``min_found_ratio`` of the frames that should have seen it, or if from then on fewer than
    ``min_observations`` keyframes see it; at once if none does. Later it is kept however rarely it
    is found (ORB-SLAM, section VI.B): where the map has more points in view than a frame has
    keypoints, good landmarks are found rarely too, and a room that is seen again would be mapped
    again.
    A keyframe is redundant if ``redundant_share`` of its landmarks are seen by at least
    ``redundant_views`` others; landmarks that are found more rarely than ``min_found_ratio`` do
    not count.
    """

    local_map: LocalMapConfig = field(default_factory=LocalMapConfig)
    fuse_neighbours: int = 5
    fuse_radius_px: float = 4.0
    min_found_ratio: float = 0.25
    probation_keyframes: int = 2
    min_observations: int = 2
    redundant_share: float = 0.9
    redundant_views: int = 3
    triangulation: TriangulationConfig = field(default_factory=TriangulationConfig)


def create_landmarks(
    world: WorldMap, keyframe: Keyframe, camera: Camera, new_ids: Ints | None = None
) -> Ints:
    """Landmarks from every keypoint of a keyframe that has depth and no landmark yet; their ids.

    ``new_ids`` are as of ``Tracked``.
    """
    features = keyframe.features
    free = np.flatnonzero(keyframe.free & np.isfinite(features.depth_m))
    points = camera.backproject(features.pixels[free], features.depth_m[free])
    points_world = transform(keyframe.T_world_camera, points)
    given = new_ids[free] if new_ids is not None and len(new_ids) else None
    ids = world.make_landmarks(keyframe, free, points_world, given)
    return ids[ids >= 0]


def fuse_into_neighbours(
    world: WorldMap, keyframe: Keyframe, new_ids: Ints, tracker: Tracker, config: MappingConfig
) -> Ints:
    """Search a keyframe's new landmarks in its covisible neighbours; returns the ids removed."""
    _, tracked = world.observed(keyframe)
    neighbours = [k for _, k in world.covisible(tracked, MIN_SHARED) if k is not keyframe]
    return fuse_into(
        world, neighbours[: config.fuse_neighbours], new_ids, tracker, config.fuse_radius_px
    )


def fuse_into_surroundings(
    world: WorldMap, keyframe: Keyframe, tracker: Tracker, config: MappingConfig
) -> Ints:
    """Search the landmarks around a keyframe that it does not observe in it; the ids removed."""
    _, observed = world.observed(keyframe)
    known = np.setdiff1d(local_landmarks(world, observed, config.local_map), observed)
    return fuse_into(world, [keyframe], known, tracker, config.fuse_radius_px)


def restore_observations(
    world: WorldMap,
    keyframe: Keyframe,
    keypoints: Ints,
    patches: Patches,
    tracker: Tracker,
    config: MappingConfig,
) -> Ints:
    """Unmask keypoints (N,) of a keyframe; they observe landmarks there are, or new ones.

    Either get the patches (N) unless they have some. Returns the ids that were fused.
    """
    world.unmask(keyframe, keypoints)
    fused = fuse_into_surroundings(world, keyframe, tracker, config)
    create_landmarks(world, keyframe, tracker.camera)
    ids = keyframe.landmark_ids[keypoints]
    world.landmarks.give_patches(ids[ids >= 0], patches[ids >= 0])
    return fused


def fuse_into(
    world: WorldMap, keyframes: list[Keyframe], ids: Ints, tracker: Tracker, radius_px: float
) -> Ints:
    """Search landmarks in further keyframes.

    A free keypoint there becomes one more observation, unless the keyframe observes the landmark
    already: one landmark has one place in an image. One that has another landmark shows a
    duplicate, and the younger is fused into the older. Returns the ids removed.
    """
    removed = [np.zeros(0, np.int64)]
    for keyframe in keyframes:
        candidates = world.landmarks.remaining(ids)
        visible, matches = consistent_matches(world, keyframe, candidates, tracker, radius_px)
        matched, old_ids = visible[matches.query], keyframe.landmark_ids[matches.train]
        old = old_ids >= 0
        old[old] = world.landmarks.in_map[old_ids[old]]
        new = ~old & ~np.isin(matched, keyframe.landmark_ids)
        world.attach(keyframe, matches.train[new], matched[new])
        pairs = np.sort(np.stack([matched[old], old_ids[old]], axis=1), axis=1)
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        if len(pairs):
            removed.append(world.replace_landmarks(pairs[:, 1], pairs[:, 0]))
    return np.concatenate(removed)


def consistent_matches(
    world: WorldMap, keyframe: Keyframe, ids: Ints, tracker: Tracker, radius_px: float
) -> tuple[Ints, Matches]:
    """Matches of landmarks in a keyframe that also pass the chi-square gate at its pose."""
    features, T = keyframe.features, keyframe.T_world_camera
    index = WindowIndex(features.pixels)
    visible, matches = tracker.search(features, index, T, ids, radius_px, world.landmarks)
    points = world.landmarks.points_world[visible[matches.query]]
    measured = features.measurements[matches.train]
    r, _ = residuals(T, points, measured, tracker.camera)
    whitened = r / features.sigmas_px[matches.train]
    chi2 = np.nansum(whitened**2, axis=1)
    gate = np.where(np.isfinite(measured[:, 2]), CHI2_3DOF, CHI2_2DOF)
    return visible, matches[chi2 < gate]


def cull_landmarks(world: WorldMap, candidates: Ints, config: MappingConfig) -> Ints:
    """Remove the candidates that are new and rarely found, or seen by few keyframes; their ids."""
    landmarks = world.landmarks
    ids = landmarks.remaining(candidates)
    age, views = world.next_keyframe_id - 1 - landmarks.host[ids], landmarks.observations[ids]
    rarely = landmarks.rarely_found(ids, config.min_found_ratio)
    rarely &= age <= config.probation_keyframes
    few = (age >= config.probation_keyframes) & (views < config.min_observations)
    culled = ids[rarely | few | (views == 0)]
    landmarks.remove(culled)
    return culled


def fuse_loops(
    world: WorldMap,
    loops: list[LoopConstraint],
    tracker: Tracker,
    config: MappingConfig,
    keyframes: int,
) -> Ints:
    """Fuse the landmarks of both sides of loops: their own pairs, then by projection.

    ``keyframes`` of the newer side are searched. Returns the ids removed.
    """
    old_ids, new_side = loop_sides(
        world, [loop.ends for loop in loops], keyframes, config.local_map
    )
    removed = []
    for loop in loops:
        pairs = np.sort(loop.landmark_pairs, axis=1)
        pairs = pairs[world.landmarks.in_map[pairs].all(axis=1) & (pairs[:, 0] != pairs[:, 1])]
        removed.append(world.replace_landmarks(pairs[:, 1], pairs[:, 0]))
    removed.append(fuse_into(world, new_side, old_ids, tracker, config.fuse_radius_px))
    return np.concatenate(removed)


def loop_sides(
    world: WorldMap, loops: list[tuple[int, int]], keyframes: int, config: LocalMapConfig
) -> tuple[Ints, list[Keyframe]]:
    """Landmarks (N,) around the older ends of loops, and keyframes around their newer ends.

    Of each newer end the ``keyframes`` that share most with it.
    """
    old_ids, new_side = [], {}
    for older, newer in loops:
        _, seen = world.observed(world.keyframes[older])
        old_ids.append(local_landmarks(world, seen, config))
        _, seen = world.observed(world.keyframes[newer])
        near = world.covisible(seen, config.min_shared)[:keyframes]
        new_side.update({k.id: k for _, k in near})
    return np.unique(np.concatenate(old_ids)), [new_side[k] for k in sorted(new_side)]


def remove_redundant(world: WorldMap, history: FrameHistory, keyframe: Keyframe) -> Ints:
    """Remove a keyframe; its frames follow the one that shares most. The landmarks it observed."""
    _, ids = world.observed(keyframe)
    near = (k for _, k in world.covisible(ids, 1))
    others = chain(near, reversed(world.keyframes.values()))
    parent = next(k for k in others if k is not keyframe)
    T_parent_keyframe = inverse(parent.T_world_camera) @ keyframe.T_world_camera
    history.hand_over(keyframe.id, parent.id, T_parent_keyframe)
    world.remove_keyframe(keyframe, parent)
    return ids


def redundant_keyframe(
    world: WorldMap, candidates: list[Keyframe], config: MappingConfig
) -> Keyframe | None:
    """The first candidate whose landmarks are nearly all seen by enough others, or None.

    Landmarks that are rarely found say little of what the others see in its place.
    """
    for keyframe in candidates:
        _, ids = world.observed(keyframe)
        ids = ids[~world.landmarks.rarely_found(ids, config.min_found_ratio)]
        if len(ids) == 0:
            continue
        often = world.landmarks.observations[ids] > config.redundant_views
        if often.mean() > config.redundant_share:
            return keyframe
    return None
