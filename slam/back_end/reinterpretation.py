"""Observations of keyframes as another camera gives them: readout, delay and bend of depth."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bmask_slam.back_end.factor_selection import read_back
from bmask_slam.back_end.factors import sent_observations
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.camera import Camera
from bmask_slam.tracking.rolling_shutter import Motion, after_mean_row_s, at_one_moment, velocities
from bmask_slam.world.frame_observations import FrameObservations
from bmask_slam.world.keyframe import Keyframe

logger = logging.getLogger(__name__)

MAX_CHANGE = 0.1
"""A larger relative change of the depth by the delay is an error."""


@dataclass(frozen=True, eq=False)
class KeyframeMotion:
    """What a keyframe's observations are interpreted anew by.

    Attributes:
        twist: (6,) of the camera in its own frame [rad/s, m/s].
        keypoints: (N,) whose depth changes.
        inverse_depth_change: (N,) 1/m, to be added.
    """

    twist: Array
    keypoints: Ints = field(default_factory=no_ids)
    inverse_depth_change: Array = field(default_factory=lambda: np.zeros(0))


def use_camera(mapper: Mapper, camera: Camera, motions: Mapping[int, KeyframeMotion]) -> None:
    """Let a map go on with another camera; keyframes of known motion follow it."""
    keyframes = mapper.world.keyframes
    for number in sorted(motions.keys() & keyframes.keys()):
        reinterpret(keyframes[number], motions[number], mapper.camera, camera)
        mapper.world.store_features(keyframes[number])
    mapper.camera = camera
    observations = sent_observations(mapper.world, camera.graph_depth_factor)
    estimate = mapper.smoother.remeasure(camera, observations)
    for note in estimate.notes():
        logger.info("graph: %s", note)
    read_back(mapper.world, estimate)


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
    known = Motion(motion.twist, 0.0)
    depth_m = _as_exposed_m(features, motion.twist, old)
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
