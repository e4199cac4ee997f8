"""Rolling shutter: exact correction, estimated velocity, and a more accurate path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic_view import CAMERA, make_features, points_before, random_descriptors, render_plane

from bmask_slam.features.brisk import FeatureConfig, Features
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.graph.metrics import align
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.pose.pose_optimisation import optimise_pose
from bmask_slam.tracking.pose.rolling_shutter import (
    CameraVelocity,
    PreviousPose,
    at_one_moment,
    corrected,
    motion_since,
    velocities,
)

ROLLING = replace(CAMERA, rolling_shutter_s=0.025)
TWIST = np.array([0.5, -0.6, 0.4, 0.3, 0.2, -0.3])
T_WORLD_CAMERA = se3_exp(np.array([0.2, -0.5, 0.1, 1.0, -2.0, 0.5]))


def exposed(points_world: Array, readout_s: float) -> tuple[Features, Array]:
    """Keypoints of points (N, 3) whose rows are exposed one by one, and T_world_camera.

    The pose (4, 4) is that of the moment of their mean row.
    """
    later_s = np.zeros(len(points_world))
    for _ in range(5):
        T = T_WORLD_CAMERA @ se3_exp(later_s[:, None] * TWIST)
        points = transform(inverse(T), points_world[:, None])[:, 0]
        later_s = readout_s * CAMERA.share_of_rows(CAMERA.project(points)[:, 1])
    names = random_descriptors(len(points), np.random.default_rng(0))
    features = make_features(np.eye(4), points, names)
    return features, T_WORLD_CAMERA @ se3_exp(later_s.mean() * TWIST)


def scene(count: int = 200) -> Array:
    return points_before(T_WORLD_CAMERA, count, np.random.default_rng(1))


def test_velocities_equal_finite_differences_of_a_moving_camera() -> None:
    points, h = points_before(np.eye(4), 20, np.random.default_rng(0)), 1e-6
    later, earlier = (transform(inverse(se3_exp(s * h * TWIST)), points) for s in (1, -1))
    np.testing.assert_allclose(velocities(points, TWIST), (later - earlier) / (2 * h), atol=1e-8)


def test_keypoints_are_moved_to_a_common_time() -> None:
    points = scene()
    features, T = exposed(points, 0.025)
    truth = CAMERA.project_stereo(transform(inverse(T), points))

    def error_px(camera_readout_s: float, twist: Array) -> float:
        camera = replace(CAMERA, rolling_shutter_s=camera_readout_s)
        still = at_one_moment(features, camera, CameraVelocity(twist, 0.1))
        np.testing.assert_allclose(still.disparity_px * still.depth_m, CAMERA.stereo_bf_px_m)
        u_right = still.pixels[:, 0] - still.disparity_px
        return float(np.abs(np.column_stack([still.pixels, u_right]) - truth).max())

    assert error_px(0.0, TWIST) > 3
    assert error_px(0.025, TWIST) < 0.05  # of second order
    assert error_px(-0.025, TWIST) > 6
    assert error_px(0.025, -TWIST) > 6


def test_a_keypoint_without_depth_moves_as_at_the_median_depth() -> None:
    points = scene()
    features, _ = exposed(points, 0.025)
    whole = at_one_moment(features, ROLLING, CameraVelocity(TWIST, 0.1))
    without_depth = np.arange(len(points)) % 4 == 0
    depth_m = np.where(without_depth, np.nan, features.depth_m)
    still = at_one_moment(replace(features, depth_m=depth_m), ROLLING, CameraVelocity(TWIST, 0.1))
    assert (
        np.isnan(still.depth_m[without_depth]).all()
        and np.isnan(still.disparity_px[without_depth]).all()
    )
    np.testing.assert_array_equal(still.pixels[~without_depth], whole.pixels[~without_depth])
    shift_px = np.linalg.norm(whole.pixels - features.pixels, axis=1)[without_depth]
    left_px = np.linalg.norm(whole.pixels - still.pixels, axis=1)[without_depth]
    assert left_px.mean() < 0.3 * shift_px.mean()


def test_nothing_moves_where_all_rows_are_exposed_at_once_or_the_motion_is_unknown() -> None:
    features, _ = exposed(scene(), 0.025)
    previous = PreviousPose(np.eye(4), 0.03, 0.03)
    assert motion_since(previous, T_WORLD_CAMERA, CAMERA) is None
    assert motion_since(None, T_WORLD_CAMERA, ROLLING) is None
    assert at_one_moment(features, ROLLING, None) is features


def test_the_motion_is_that_since_the_previous_pose() -> None:
    before = T_WORLD_CAMERA @ se3_exp(-0.04 * TWIST)
    motion = motion_since(PreviousPose(before, 0.04, 0.04), T_WORLD_CAMERA, ROLLING)
    assert motion is not None
    np.testing.assert_allclose(motion.twist, TWIST, atol=1e-9)


def test_the_velocity_is_found_from_matches() -> None:
    """In two steps from an error of 0.2 rad/s and 0.1 m/s, with a weak prior."""
    points = scene(300)
    features, T = exposed(points, 0.025)
    wrong = CameraVelocity(TWIST + np.array([0.2, -0.2, 0.2, 0.1, 0.1, -0.1]), 10.0)
    motion = wrong
    for _ in range(2):
        still = at_one_moment(features, ROLLING, motion)
        estimate = optimise_pose(T, points, still.measurements, still.sigmas_px, CAMERA)
        motion = corrected(motion, estimate, points, still, ROLLING)
    before, after = np.abs(wrong.twist - TWIST), np.abs(motion.twist - TWIST)
    assert (after[:3] < 0.02).all() and (after[3:] < 0.04).all(), (before, after)
    with_prior = corrected(CameraVelocity(wrong.twist, 1e-6), estimate, points, still, ROLLING)
    np.testing.assert_allclose(with_prior.twist, wrong.twist, atol=1e-6)


def test_the_path_of_a_shaken_camera_is_better() -> None:
    """Images rendered row by row, of a hand-held camera that turns by up to 1 rad/s."""
    times_s = np.arange(24) / 30.0

    def path(t: Array) -> Array:
        swing = np.array([0.12, 0.1, 0.1, 0.15, 0.1, 0.1])
        return se3_exp(swing * np.sin(np.multiply.outer(t, [7.0, 9.0, 8.0, 5.0, 6.0, 4.0])))

    rows_s = 0.025 * CAMERA.share_of_rows(np.arange(480.0))
    frames = [render_plane(path(t + rows_s), i) for i, t in enumerate(times_s)]
    ate_m = {}
    config = SystemConfig(FeatureConfig(max_keypoints=400))
    for readout_s in (-0.025, 0.0, 0.025):
        system = SlamSystem(replace(CAMERA, rolling_shutter_s=readout_s), config)
        found = [system.process(frame).T_world_camera for frame in frames]
        assert all(T is not None for T in found)
        positions, truth = (np.array(T)[:, :3, 3] for T in (found, path(times_s)))
        error = transform(align(positions, truth).T_reference_estimate, positions) - truth
        ate_m[readout_s] = float(np.sqrt((error**2).sum(axis=1).mean()))
    assert ate_m[0.025] < 0.5 * ate_m[0.0] < ate_m[-0.025], ate_m
