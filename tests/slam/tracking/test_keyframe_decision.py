"""The keyframe rules as tables: ORB-SLAM's, and the paper's Algorithm 2 as printed."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from synthetic_view import CAMERA, add_keyframe, make_features, points_before

from bmask_slam.tracking.keyframe_decision import (
    STARVING,
    KeyframeConfig,
    KeyframeDecision,
    KeyframeEvidence,
    keyframe_reason,
)
from bmask_slam.tracking.results import TrackingStatus
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

# Numbers of their own, so that the tables do not follow the defaults about.
ORB = KeyframeConfig(
    rule="orb",
    min_interval_frames=3,
    max_interval_frames=20,
    min_tracked=50,
    max_shared=0.7,
    late_frames=30,
    late_shared=0.8,
    urgent_shared=0.25,
    min_close_tracked=100,
    min_close_new=70,
)
DUE = KeyframeEvidence(
    frames_since=10, mapping_idle=True, tracked=200, shared=0.5, close_tracked=150, close_new=500
)
PAPER = KeyframeConfig(rule="paper")
PAPER_DUE = KeyframeEvidence(
    frames_since=30, mapping_idle=True, tracked=100, shared=0.89, close_tracked=0, close_new=999
)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, "new view"),
        ({"frames_since": 3}, "new view"),
        ({"frames_since": 2}, ""),
        ({"tracked": 50}, "new view"),
        ({"tracked": 49}, ""),
        ({"shared": 0.69}, "new view"),
        ({"shared": 0.7}, ""),
        # after a while without a keyframe, less has to be new
        ({"frames_since": 29, "shared": 0.79}, ""),
        ({"frames_since": 30, "shared": 0.79}, "new view"),
        ({"frames_since": 30, "shared": 0.8}, ""),
        ({"frames_since": 30, "shared": 0.79, "tracked": 49}, ""),
        ({"mapping_idle": False}, ""),
        ({"mapping_idle": False, "frames_since": 20}, ""),
        ({"mapping_idle": False, "frames_since": 21}, "new view"),
        # ORB-SLAM2's extra rule: starving of close points while new ones can be made
        ({"close_tracked": 99, "close_new": 71, "shared": 1.0}, "close points run out"),
        ({"close_tracked": 100, "close_new": 71, "shared": 1.0}, ""),
        ({"close_tracked": 99, "close_new": 70, "shared": 1.0}, ""),
        ({"close_tracked": 0, "tracked": 20, "mapping_idle": False}, "close points run out"),
        ({"close_tracked": 0, "frames_since": 2}, ""),
        # a fast turn: the view is nearly gone
        ({"frames_since": 1, "shared": 0.25}, ""),
        ({"frames_since": 1, "shared": 0.24}, "new view"),
        ({"frames_since": 1, "shared": 0.24, "mapping_idle": False}, "new view"),
        ({"frames_since": 1, "shared": 0.24, "tracked": 49}, ""),
        (
            {"frames_since": 1, "shared": 0.2, "close_tracked": 9, "tracked": 49},
            "close points run out",
        ),
    ],
)
def test_orb_rule(change: dict[str, float], reason: str) -> None:
    assert keyframe_reason(replace(DUE, **change), ORB) == reason


@pytest.mark.parametrize(
    ("change", "is_due"),
    [
        ({}, True),
        ({"frames_since": 29}, False),
        ({"frames_since": 500}, True),
        ({"mapping_idle": False}, False),
        ({"mapping_idle": False, "frames_since": 500}, False),  # a strict AND, as printed
        ({"shared": 0.9}, False),
        ({"tracked": 99}, False),
        ({"frames_since": 29, "shared": 0.1}, False),
    ],
)
def test_the_papers_rule_with_the_printed_numbers(change: dict[str, float], is_due: bool) -> None:
    """At least 30 frames AND idle AND shared view < 90 % AND >= 100 matches; nothing else."""
    reason = keyframe_reason(replace(PAPER_DUE, **change), PAPER)
    assert reason == ("Algorithm 2" if is_due else "")


def test_fewer_matches_never_delay_a_keyframe() -> None:
    always = replace(ORB, max_shared=2.0)
    late = replace(DUE, frames_since=30, shared=1.0)
    assert keyframe_reason(late, always) == "new view"


def test_the_default_rule_equals_orb_slams() -> None:
    assert KeyframeConfig().rule == "orb"
    assert keyframe_reason(DUE, ORB) == keyframe_reason(
        DUE, replace(KeyframeConfig(), max_shared=0.7)
    )


POINTS = 20


def decision_at(now_s: float, config: KeyframeConfig) -> tuple[KeyframeDecision, Keyframe]:
    """The decision for frames at a time, against a keyframe of 100 s with ``POINTS`` landmarks."""
    world, points = WorldMap(), points_before(np.eye(4), POINTS, np.random.default_rng(1))
    features = make_features(np.eye(4), points, np.zeros((POINTS, 8), np.uint64))
    keyframe = add_keyframe(world, np.eye(4), features)
    keyframe.timestamp_s = 100.0
    world.make_landmarks(keyframe, np.arange(POINTS), points)
    tracker: Any = SimpleNamespace(timestamp_s=now_s, reference=keyframe, segment=0)
    map_reader: Any = SimpleNamespace(world=world, idle=True, accepts_keyframes=True)
    return KeyframeDecision(CAMERA, config, map_reader, tracker, 0.25), keyframe


@pytest.mark.parametrize(
    ("now_s", "shared", "is_known"),
    [(120.0, 10, True), (119.9, 10, False), (120.0, 9, False), (60.0, 10, True)],
)
def test_close_points_may_run_out_where_an_old_keyframe_shows_the_view(
    now_s: float, shared: int, is_known: bool
) -> None:
    decision, keyframe = decision_at(now_s, KeyframeConfig(max_shared=0.5))
    ids = keyframe.landmark_ids
    assert decision._is_known_view(ids[:shared], keyframe, STARVING) is is_known
    assert not decision._is_known_view(ids, keyframe, "new view")


@pytest.mark.parametrize(
    ("rarely_found", "shared", "reason"),
    [(0, 11, "new view"), (0, 12, ""), (10, 5, "new view"), (10, 6, "")],
)
def test_landmarks_that_are_rarely_found_make_no_view_new(
    rarely_found: int, shared: int, reason: str
) -> None:
    """Of 20 landmarks 12 are 60 %; if 10 are found in a fifth of the frames, 6 of the others."""
    config = KeyframeConfig(max_shared=0.6, min_tracked=0, min_close_tracked=0)
    decision, keyframe = decision_at(101.0, config)
    landmarks = decision._map.world.landmarks
    landmarks.visible[:] = 20
    landmarks.found[:] = 5
    landmarks.found[POINTS - rarely_found :] = 4
    tracked: Any = SimpleNamespace(
        status=TrackingStatus.OK,
        features=keyframe.features,
        landmark_ids=keyframe.landmark_ids[:shared],
        keypoints=np.arange(shared),
    )
    decision.frames_since = config.min_interval_frames
    assert decision.decide(tracked) == reason
