"""Finding the camera without a prior on a textured plane."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane

from bmask_slam.back_end.landmark_management import create_landmarks
from bmask_slam.features.brisk import BriskExtractor, FeatureConfig
from bmask_slam.features.descriptor_index import DescriptorIndex
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.motion_model import MotionModel
from bmask_slam.tracking.relocalisation import (
    RelocalisationConfig,
    is_within_reach,
    relocalise,
    similar_keyframes,
)
from bmask_slam.tracking.results import Tracked
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.local_map import LocalMapConfig
from bmask_slam.world.world_map import WorldMap

EXTRACTOR = BriskExtractor(CAMERA, FeatureConfig())
TRACKER = Tracker(CAMERA, TrackingConfig())
RULES = (RelocalisationConfig(), LocalMapConfig())


def at(x_m: float, turn_rad: float = 0.0) -> Array:
    return se3_exp(np.array([0, 0, 0, x_m, 0, 0])) @ se3_exp(np.array([0, 0, turn_rad, 0, 0, 0]))


@pytest.fixture(scope="module")
def world() -> WorldMap:
    """Two keyframes 2.4 m apart, with landmarks."""
    world = WorldMap()
    for x_m in (-1.2, 1.2):
        features = EXTRACTOR.extract(render_plane(at(x_m)))
        number = world.next_keyframe_id
        ids = np.full(len(features), -1, np.int64)
        keyframe = Keyframe(number, number, float(number), 0, at(x_m), features, ids)
        world.add_keyframe(keyframe)
        create_landmarks(world, keyframe, CAMERA)
        world.renew_patches(keyframe, TRACKER.config.subpixel)
    return world


def places(world: WorldMap) -> DescriptorIndex:
    index = DescriptorIndex()
    for keyframe in world.keyframes.values():
        index.add(keyframe.id, keyframe.features.descriptors)
    return index


def find(world: WorldMap, T_world_camera: Array) -> Tracked | None:
    features = EXTRACTOR.extract(render_plane(T_world_camera))
    known: Any = SimpleNamespace(world=world, places=places(world))
    return relocalise(features, list(world.keyframes.values()), known, TRACKER, *RULES)


@pytest.mark.parametrize("turn_rad", [0.0, 0.5])
@pytest.mark.parametrize("x_m", [-1.0, 1.3])
def test_a_known_place_is_found(world: WorldMap, x_m: float, turn_rad: float) -> None:
    T_world_camera = at(x_m, turn_rad)
    tracked = find(world, T_world_camera)
    assert tracked is not None
    error = se3_log(inverse(T_world_camera) @ tracked.T_world_camera)
    assert np.abs(error[:3]).max() < 0.003
    assert np.abs(error[3:]).max() < 0.005


def test_an_unknown_place_is_not_found(world: WorldMap) -> None:
    other_pose = se3_exp(np.array([0, 0, 0, 0.0, 2.2, 0.5]))
    assert find(world, other_pose) is None


def test_the_most_similar_keyframe_comes_first(world: WorldMap) -> None:
    features = EXTRACTOR.extract(render_plane(at(1.0)))
    keyframes = list(world.keyframes.values())
    assert similar_keyframes(features, keyframes, places(world), 2.0)[0].id == 1


@pytest.mark.parametrize(
    ("lost_s", "x_m", "reached"),
    [(0.1, 0.9, True), (0.1, 1.2, False), (0.5, 1.2, True), (0.5, 2.4, False), (1.0, 2.4, True)],
)
def test_a_pose_is_within_reach_by_speed_and_drift(
    world: WorldMap, lost_s: float, x_m: float, reached: bool
) -> None:
    """0.5 m, 3 m/s, and 5 % of the 2.4 m between the keyframes."""
    near, far = world.keyframes.values()
    motion = MotionModel()
    assert is_within_reach(motion, at(9.0), world, (near, far), RULES[0])  # there is no last pose
    motion.now_s = 5.0
    motion.advance(at(0.0), at(0.0), steady=True)
    motion.now_s = 5.0 + lost_s
    assert is_within_reach(motion, at(x_m), world, (near, far), RULES[0]) == reached
    assert is_within_reach(motion, at(x_m), world, (near, None), RULES[0])
