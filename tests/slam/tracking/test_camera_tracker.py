"""The motion model between frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from synthetic_view import T_NEW_OLD, add_keyframe, make_features

from bmask_slam.back_end.landmark_management import MappingConfig
from bmask_slam.features.brisk import Features
from bmask_slam.features.descriptor_index import DescriptorIndex
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import se3_exp, se3_log
from bmask_slam.tracking.camera_tracker import CameraTracker
from bmask_slam.tracking.relocalisation import RelocalisationConfig
from bmask_slam.tracking.results import TrackingStatus
from bmask_slam.tracking.rolling_shutter import PreviousPose
from bmask_slam.tracking.tracker import Tracked, lost, untracked
from bmask_slam.world.world_map import WorldMap

STEP = se3_exp(np.array([0.05, -0.1, 0.2, 0.3, 0.1, -0.2]))
NO_IDS = np.zeros(0, np.int64)


class RecordingTracker:
    """Stands for the tracker: notes the prediction, and tracks there or is lost."""

    def __init__(self) -> None:
        self.predictions: list[Array] = []
        self.previous: list[PreviousPose | None] = []
        self.is_lost = False

    def track(self, features: Features, T_predicted: Array, *others: Any) -> Tracked:
        self.predictions.append(T_predicted)
        self.previous.append(others[-1])
        return (lost if self.is_lost else untracked)(T_predicted, features)


def scene() -> tuple[CameraTracker, RecordingTracker, WorldMap, Features]:
    features = make_features(np.eye(4), np.zeros((0, 3)), np.zeros((0, 8), np.uint64))
    world, tracker = WorldMap(), RecordingTracker()
    add_keyframe(world, np.eye(4), features)
    camera_tracker = CameraTracker(
        tracker, DescriptorIndex(), (RelocalisationConfig(), MappingConfig())
    )  # type: ignore[arg-type]
    return camera_tracker, tracker, world, features


def test_the_camera_is_expected_to_go_on_in_its_own_frame() -> None:
    camera_tracker, tracker, world, features = scene()
    camera_tracker.moved_on(T_NEW_OLD, T_NEW_OLD, NO_IDS)
    camera_tracker.moved_on(T_NEW_OLD @ STEP, T_NEW_OLD @ STEP, NO_IDS)
    camera_tracker.track(features, world, world.keyframes[0])
    assert np.allclose(tracker.predictions[-1], T_NEW_OLD @ STEP @ STEP)


@pytest.mark.parametrize(
    ("stamp_s", "steps"), [(2.0, 1.0), (2.1, 1.0), (3.0, 2.0), (1.5, 0.5), (60.0, 4.0)]
)
def test_a_frame_that_comes_later_is_expected_farther_on(stamp_s: float, steps: float) -> None:
    camera_tracker, tracker, world, features = scene()
    for time_s, pose in ((0.0, T_NEW_OLD), (1.0, T_NEW_OLD @ STEP)):
        camera_tracker.expect(time_s)
        camera_tracker.moved_on(pose, pose, NO_IDS)
    camera_tracker.expect(stamp_s)
    camera_tracker.track(features, world, world.keyframes[0])
    ahead = se3_exp(steps * se3_log(STEP))
    assert np.allclose(tracker.predictions[-1], T_NEW_OLD @ STEP @ ahead)


def test_the_speed_is_of_tracking_the_place_of_the_optimised_keyframe() -> None:
    camera_tracker, tracker, world, features = scene()
    correction = se3_exp(np.array([0, 0, 0, 0.01, 0.02, 0.0]))
    camera_tracker.moved_on(np.eye(4), np.eye(4), NO_IDS)
    camera_tracker.moved_on(STEP, correction @ STEP, NO_IDS)
    camera_tracker.track(features, world, world.keyframes[0])
    assert np.allclose(tracker.predictions[-1], correction @ STEP @ STEP)


def test_the_tracker_is_told_where_the_camera_was_a_moment_ago() -> None:
    camera_tracker, tracker, world, features = scene()
    correction = se3_exp(np.array([0, 0, 0, 0.01, 0.02, 0.0]))
    for stamp_s in (5.00, 5.04, 6.00):
        camera_tracker.expect(stamp_s)
        camera_tracker.track(features, world, world.keyframes[0])
        camera_tracker.moved_on(STEP, correction @ STEP, NO_IDS)
    first, second, late = tracker.previous
    assert first is None and late is None
    assert second is not None and second.ago_s == pytest.approx(0.04)
    np.testing.assert_array_equal(second.T_world_camera, correction @ STEP)
    tracker.is_lost = True
    for stamp_s in (6.04, 6.08):
        camera_tracker.expect(stamp_s)
        camera_tracker.track(features, world, world.keyframes[0])
    before_lost, lost_already = tracker.previous[-2:]
    assert before_lost is not None and lost_already is None


def test_a_lost_camera_is_expected_where_it_was_last_seen() -> None:
    camera_tracker, tracker, world, features = scene()
    camera_tracker.moved_on(np.eye(4), np.eye(4), NO_IDS)
    camera_tracker.moved_on(STEP, STEP, NO_IDS)
    tracker.is_lost = True
    for number in (1, 2):
        tracked = camera_tracker.track(features, world, world.keyframes[0])
        assert tracked.status is TrackingStatus.LOST
        assert camera_tracker.lost_frames == number
    assert np.allclose(tracker.predictions[-1], STEP)
