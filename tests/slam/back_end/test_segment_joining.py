"""Joining two map segments that were made in different frames."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

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

from bmask_slam.back_end.config import BackEndConfig
from bmask_slam.back_end.landmark_management import MappingConfig
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.back_end.segment_joining import can_join, join_segment
from bmask_slam.features.brisk import Features
from bmask_slam.graph.factors.graph_update import (
    ANCHOR,
    GRAVITY,
    ODOMETRY,
    GraphUpdate,
    PosePrior,
    RelativePose,
    reference_frame_id,
)
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.graph.inertial.tables import ImuModel, InertialFactor, InertialUpdate
from bmask_slam.sensing.reference_frame import RETIRED_FRAME
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.relocalisation import RelocalisationConfig
from bmask_slam.tracking.results import Tracked, TrackingStatus
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.world_map import WorldMap

T_WORLD_FIRST = se3_exp(np.array([0.1, 0.2, -0.1, 0.3, 0.0, 0.2]))
T_WORLD_SECOND = T_WORLD_FIRST @ se3_exp(np.array([0.02, -0.03, 0.01, 0.1, 0.0, 0.05]))
T_SEGMENT_WORLD = T_NEW_OLD


def tracked(T: np.ndarray, features: Features, keypoints: np.ndarray, ids: np.ndarray) -> Tracked:
    nothing = np.zeros(0, np.int64)
    count = len(ids)
    return Tracked(TrackingStatus.OK, T, features, keypoints, ids, count, nothing, np.zeros((6, 6)))


def two_segments() -> tuple[WorldMap, np.ndarray, Features]:
    """Segment 0 in the world frame and segment 1 in its own, with the same 40 points."""
    rng = np.random.default_rng(8)
    points_world = points_before(T_WORLD_FIRST, 40, rng)
    descriptors = random_descriptors(40, rng)
    world = WorldMap()
    first = make_features(T_WORLD_FIRST, points_world, descriptors)
    second = make_features(T_WORLD_SECOND, points_world, descriptors)
    a = add_keyframe(world, T_WORLD_FIRST, first)
    world.make_landmarks(a, np.arange(30), points_world[:30])
    b = add_keyframe(world, T_SEGMENT_WORLD @ T_WORLD_SECOND, second, segment=1)
    world.make_landmarks(b, np.arange(10, 40), transform(T_SEGMENT_WORLD, points_world[10:]))
    return world, points_world, second


def joined_map() -> tuple[WorldMap, np.ndarray, Tracked]:
    world, points_world, features = two_segments()
    in_segment = tracked(
        T_SEGMENT_WORLD @ T_WORLD_SECOND, features, np.arange(10, 40), np.arange(30, 60)
    )
    recognised = tracked(T_WORLD_SECOND, features, np.arange(30), np.arange(30))
    return world, points_world, join_segment(world, 1, in_segment, recognised)


def test_keyframes_and_landmarks_move_to_the_joined_frame() -> None:
    world, points_world, _ = joined_map()
    assert [k.segment for k in world.keyframes.values()] == [0, 0]
    assert np.allclose(world.keyframes[1].T_world_camera, T_WORLD_SECOND)
    in_map = np.flatnonzero(world.landmarks.in_map)
    number = np.where(in_map < 30, in_map, in_map - 20)
    assert np.allclose(world.landmarks.points_world[in_map], points_world[number])


def test_viewing_directions_rotate_with_the_segment() -> None:
    world, points_world, _ = joined_map()
    towards = T_WORLD_SECOND[:3, 3] - points_world[30:]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    assert np.allclose(world.landmarks.directions[50:60], towards)


def test_landmarks_at_one_keypoint_are_fused() -> None:
    world, _, joined = joined_map()
    assert world.landmarks.in_map.sum() == 40
    assert (world.landmarks.observations[10:30] == 2).all()
    assert sorted(joined.keypoints) == list(range(40))
    by_keypoint = dict(zip(joined.keypoints.tolist(), joined.landmark_ids.tolist(), strict=True))
    assert [by_keypoint[k] for k in (5, 15, 35)] == [5, 15, 55]
    assert np.allclose(joined.T_world_camera @ inverse(T_WORLD_SECOND), np.eye(4))


@pytest.mark.parametrize(
    ("gap_s", "apart_m", "possible"),
    [
        (0.1, 0.2, True),
        (0.1, 3.0, False),
        (1.5, 3.0, True),
        (-60.0, 3.0, True),
        (0.0, 3.0, True),
        (np.nan, 3.0, True),
    ],
)
def test_segments_are_joined_where_the_camera_can_have_come_in_time(
    gap_s: float, apart_m: float, possible: bool
) -> None:
    """0.5 m, and 3 m/s; stamps that do not go on, or are unknown, are of another recording."""
    world, _, second = two_segments()
    old, new = world.keyframes.values()
    new.timestamp_s = old.timestamp_s + gap_s
    own_rows, own_ids = world.observed(new)
    known_rows, known_ids = world.observed(old)
    T_here = T_WORLD_FIRST @ se3_exp(np.array([0, 0, 0, apart_m, 0, 0]))
    own = tracked(new.T_world_camera, second, own_rows, own_ids)
    found = tracked(T_here, second, known_rows, known_ids)
    history = FrameHistory()
    back_end: Any = SimpleNamespace(world=world, history=history)
    assert can_join(back_end, 1, own, found, RelocalisationConfig()) == possible
    if gap_s > 1:  # a frame that was tracked after the last keyframe leaves less time
        poses = old.T_world_camera, T_WORLD_FIRST
        history.append(old.timestamp_s + gap_s - 0.1, old.id, *poses)
        assert not can_join(back_end, 1, own, found, RelocalisationConfig())


def segments_with_few_points_in_common(common: int) -> tuple[Mapper, Tracked, Tracked]:
    """Two segments of three keyframes each, and a frame that both hold, of ``common`` points."""
    rules = BackEndConfig(MappingConfig(redundant_share=2.0))
    mapper = Mapper(CAMERA, Tracker(CAMERA, TrackingConfig()), rules)
    rng, world = np.random.default_rng(4), mapper.world
    looks = random_descriptors(40 + common, rng)
    both = points_before(T_WORLD_FIRST, common, rng)
    seen = []
    for segment, T_move in enumerate((np.eye(4), T_SEGMENT_WORLD)):
        points = np.concatenate([both, points_before(T_WORLD_FIRST, 40, rng)])
        ids = None
        for k in range(3):
            T = T_WORLD_FIRST @ se3_exp(np.array([0, 0.01 * k, 0, 0.05 * k, 0, 0]))
            keyframe = add_keyframe(world, T_move @ T, make_features(T, points, looks), segment)
            if ids is None:
                ids = world.make_landmarks(
                    keyframe, np.arange(len(points)), transform(T_move, points)
                )
            else:
                world.attach(keyframe, np.arange(len(points)), ids)
            mapper.optimise(keyframe)
        keypoints = np.arange(len(ids)) if segment else np.r_[:common, 40 + common : 80 + common]
        seen.append(tracked(keyframe.T_world_camera, keyframe.features, keypoints, ids))
    return mapper, seen[1], seen[0]


def test_a_joined_segment_stays_in_the_graph_with_few_points_in_common() -> None:
    mapper, in_segment, recognised = segments_with_few_points_in_common(3)
    mapper.join(1, in_segment, recognised)
    estimate = mapper.smoother.estimate()
    assert estimate.keyframe_ids.tolist() == [0, 1, 2, 3, 4, 5]
    poses = np.array([k.T_world_camera for k in mapper.world.keyframes.values()])
    np.testing.assert_allclose(poses[3:], poses[:3], atol=1e-3)
    held = [(k.keyframe_a, k.keyframe_b) for k in mapper.smoother.relative_poses(ANCHOR)]
    assert (2, 3) in held
    assert set(held) <= {(2, 3), (3, 4), (4, 5)}  # what needs none has none


def test_anchors_that_a_joined_map_does_not_need_are_released() -> None:
    mapper, in_segment, recognised = segments_with_few_points_in_common(20)
    mapper.join(1, in_segment, recognised)
    assert len(mapper.smoother.estimate().keyframe_ids) == 6
    assert mapper.smoother.relative_poses(ANCHOR) == ()


def test_factors_of_earlier_recordings_stay_when_segments_are_joined() -> None:
    """Their measurements are gone. What is of the moved segment moves with it."""
    mapper, in_segment, recognised = segments_with_few_points_in_common(20)
    T = {k.id: k.T_world_camera for k in mapper.world.keyframes.values()}
    frame, T_frame = reference_frame_id(1), T_SEGMENT_WORLD @ T_NEW_OLD
    covariance = np.eye(6) * 1e-4
    moved = RelativePose(3, 4, inverse(T[3]) @ T[4], covariance, None, ODOMETRY)
    up = RelativePose(frame, 4, inverse(T_frame) @ T[4], covariance, None, GRAVITY)
    loose = ImuModel(np.eye(4), 0.5, 5.0, 0.1, 0.1, 1.0, 1.0, 9.81)
    readings = np.tile([0.01, 0, 0, 9.81, 0, 0, 0, 0, 0, 0], (10, 1))
    imu = InertialFactor(3, 4, 1, readings, loose)
    states = {3: np.r_[0.5, 0, 0, np.zeros(6)], 4: np.r_[0.5, 0, 0, np.zeros(6)]}
    mapper.smoother.update(
        GraphUpdate(
            keyframe_ids=np.array([frame]),
            poses_world_camera=T_frame[None],
            priors=(PosePrior(frame, T_frame, covariance),),
            relative_poses=(moved, up),
            inertial=InertialUpdate((imu,), states=states, down={1: np.array([0, 0, -1.0])}),
        )
    )
    before = mapper.smoother.tables.inertial
    mapper.begin_session()
    mapper.join(1, in_segment, recognised)
    tables = mapper.smoother.tables
    assert [f.name for f in tables.relative_poses(ODOMETRY)] == [moved.name]
    assert [f.name for f in tables.relative_poses(GRAVITY)] == [(RETIRED_FRAME, 4, GRAVITY)]
    (T_found,) = tables.keyframes.get(np.array([RETIRED_FRAME]))
    np.testing.assert_allclose(T_found, T_NEW_OLD, atol=0.01)
    R_world_segment = T_SEGMENT_WORLD[:3, :3].T
    assert tables.inertial.down.keys() == {0}
    np.testing.assert_allclose(tables.inertial.down[0], R_world_segment @ before.down[1], atol=0.01)
    turned = R_world_segment @ before.states[4][:3]
    np.testing.assert_allclose(tables.inertial.states[4][:3], turned, atol=0.05)
