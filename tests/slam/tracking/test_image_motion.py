"""The motion from image to image by optical flow, and landmarks that are followed by it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane

from bmask_slam.features.brisk import BriskExtractor, FeatureConfig, Features, select
from bmask_slam.features.matching import Matches
from bmask_slam.features.patch_alignment import SubpixelConfig
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.guided_landmarks import Guided, GuidedLandmarks, weighted, with_guided
from bmask_slam.tracking.image_motion import ImageMotion, ImageMotionConfig, LastView
from bmask_slam.tracking.results import TrackingStatus
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.landmark_table import LandmarkTable
from bmask_slam.world.world_map import WorldMap

T_WORLD_LAST = se3_exp(np.array([0.05, -0.03, 0.1, 0.1, -0.2, 0.05]))
STEP = np.array([0.01, -0.07, 0.05, 0.03, 0.01, -0.02])
"""4 degrees and 4 cm: about 40 px."""
EXTRACTOR = BriskExtractor(CAMERA, FeatureConfig(layer_shares=(1.0,)))
"""Its keypoints all have one standard deviation."""


def blurred(frame: Frame) -> Frame:
    return replace(frame, rgb=cv2.blur(frame.rgb, (9, 9)))


def last_view(motion: ImageMotion) -> LastView:
    features = EXTRACTOR.extract(render_plane(T_WORLD_LAST))
    none = np.full(len(features), -1)
    return motion.view(features, none, T_WORLD_LAST, LandmarkTable())


def error(T: Array, step: Array) -> tuple[float, float]:
    xi = se3_log(inverse(se3_exp(step)) @ T)
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))


def test_the_pose_in_the_last_cameras_frame_is_found_without_a_prediction() -> None:
    """A blurred image, and a motion that nothing announced."""
    motion = ImageMotion(CAMERA, ImageMotionConfig())
    frame = blurred(render_plane(T_WORLD_LAST @ se3_exp(STEP)))
    followed = motion.follow(last_view(motion), EXTRACTOR.extract(frame), np.eye(4), 0.033)
    assert followed is not None
    turn_rad, shift_m = error(followed.estimate.T_world_camera, STEP)
    assert turn_rad < 1e-3 and shift_m < 3e-3
    assert followed.estimate.inliers.sum() > 100


@pytest.mark.parametrize("ago_s", [0.033, 0.1])
def test_the_rows_of_a_rolling_shutter_are_brought_to_one_moment(ago_s: float) -> None:
    camera = Camera(640, 480, 525.0, 520.0, 318.5, 241.5, rolling_shutter_s=0.025)
    shares = camera.share_of_rows(np.arange(480.0)) * camera.rolling_shutter_s / ago_s
    poses = np.stack([T_WORLD_LAST @ se3_exp((1 + s) * STEP) for s in shares])
    features = EXTRACTOR.extract(render_plane(poses))
    motion = ImageMotion(camera, ImageMotionConfig())
    rolling = motion.follow(last_view(motion), features, np.eye(4), ago_s)
    assert rolling is not None
    turn_rad, shift_m = error(rolling.estimate.T_world_camera, STEP)
    assert turn_rad < 3e-3 and shift_m < 6e-3


def test_surprise_is_the_distance_from_where_corners_were_expected() -> None:
    motion = ImageMotion(CAMERA, ImageMotionConfig())
    seen = last_view(motion)
    turn = se3_exp(np.array([0, 0.02, 0, 0, 0, 0]))  # 0.02 rad is 10.5 px in the middle
    assert motion.surprise_px(seen, T_WORLD_LAST, T_WORLD_LAST) == pytest.approx(0, abs=1e-9)
    assert motion.surprise_px(seen, T_WORLD_LAST @ turn, T_WORLD_LAST) == pytest.approx(11, abs=1.5)


def landmarks_of(features: Features) -> LandmarkTable:
    table = LandmarkTable()
    points = CAMERA.backproject(features.pixels, features.depth_m)
    table.add({"points_world": transform(T_WORLD_LAST, points)})
    return table


def test_followed_landmarks_lie_where_they_project() -> None:
    """Also after a state was saved and restored; landmarks outside the local map are left out."""
    features = EXTRACTOR.extract(render_plane(T_WORLD_LAST))
    table = landmarks_of(features)
    ids = np.arange(len(features))
    T_next = T_WORLD_LAST @ se3_exp(STEP)
    before, after = (GuidedLandmarks(EXTRACTOR, ImageMotionConfig()) for _ in range(2))
    before.remember(features, ids, (T_WORLD_LAST, T_WORLD_LAST), table)
    after.restore(before.state())
    frame = blurred(render_plane(T_next))
    after.frame = frame
    after.follow(EXTRACTOR.extract(frame), np.eye(4), 0.033)
    local = ids[ids % 2 == 0]
    guided = after.guided(EXTRACTOR.extract(frame), local, table)
    assert len(guided.landmark_ids) > 40
    assert np.isin(guided.landmark_ids, local).all()
    points = transform(inverse(T_next), table.points_world[guided.landmark_ids])
    apart = np.linalg.norm(CAMERA.project(points) - guided.features.pixels, axis=1)
    assert np.median(apart) < 0.5 and np.percentile(apart, 95) < 2
    depth_m = guided.features.depth_m
    assert np.isfinite(depth_m).mean() > 0.9
    assert np.nanmax(np.abs(depth_m - points[:, 2])) < 0.01


def test_the_flow_alone_says_less_with_every_frame_until_it_says_nothing() -> None:
    """Sigmas grow like a random walk; those that were raised for their number do not stay so."""
    config = ImageMotionConfig(patch_sigma_px=0.5)
    frame = render_plane(T_WORLD_LAST)
    features = EXTRACTOR.extract(frame)
    table = landmarks_of(features)
    ids, poses = np.arange(len(features)), (T_WORLD_LAST, T_WORLD_LAST)
    memory = GuidedLandmarks(EXTRACTOR, config)
    first = float(features.sigmas_px[0, 0])
    memory.remember(features, ids, poses, table)
    for count in range(1, 40):
        memory.frame = frame
        memory.follow(features, np.eye(4), 0.033)
        if memory.followed is None:
            break
        sigma_px = np.sqrt(first**2 + count * config.sigma_px**2)
        np.testing.assert_allclose(memory.followed.sigmas_px, sigma_px)
        guided = memory.guided(features, ids, table)
        np.testing.assert_allclose(guided.features.sigmas_px[:, :2], sigma_px)
        raised = replace(guided.features, sigmas_px=3 * guided.features.sigmas_px)
        memory.remember(raised, guided.landmark_ids, poses, table)
    assert sigma_px < config.max_sigma_px <= np.hypot(sigma_px, config.sigma_px)


def guided_in(frame: Frame, table: LandmarkTable, seen: Features) -> tuple[Features, Guided]:
    """A frame's keypoints, and the landmarks of the table that were followed into it."""
    features, ids = EXTRACTOR.extract(frame), np.arange(len(seen))
    memory = GuidedLandmarks(EXTRACTOR, ImageMotionConfig())
    memory.remember(seen, ids, (T_WORLD_LAST, T_WORLD_LAST), table)
    memory.frame = frame
    memory.follow(features, np.eye(4), 0.033)
    return features, memory.guided(features, ids, table)


