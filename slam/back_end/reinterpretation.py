"""Observations of keyframes as another camera gives them: readout, delay and bend of depth."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bmask_slam.back_end.factor_selection import read_back
from bmask_slam.back_end.factors import sent_observations
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.features.brisk import Features, select
from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.tracking.pose.pose_optimisation import optimise_pose
from bmask_slam.tracking.pose.rolling_shutter import (
    CameraVelocity,
    PreviousPose,
    after_mean_row_s,
    at_one_moment,
    velocities,
)
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.frame_observations import FrameObservations
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

MAX_CHANGE = 0.1
"""A larger relative change of the depth by the delay is an error."""
BEGINNING_ROUNDS = 4
"""Each leaves about a third of the error of the motion."""


@dataclass(frozen=True, eq=False)
class KeyframeMotion:
    """What a keyframe's observations are interpreted anew by.

    Attributes:
        twist: (6,) of the camera in its own frame [rad/s, m/s].
        keypoints: (N,) whose depth changes.
        inverse_depth_change: (N,) 1/m, to be added.
        was: (6,) the twist that the observations were made by; None: the same.
    """

    twist: Array
    keypoints: Ints = field(default_factory=no_ids)
    inverse_depth_change: Array = field(default_factory=lambda: np.zeros(0))
    was: Array | None = None


@dataclass(frozen=True, eq=False)
class Beginning:
    """What the second frame of a segment tells about the keyframe that began it.

    Attributes:
        motion: of the keyframe, which was made as of a camera at rest.
        second: the second frame, tracked by the keyframe as it is in that motion.
    """

    motion: KeyframeMotion
    second: Tracked


def beginning(
    world: WorldMap,
    keyframe: Keyframe,
    previous: PreviousPose,
    tracked: Tracked,
    camera: Camera,
) -> Beginning | None:
    """One motion for the keyframe that began a segment and the frame that was tracked after it.

    Nothing was known of the keyframe's motion, so that a rolling shutter has bent its landmarks,
    and with them the pose of the frame after it. Both are interpreted anew by the motion between
    them until that changes no more. None where no pose fits that.
    """
    points = world.landmarks.points_world[tracked.landmark_ids]
    points = transform(inverse(keyframe.T_world_camera), points)  # which only the keyframe has seen
    mean_s = camera.exposed_after_s(keyframe.features.image_pixels[:, 1]).mean()
    later_s = camera.exposed_after_s(camera.project_distorted(points)[:, 1]) - mean_s
    T, taken = tracked.T_world_camera, previous.twist_to(tracked.T_world_camera)
    for _ in range(BEGINNING_ROUNDS):
        twist = previous.twist_to(T)
        still = points - later_s[:, None] * velocities(points, twist)
        second = reinterpreted(tracked.features, KeyframeMotion(twist, was=taken), camera, camera)
        matched = select(second, tracked.keypoints)
        estimate = optimise_pose(
            T,
            transform(keyframe.T_world_camera, still),
            matched.measurements,
            matched.sigmas_px,
            camera,
        )
        if not estimate.ok:
            return None
        T = estimate.T_world_camera
    motion = KeyframeMotion(twist, was=np.zeros(6))
    return Beginning(motion, replace(tracked, T_world_camera=T, features=second))


def use_camera(mapper: Mapper, camera: Camera, motions: Mapping[int, KeyframeMotion]) -> None:
    """Let a map go on with another camera; keyframes of known motion follow it."""
    keyframes = mapper.world.keyframes
    known = [keyframes[number] for number in sorted(motions.keys() & keyframes.keys())]
    for keyframe in known:
        reinterpret(keyframe, motions[keyframe.id], mapper.camera, camera)
        mapper.world.store_features(keyframe)
    mapper.camera = camera
    observations = sent_observations(mapper.world, camera.graph_depth_factor)
    estimate = mapper.smoother.remeasure(camera, observations)
    for note in estimate.notes():
        logger.info("graph: %s", note)
    read_back(mapper.world, estimate)
    for keyframe in known:
        _place_landmarks(mapper.world, keyframe, camera)


def _place_landmarks(world: WorldMap, keyframe: Keyframe, camera: Camera) -> None:
    """Put the landmarks that only this keyframe has seen where its features have them now."""
    rows, ids = world.observed(keyframe)
    landmarks, features = world.landmarks, keyframe.features
    alone = (landmarks.observations[ids] == 1) & ~landmarks.in_graph[ids]
    alone &= np.isfinite(features.depth_m[rows])
    points = camera.backproject(features.pixels[rows[alone]], features.depth_m[rows[alone]])
    landmarks.points_world[ids[alone]] = transform(keyframe.T_world_camera, points)


def reinterpret_frames(
    frames: FrameObservations, motions: Mapping[float, KeyframeMotion], old: Camera, new: Camera
) -> None:
    """The same for frames that are no keyframes, by stamp; those of unknown motion are dropped."""
    bf = old.stereo_bf_px_m
    frames.views = [
        view.seen_as(reinterpreted(view.features(bf), motions[view.timestamp_s], old, new))
        for view in frames.views
        if view.timestamp_s in motions
    ]


def reinterpret(keyframe: Keyframe, motion: KeyframeMotion, old: Camera, new: Camera) -> None:
    """Give a keyframe the features that tracking with another camera would have made of it.

    What it observes stays.
    """
    keyframe.features = reinterpreted(keyframe.features, motion, old, new)


def reinterpreted(features: Features, motion: KeyframeMotion, old: Camera, new: Camera) -> Features:
    """The features that tracking with another camera would have made of the same keypoints.

    They were moved to one moment by the readout time of the old camera, and begin at their places
    in the image again.
    """
    known = CameraVelocity(motion.twist, 0.0)
    was = motion.twist if motion.was is None else motion.was
    depth_m = _as_exposed_m(features, was, old)
    pixels = features.image_pixels
    depth_m /= 1 + depth_m * (old.depth_bend(pixels) - new.depth_bend(pixels))
    rows, change = motion.keypoints, motion.inverse_depth_change
    share = depth_m[rows] * change
    usable = np.abs(share) < MAX_CHANGE  # False for NaN
    depth_m[rows[usable]] /= 1 + share[usable]
    depth_m[~((depth_m > 0) & (depth_m < np.inf))] = np.nan  # bent beyond infinity
    raw = replace(
        features,
        pixels=new.undistort(pixels),
        depth_m=depth_m,
        disparity_px=new.stereo_bf_px_m / depth_m,
    )
    return at_one_moment(raw, new, known if new.rolling_shutter_s else None)


def _as_exposed_m(features: Features, twist: Array, camera: Camera) -> Array:
    """Depths (N,) at the time when each row was exposed; what ``at_one_moment`` made is undone."""
    if not camera.rolling_shutter_s:
        return features.depth_m.copy()
    points = camera.backproject(features.pixels, features.depth_m)
    later_s = after_mean_row_s(features, camera)
    return np.asarray(points[:, 2] + later_s * velocities(points, twist)[:, 2])
