"""Somebody who walks into the image, in space that nobody saw before: the pose is the room's."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_view import CAMERA, add_keyframe, make_features, random_descriptors

from bmask_slam.features.patch_alignment import SubpixelConfig
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.pose.newcomers import Matched, NewcomerConfig
from bmask_slam.tracking.pose.rolling_shutter import PreviousPose
from bmask_slam.tracking.results import Tracked, TrackingStatus
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.world_map import WorldMap

PLAIN = TrackingConfig(subpixel=SubpixelConfig(enabled=False))
T_WORLD_CAMERA = se3_exp(np.array([0.0, 0.02, 0.0, 0.01, 0.0, 0.0]))
FRAME_S, SECOND_KEYFRAME_S = 1 / 30, 1 / 3
NOW_S = SECOND_KEYFRAME_S + 2 * FRAME_S


def part_of_image(left_px: float, right_px: float, z_m: tuple[float, float], count: int) -> Array:
    """Points (N, 3) in a column of the first image."""
    rng = np.random.default_rng(int(left_px))
    pixels = rng.uniform([left_px, 40.0], [right_px, 440.0], (count, 2))
    return CAMERA.backproject(pixels, rng.uniform(*z_m, count))


def tracked_among(
    speed_m_s: float, room: int = 160, people: int = 240, walking: int | None = None, **known: float
) -> tuple[Tracked, Array]:
    """A frame two after the keyframe that saw people first, and which landmarks they are.

    Some of them, at first all, walk to the right; ``known`` are changes of the rules.
    """
    rng = np.random.default_rng(3)
    wall = part_of_image(40, 300, (2.4, 3.4), room)
    bodies = part_of_image(400, 620, (1.6, 1.9), people)
    world = WorldMap()
    for points in (wall, bodies):
        looks = random_descriptors(len(points), rng)
        keyframe = add_keyframe(world, np.eye(4), make_features(np.eye(4), points, looks))
        world.make_landmarks(keyframe, np.arange(len(points)), points)
    ids, landmarks = np.arange(room + people), world.landmarks
    is_person = ids >= room
    walks = is_person & (ids < room + (people if walking is None else walking))
    points = landmarks.points_world.copy()
    points[walks, 0] += speed_m_s * (NOW_S - SECOND_KEYFRAME_S)
    noise_px = rng.normal(size=(len(ids), 3)) * [0.7, 0.7, 0.12]
    features = make_features(T_WORLD_CAMERA, points, landmarks.descriptors, noise_px)
    previous = PreviousPose(T_WORLD_CAMERA, FRAME_S, NOW_S)
    config = replace(PLAIN, newcomers=replace(NewcomerConfig(), **known))
    tracker = Tracker(CAMERA, config)
    return tracker.track(features, T_WORLD_CAMERA, ids, ids, world, previous), is_person


def error_m(tracked: Tracked) -> float:
    return float(np.linalg.norm(se3_log(inverse(T_WORLD_CAMERA) @ tracked.T_world_camera)[3:]))


@pytest.mark.parametrize("speed_m_s", [0.4, 0.6, 0.8])
def test_the_pose_is_that_of_the_room_that_was_there_before(speed_m_s: float) -> None:
    tracked, is_person = tracked_among(speed_m_s)
    assert tracked.status is TrackingStatus.OK
    assert error_m(tracked) < 0.006
    assert is_person[tracked.moving_ids].all()
    assert len(tracked.moving_ids) > 0.8 * is_person.sum()
    assert np.mean(~is_person[tracked.landmark_ids]) > 0.8


@pytest.mark.parametrize("speed_m_s", [0.4, 0.6, 0.8])
def test_without_the_rule_people_pull_the_camera_along(speed_m_s: float) -> None:
    tracked, _ = tracked_among(speed_m_s, new_s=0.0)
    assert len(tracked.moving_ids) == 0
    assert error_m(tracked) > 0.015


@pytest.mark.parametrize("speed_m_s", [0.0, 0.05, 0.15])
def test_new_landmarks_that_stand_or_hardly_move_are_used(speed_m_s: float) -> None:
    tracked, is_person = tracked_among(speed_m_s)
    assert len(tracked.moving_ids) == 0
    assert is_person[tracked.landmark_ids].mean() > 0.4


def test_few_that_move_are_no_people() -> None:
    tracked, _ = tracked_among(0.8, walking=20)
    assert len(tracked.moving_ids) == 0
    assert error_m(tracked) < 0.006  # outliers as any


def test_older_landmarks_must_know_the_pose() -> None:
    """Ten of them do not."""
    tracked, _ = tracked_among(0.8, room=10)
    assert len(tracked.moving_ids) == 0
    unsure, _ = tracked_among(0.8, max_sigma_m=1e-4)
    assert len(unsure.moving_ids) == 0


def test_what_a_frame_did_not_see_before_is_new_for_a_while_alone() -> None:
    """Half a second after a keyframe its landmarks are as good as others."""
    tracked, _ = tracked_among(0.8, new_s=0.05)
    assert len(tracked.moving_ids) == 0


def test_landmarks_of_another_recording_or_without_a_keyframe_are_old() -> None:
    """A map that a later recording goes on with may have later stamps."""
    world, looks = WorldMap(), random_descriptors(30, np.random.default_rng(1))
    points = part_of_image(40, 300, (2.4, 3.4), 30)
    features = make_features(np.eye(4), points, looks)
    for rows in (np.arange(10), np.arange(10, 20), np.arange(20, 30)):
        world.make_landmarks(add_keyframe(world, np.eye(4), features), rows, points[rows])
    world.landmarks.host[:10] = 17  # not there
    ids = np.arange(30)
    matched = Matched.of(features, ids, ids, NOW_S, world)
    assert np.isinf(matched.ages_s[:10]).all()
    assert np.allclose(matched.ages_s[10:20], 2 * FRAME_S)
    assert np.isinf(matched.ages_s[20:]).all()  # of a keyframe at 0.67 s


@pytest.mark.parametrize(
    "wrong", [{"new_s": -1.0}, {"gate": 0.0}, {"min_older": 0}, {"min_share": 1.5}]
)
def test_impossible_rules_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must"):
        NewcomerConfig(**wrong)  # type: ignore[arg-type]
