"""Culling of keyframes, with their landmarks, from map and graph."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic_view import CAMERA, add_keyframe, make_features, points_before, random_descriptors

from bmask_slam.back_end.config import BackEndConfig
from bmask_slam.back_end.landmark_management import MappingConfig
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.loops.closing import LoopClosingConfig
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.tracker import Tracker

ALONE = 3
"""Points that each keyframe sees alone."""
STEP = se3_exp(np.array([0.0, 0.01, 0.0, 0.03, 0.0, 0.0]))


def row_of_keyframes(count: int, mapping: MappingConfig) -> Mapper:
    """Keyframes that all observe the same 60 points, and three points of their own each."""
    tracker = Tracker(CAMERA, TrackingConfig())
    rules = BackEndConfig(
        replace(mapping, redundant_share=2.0), loops=LoopClosingConfig(enabled=False)
    )
    mapper = Mapper(CAMERA, tracker, rules)
    rng = np.random.default_rng(5)
    points, descriptors = points_before(np.eye(4), 60, rng), random_descriptors(60, rng)
    T, world, shared = np.eye(4), mapper.world, None
    for k in range(count):
        own = points_before(T, ALONE, rng)
        looks = np.concatenate([descriptors, random_descriptors(ALONE, rng)])
        observed = np.concatenate([points, own])
        keyframe = add_keyframe(world, T, make_features(T, observed, looks))
        if shared is None:
            shared = world.make_landmarks(keyframe, np.arange(60), points)
        else:
            world.attach(keyframe, np.arange(60), shared)
        world.make_landmarks(keyframe, np.arange(60, 60 + ALONE), own)
        mapper.loops.add(keyframe)
        if k == count - 1:
            mapper._mapping = mapping
        mapper.optimise(keyframe)
        T = T @ STEP
    return mapper


def test_the_newest_redundant_keyframe_is_culled_except_the_last_three() -> None:
    mapper = row_of_keyframes(10, MappingConfig())
    expected = [0, 1, 2, 3, 4, 5, 7, 8, 9]
    assert list(mapper.world.keyframes) == expected
    assert mapper.places.keyframe_ids == expected
    assert list(mapper.history.parents) == [6]


def test_no_keyframe_is_culled_with_too_few_other_observations() -> None:
    assert len(row_of_keyframes(10, MappingConfig(redundant_views=10)).world.keyframes) == 10


def test_landmarks_of_only_a_culled_keyframe_are_removed() -> None:
    mapper = row_of_keyframes(10, MappingConfig())
    world = mapper.world
    expected = {i for k in world.keyframes.values() for i in world.observed(k)[1].tolist()}
    assert set(np.flatnonzero(world.landmarks.in_map).tolist()) == expected
    estimate = mapper.smoother.update(mapper._factor_selector.map_update(world))
    assert set(estimate.keyframe_ids.tolist()) == set(world.keyframes)