def test_a_frame_that_is_tracked_by_the_flow_alone_is_weak_and_says_how_uncertain_it_is() -> None:
    seen = EXTRACTOR.extract(render_plane(T_WORLD_LAST))
    world = WorldMap(landmarks=landmarks_of(seen))
    T_next = T_WORLD_LAST @ se3_exp(STEP)
    features, guided = guided_in(blurred(render_plane(T_next)), world.landmarks, seen)
    features = select(features, np.zeros(0, np.int64))  # nothing was detected
    guided = replace(guided, detected=0)
    tracker = Tracker(CAMERA, TrackingConfig(subpixel=SubpixelConfig(enabled=False)))
    tracked = tracker.refine(features, T_next, np.arange(len(seen)), world, guided=guided)
    assert tracked.status is TrackingStatus.WEAK and tracked.by_appearance == 0
    assert len(tracked.landmark_ids) > 40
    np.testing.assert_array_equal(tracked.keypoints, np.arange(len(tracked.keypoints)))
    xi = se3_log(inverse(T_next) @ tracked.T_world_camera)
    assert np.linalg.norm(xi[:3]) < 2e-3 and np.linalg.norm(xi[3:]) < 5e-3
    config = ImageMotionConfig()
    followed = Matches(*(np.arange(len(guided.landmark_ids)) for _ in range(3)))
    lighter, loose = weighted(guided.features, followed, guided, config)
    assert loose.all()
    total = (lighter.sigmas_px[:, 0] ** -2).sum()
    assert total == pytest.approx(config.least_weight * guided.features.sigmas_px[0, 0] ** -2)


def test_the_flow_has_at_most_the_weight_of_the_matches() -> None:
    seen = EXTRACTOR.extract(render_plane(T_WORLD_LAST))
    config = ImageMotionConfig()
    features = select(seen, np.arange(160))
    sigmas = features.sigmas_px.copy()
    sigmas[100:, :2] = 2.0
    sigmas[150:, :2] = config.patch_sigma_px  # their patches were found
    guided = Guided(select(seen, np.arange(100, 160)), np.arange(100, 160), 100)
    matches = Matches(*(np.arange(75, 160) for _ in range(3)))  # 25 matched, 10 by patch, 50 loose
    lighter, loose = weighted(replace(features, sigmas_px=sigmas), matches, guided, config)
    np.testing.assert_array_equal(np.flatnonzero(loose), np.arange(25, 75))
    np.testing.assert_array_equal(
        np.delete(lighter.sigmas_px, np.s_[100:150], 0), np.delete(sigmas, np.s_[100:150], 0)
    )
    assert (lighter.sigmas_px[100:150, 0] ** -2).sum() == pytest.approx(35 * 2.0**-2)
    np.testing.assert_array_equal(lighter.sigmas_px[:, 2], features.sigmas_px[:, 2])


def test_landmarks_that_were_fused_or_are_gone_are_not_followed_under_their_old_ids() -> None:
    features = EXTRACTOR.extract(render_plane(T_WORLD_LAST))
    table = landmarks_of(features)
    memory = GuidedLandmarks(EXTRACTOR, ImageMotionConfig(corners=len(features)))
    poses = (T_WORLD_LAST, T_WORLD_LAST)
    memory.remember(features, np.arange(len(features)), poses, table)
    table.replaced_by[3] = 5
    table.remove(np.array([3]))
    memory.follow_map(table)
    assert memory.state()["landmark_ids"][3] == 5


def test_guided_landmarks_join_only_where_descriptors_found_nothing() -> None:
    ids = np.array([10, 20, 30])
    matches = Matches(np.array([1]), np.array([4]), np.array([7]))  # landmark 20, keypoint 4
    guided = Guided(EXTRACTOR.extract(render_plane(T_WORLD_LAST)), np.array([20, 30, 99]), 100)
    seen, more = with_guided(ids, matches, guided)
    pairs = {(int(seen[q]), int(k)) for q, k in zip(more.query, more.train, strict=True)}
    assert pairs == {(20, 4), (30, 101), (99, 102)}
