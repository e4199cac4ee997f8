"""The motion model between frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
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

from bmask_slam.events import EventLog
from bmask_slam.features.brisk import BriskExtractor, FeatureConfig, Features
from bmask_slam.features.descriptor_index import DescriptorIndex
from bmask_slam.features.patch_alignment import SubpixelConfig
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.geometry import se3_exp, se3_log
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.sensing.sensor_fusion import SensorFusion
from bmask_slam.tracking.camera_tracker import CameraTracker
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.pose.rolling_shutter import PreviousPose
from bmask_slam.tracking.relocalisation import RelocalisationConfig
from bmask_slam.tracking.results import Tracked, TrackingStatus, lost, starting
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.local_map import LocalMapConfig
from bmask_slam.world.world_map import WorldMap

STEP = se3_exp(np.array([0.05, -0.1, 0.2, 0.3, 0.1, -0.2]))
NO_IDS = np.zeros(0, np.int64)


class RecordingTracker:
    """A fake tracker: records the prediction, and tracks there or is lost."""

    camera = CAMERA
    config = TrackingConfig()

    def __init__(self) -> None:
        self.predictions: list[Array] = []
        self.previous: list[PreviousPose | None] = []
        self.is_lost = False

    def track(self, features: Features, T_predicted: Array, *others: Any) -> Tracked:
        self.predictions.append(T_predicted)
        self.previous.append(others[-1])
        return (lost if self.is_lost else starting)(T_predicted, features)


@dataclass
class StillMap:
    """A map with one keyframe and a back end that is ready or busy."""

    world: WorldMap = field(default_factory=WorldMap)
    history: FrameHistory = field(default_factory=FrameHistory)
    places: DescriptorIndex = field(default_factory=DescriptorIndex)
    sensors: SensorFusion = field(default_factory=lambda: SensorFusion(SensorsConfig(), EventLog()))
    idle: bool = True
    accepts_keyframes: bool = True
    landmarks_ahead: Ints = field(default_factory=lambda: NO_IDS)


def scene(map_reader: StillMap | None = None) -> tuple[CameraTracker, RecordingTracker, Features]:
    features = make_features(np.eye(4), np.zeros((0, 3)), np.zeros((0, 8), np.uint64))
    map_reader, tracker = map_reader or StillMap(), RecordingTracker()
    camera_tracker = CameraTracker(
        tracker,  # type: ignore[arg-type]
        map_reader,
        RelocalisationConfig(),
        LocalMapConfig(),
        BriskExtractor(CAMERA, FeatureConfig()),
    )
    camera_tracker.refer_to(add_keyframe(map_reader.world, np.eye(4), features))
    return camera_tracker, tracker, features


def test_the_motion_model_continues_in_the_camera_frame() -> None:
    camera_tracker, tracker, features = scene()
    camera_tracker.update_motion(T_NEW_OLD, T_NEW_OLD, NO_IDS)
    camera_tracker.update_motion(T_NEW_OLD @ STEP, T_NEW_OLD @ STEP, NO_IDS)
    camera_tracker.track(features)
    assert np.allclose(tracker.predictions[-1], T_NEW_OLD @ STEP @ STEP)


@pytest.mark.parametrize(
    ("stamp_s", "steps"),
    [(2.0, 1.0), (2.1, 1.0), (3.0, 2.0), (1.5, 0.5), (60.0, 4.0), (0.5, 0.0), (-60.0, 0.0)],
)
def test_the_prediction_is_proportional_to_the_time(stamp_s: float, steps: float) -> None:
    camera_tracker, tracker, features = scene()
    for time_s, pose in ((0.0, T_NEW_OLD), (1.0, T_NEW_OLD @ STEP)):
        camera_tracker.begin_frame(time_s)
        camera_tracker.update_motion(pose, pose, NO_IDS)
    camera_tracker.begin_frame(stamp_s)
    camera_tracker.track(features)
    ahead = se3_exp(steps * se3_log(STEP))
    assert np.allclose(tracker.predictions[-1], T_NEW_OLD @ STEP @ ahead)


def test_the_velocity_is_of_tracking_and_the_pose_of_the_optimised_keyframe() -> None:
    camera_tracker, tracker, features = scene()
    correction = se3_exp(np.array([0, 0, 0, 0.01, 0.02, 0.0]))
    camera_tracker.update_motion(np.eye(4), np.eye(4), NO_IDS)
    camera_tracker.update_motion(STEP, correction @ STEP, NO_IDS)
    camera_tracker.track(features)
    assert np.allclose(tracker.predictions[-1], correction @ STEP @ STEP)


def test_the_tracker_gets_the_previous_pose() -> None:
    camera_tracker, tracker, features = scene()
    correction = se3_exp(np.array([0, 0, 0, 0.01, 0.02, 0.0]))
    for stamp_s in (5.00, 5.04, 6.00):
        camera_tracker.begin_frame(stamp_s)
        camera_tracker.track(features)
        camera_tracker.update_motion(STEP, correction @ STEP, NO_IDS)
    first, second, late = tracker.previous
    assert first is None and late is None
    assert second is not None and second.ago_s == pytest.approx(0.04)
    np.testing.assert_array_equal(second.T_world_camera, correction @ STEP)
    tracker.is_lost = True
    for stamp_s in (6.04, 6.08):
        camera_tracker.begin_frame(stamp_s)
        camera_tracker.track(features)
    before_lost, lost_already = tracker.previous[-2:]
    assert before_lost is not None and lost_already is None


def test_a_lost_camera_is_predicted_at_its_last_pose() -> None:
    camera_tracker, tracker, features = scene()
    camera_tracker.update_motion(np.eye(4), np.eye(4), NO_IDS)
    camera_tracker.update_motion(STEP, STEP, NO_IDS)
    tracker.is_lost = True
    for number in (1, 2):
        tracked = camera_tracker.track(features)
        assert tracked.status is TrackingStatus.LOST
        assert camera_tracker.lost_frames == number
    assert np.allclose(tracker.predictions[-1], STEP)


def test_a_frame_begins_no_map_segment_while_the_back_end_accepts_no_keyframe() -> None:
    """Such a frame has no pose: it must be LOST, however long tracking was lost before."""
    map_reader = StillMap(accepts_keyframes=False)
    camera_tracker, tracker, _ = scene(map_reader)
    points = points_before(np.eye(4), 200, np.random.default_rng(1))
    features = make_features(np.eye(4), points, np.zeros((200, 8), np.uint64))
    features = replace(features, depth_m=points[:, 2])
    tracker.is_lost = True
    patience = RelocalisationConfig().patience_frames
    for _ in range(2 * patience):
        assert camera_tracker.track(features).status is TrackingStatus.LOST
    map_reader.accepts_keyframes = True
    assert camera_tracker.track(features).status is TrackingStatus.OK
    assert camera_tracker.segment == 1
    map_reader.accepts_keyframes = False
    assert camera_tracker.track(features).status is TrackingStatus.LOST


def test_a_lost_frame_is_tracked_on_in_the_segment_where_it_is_recognised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    map_reader = StillMap()
    camera_tracker, tracker, features = scene(map_reader)
    points = points_before(np.eye(4), 20, np.random.default_rng(1))
    here = make_features(np.eye(4), points, np.zeros((20, 8), np.uint64))
    other = add_keyframe(map_reader.world, STEP, here)
    other.segment = 3
    ids = map_reader.world.make_landmarks(other, np.arange(20), points)
    found = replace(starting(STEP, here), keypoints=np.arange(20), landmark_ids=ids)
    monkeypatch.setattr(
        camera_tracker, "recognise", lambda _, where: found if other in where else None
    )
    tracker.is_lost = True
    tracked = camera_tracker.track(features)
    assert tracked is found
    assert camera_tracker.segment == 3 and camera_tracker.reference is other
    np.testing.assert_array_equal(camera_tracker.local_ids, ids)


@pytest.mark.parametrize(("hidden", "used"), [(0, 75), (150, 25)], ids=["ends", "hidden"])
def test_landmarks_ahead_of_the_map_are_tracked_where_the_map_ends(hidden: int, used: int) -> None:
    """A frame shows 25 landmarks of the map and 50 ahead of it; others of the map may be hidden.

    Then something is in front of them, and those ahead may be of what moves there.
    """
    rng, map_reader = np.random.default_rng(5), StillMap()
    points = points_before(np.eye(4), 75 + hidden, rng)
    seen = make_features(np.eye(4), points, random_descriptors(75 + hidden, rng))
    old = np.concatenate([np.arange(25), np.arange(75, 75 + hidden)])
    world = map_reader.world
    keyframe = add_keyframe(world, np.eye(4), seen)
    world.make_landmarks(keyframe, old, points[old])
    map_reader.landmarks_ahead = world.make_landmarks(keyframe, np.arange(25, 75), points[25:75])
    world.observe(keyframe, np.arange(25, 75), -1)
    tracker = Tracker(CAMERA, TrackingConfig(subpixel=SubpixelConfig(enabled=False)))
    rules = RelocalisationConfig(), LocalMapConfig(), BriskExtractor(CAMERA, FeatureConfig())
    camera_tracker = CameraTracker(tracker, map_reader, *rules)
    camera_tracker.refer_to(keyframe)
    shown = make_features(np.eye(4), points[:75], seen.descriptors[:75])
    assert len(camera_tracker.track(shown).landmark_ids) == used


def test_optical_flow_uses_the_camera_that_was_found() -> None:
    camera_tracker, tracker, _ = scene()
    found = replace(CAMERA, rolling_shutter_s=0.02)
    camera_tracker.use_camera(found)
    assert tracker.camera == camera_tracker._images._motion.camera == found
