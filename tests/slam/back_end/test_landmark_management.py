"""Landmarks made, fused and culled; keyframes culled."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_view import (
    CAMERA,
    T_NEW_OLD,
    add_keyframe,
    make_features,
    points_before,
    random_descriptors,
)

from bmask_slam.back_end.landmark_management import (
    MappingConfig,
    create_landmarks,
    cull_landmarks,
    fuse_into,
    fuse_into_neighbours,
    redundant_keyframe,
)
from bmask_slam.features.brisk import select
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.local_map import LocalMapConfig, local_landmarks
from bmask_slam.world.world_map import WorldMap

CONFIG = MappingConfig()
TRACKER = Tracker(CAMERA, TrackingConfig())
STEP = se3_exp(np.array([0.0, 0.01, 0.0, 0.03, 0.0, 0.0]))


def scene(views: int, T_world_first: Array | None = None) -> tuple[WorldMap, Array, list[Keyframe]]:
    """Keyframes in a row that all observe the same 60 points, without landmarks."""
    rng = np.random.default_rng(2)
    T = np.eye(4) if T_world_first is None else T_world_first
    points_world = points_before(T, 60, rng)
    descriptors = random_descriptors(60, rng)
    world, keyframes = WorldMap(), []
    for _ in range(views):
        keyframes.append(add_keyframe(world, T, make_features(T, points_world, descriptors)))
        T = T @ STEP
    return world, points_world, keyframes


@pytest.mark.parametrize("T_world_first", [np.eye(4), T_NEW_OLD], ids=["origin", "moved world"])
def test_landmarks_are_made_at_the_measured_depth(T_world_first: Array) -> None:
    world, points_world, (keyframe,) = scene(1, T_world_first)
    keyframe.features.depth_m[:10] = np.nan
    ids = create_landmarks(world, keyframe, CAMERA)
    assert np.allclose(world.landmarks.points_world[ids], points_world[10:], atol=1e-9)
    assert (keyframe.landmark_ids[:10] == -1).all()
    assert len(create_landmarks(world, keyframe, CAMERA)) == 0


def test_new_landmarks_are_fused_with_those_of_neighbours() -> None:
    world, _, (first, second) = scene(2)
    old = create_landmarks(world, first, CAMERA)
    world.attach(second, np.arange(20), old[:20])  # what tracking found
    new = create_landmarks(world, second, CAMERA)
    removed = fuse_into_neighbours(world, second, new, TRACKER, CONFIG)
    assert sorted(removed) == sorted(new)
    assert (second.landmark_ids == old).all()
    assert (world.landmarks.observations[old] == 2).all()


def test_free_keypoints_of_neighbours_observe_the_new_landmarks() -> None:
    world, points_world, (first, second) = scene(2)
    shared = world.make_landmarks(first, np.arange(20), points_world[:20])
    world.attach(second, np.arange(20), shared)
    new = create_landmarks(world, second, CAMERA)
    removed = fuse_into_neighbours(world, second, new, TRACKER, CONFIG)
    assert len(removed) == 0
    assert (first.landmark_ids[20:] == new).all()


def test_a_keyframe_observes_a_landmark_at_one_keypoint() -> None:
    """Another one beside it looks more like the landmark does since; both are within the gate."""
    world, points_world, (first, second, third) = scene(3)
    (landmark,) = ids = world.make_landmarks(first, np.array([0]), points_world[:1])
    second.features = select(second.features, np.r_[0, 0, 2:60])
    second.features.pixels[1, 0] += 0.5
    second.features.descriptors[0] = ~second.features.descriptors[0]
    for keyframe in (second, third):
        world.attach(keyframe, np.array([0]), ids)
    assert not len(fuse_into(world, [second], ids, TRACKER, CONFIG.fuse_radius_px))
    assert np.flatnonzero(second.landmark_ids == landmark).tolist() == [0]
    assert world.landmarks.observations[landmark] == 3


def test_landmarks_rarely_matched_or_observed_once_are_culled() -> None:
    world, _, keyframes = scene(3)
    ids = create_landmarks(world, keyframes[0], CAMERA)
    world.attach(keyframes[1], np.arange(40), ids[:40])
    world.landmarks.visible[ids[:5]] = 100
    world.landmarks.found[ids[:5]] = 10
    culled = cull_landmarks(world, ids, CONFIG)
    assert sorted(culled) == sorted([*ids[:5], *ids[40:]])
    assert not world.landmarks.in_map[culled].any()


def test_a_landmark_that_stood_its_test_is_kept_however_rarely_it_is_matched() -> None:
    world, _, keyframes = scene(2)
    ids = create_landmarks(world, keyframes[0], CAMERA)
    world.attach(keyframes[1], np.arange(60), ids)
    world.landmarks.visible[ids] = 100
    world.landmarks.found[ids] = 10
    world.next_keyframe_id = 1 + CONFIG.probation_keyframes  # the newest keyframe ends the test
    before = world.landmarks.in_map.copy()
    assert sorted(cull_landmarks(world, ids, CONFIG)) == sorted(ids)
    world.landmarks.in_map[:] = before
    world.next_keyframe_id += 1
    assert len(cull_landmarks(world, ids, CONFIG)) == 0


def test_a_new_landmark_is_not_culled_yet() -> None:
    world, _, keyframes = scene(2)
    ids = create_landmarks(world, keyframes[1], CAMERA)
    assert len(cull_landmarks(world, ids, CONFIG)) == 0


def test_only_a_keyframe_without_own_landmarks_is_redundant() -> None:
    world, _, keyframes = scene(5)
    ids = create_landmarks(world, keyframes[0], CAMERA)
    for keyframe in keyframes[1:]:
        world.attach(keyframe, np.arange(60), ids)
    assert redundant_keyframe(world, [keyframes[2]], CONFIG) is keyframes[2]
    alone = ids[50:]
    world.landmarks.observations[alone] = 1
    assert redundant_keyframe(world, [keyframes[2]], CONFIG) is None
    world.landmarks.visible[alone] = 100  # and hardly ever seen again
    assert redundant_keyframe(world, [keyframes[2]], CONFIG) is keyframes[2]
    world.landmarks.visible[ids] = 100
    assert redundant_keyframe(world, [keyframes[2]], CONFIG) is None  # nothing speaks for it


def test_local_map_holds_the_landmarks_of_covisible_keyframes() -> None:
    world, points_world, (first, second) = scene(2)
    a = world.make_landmarks(first, np.arange(40), points_world[:40])
    world.attach(second, np.arange(20), a[:20])
    b = world.make_landmarks(second, np.arange(40, 60), points_world[40:])
    world.landmarks.remove(b[:3])
    local = local_landmarks(world, a[:20], LocalMapConfig())
    assert local.tolist() == sorted([*a, *b[3:]])
