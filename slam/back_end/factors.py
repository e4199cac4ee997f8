"""What the map holds, as factors: observations of keyframes, priors of segments, anchors."""

from __future__ import annotations

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.factors.graph_update import (
    Observations,
    RelativePose,
    concatenate,
)
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.smoother.anchoring import anchor_between
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap


def anchor(a: Keyframe, b: Keyframe, config: SmootherConfig) -> RelativePose:
    """A weak pose of keyframe b in keyframe a, as the map has it.

    The smoother releases it when it is not needed.
    """
    return anchor_between(a.id, b.id, np.stack([a.T_world_camera, b.T_world_camera]), config)


def sent_observations(world: WorldMap, depth_factor: float) -> Observations:
    """Every observation that was sent to the graph, as the keyframes' features have it now."""
    parts = []
    for keyframe in world.keyframes.values():
        rows = np.flatnonzero(
            (keyframe.sent_ids >= 0) & (keyframe.sent_ids == keyframe.landmark_ids)
        )
        parts.append(observations_of(keyframe, rows, keyframe.sent_ids[rows], depth_factor))
    return concatenate(parts)


def observations_of(
    keyframe: Keyframe, keypoints: Ints, landmark_ids: Ints, depth_factor: float = 1.0
) -> Observations:
    """The graph's observations of some keypoints of a keyframe."""
    return observations_in(keyframe.id, keyframe.features, keypoints, landmark_ids, depth_factor)


def observations_in(
    number: int, features: Features, keypoints: Ints, landmark_ids: Ints, depth_factor: float
) -> Observations:
    """The same of the features of a frame, which is keyframe ``number`` in them."""
    return Observations(
        keyframe_ids=np.full(len(keypoints), number),
        landmark_ids=landmark_ids,
        measurements=stereo_measurements(features, keypoints),
        sigmas_px=quantised(features.sigmas_px[keypoints] * [1.0, 1.0, depth_factor]),
    )


def quantised(sigmas_px: Array) -> Array:
    """Sigmas rounded to powers of 2^(1/3), so that factors can share noise models."""
    return np.exp2(np.round(3 * np.log2(sigmas_px)) / 3)


def stereo_measurements(features: Features, keypoints: Ints) -> Array:
    """(N, 3) of u_left, v, u_right = u_left - disparity; u_right NaN without depth."""
    pixels = features.pixels[keypoints]
    return np.column_stack([pixels, pixels[:, 0] - features.disparity_px[keypoints]])
