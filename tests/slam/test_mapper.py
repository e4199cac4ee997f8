"""Which keyframes leave map and graph, and what leaves with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_view import CAMERA, add_keyframe, make_features, points_before, random_descriptors

from graph.geometry import se3_exp
from graph.smoother_config import SmootherConfig
from slam.graph_feed import GraphFeedConfig
from slam.local_mapping import MappingConfig
from slam.loop_closing import LoopClosingConfig
from slam.mapper import Mapper
from slam.tracker import Tracker, TrackingConfig

ALONE = 3
"""Points that each keyframe sees alone."""
STEP = se3_exp(np.array([0.0, 0.01, 0.0, 0.03, 0.0, 0.0]))


def row_of_keyframes(count: int, mapping: MappingConfig) -> Mapper:
    """Keyframes that all see the same 60 points, each of them three more of its own."""
    tracker = Tracker(CAMERA, TrackingConfig())
    rules = (replace(mapping, redundant_share=2.0), GraphFeedConfig(), SmootherConfig())
    mapper = Mapper(CAMERA, tracker, (*rules, LoopClosingConfig(enabled=False)))
    rng = np.random.default_rng(5)
    points, descriptors = points_before(np.eye(4), 60, rng), random_descriptors(60, rng)
    T, world, shared = np.eye(4), mapper.world, None
    for k in range(count):
        own = points_before(T, ALONE, rng)
        looks = np.concatenate([descriptors, random_descriptors(ALONE, rng)])
        seen = np.concatenate([points, own])
        keyframe = add_keyframe(world, T, make_features(T, seen, looks))
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


@pytest.mark.parametrize("limit", [1, 3])
def test_younger_redundant_keyframes_leave_first_and_only_so_many_at_a_time(limit: int) -> None:
    mapper = row_of_keyframes(10, MappingConfig(max_culled=limit))
    expected = [k for k in range(10) if not 6 - limit < k <= 6]
    assert list(mapper.world.keyframes) == expected  # of 1 to 6; 7 to 9 are too new
    assert mapper.places.keyframe_ids == expected
    assert list(mapper.history.heirs) == [6, 5, 4][:limit]


def test_culling_stops_where_too_few_others_see_the_landmarks() -> None:
    mapper = row_of_keyframes(6, MappingConfig(max_culled=9, redundant_views=3))
    assert len(mapper.world.keyframes) == 4  # a landmark then has three others no more
    assert 0 in mapper.world.keyframes


def test_landmarks_of_a_culled_keyframe_alone_leave_with_it() -> None:
    mapper = row_of_keyframes(10, MappingConfig(max_culled=3))
    world = mapper.world
    held = {i for k in world.keyframes.values() for i in world.observed(k)[1].tolist()}
    assert set(np.flatnonzero(world.landmarks.alive).tolist()) == held
    newest = row_of_keyframes(11, MappingConfig(max_culled=3))
    update = newest.smoother.update(newest._feed.map_update(newest.world))
    assert set(update.keyframe_ids.tolist()) == set(newest.world.keyframes)
