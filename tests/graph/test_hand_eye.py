"""The lever arm of a reference's body on the camera."""

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, so3_exp
from bmask_slam.graph.hand_eye import body_trajectory, hand_eye
from bmask_slam.graph.trajectory import Trajectory

T_CAMERA_IMU = make_pose(so3_exp(np.array([1.2, -1.1, 1.3])), np.array([0.05, 0.16, -0.11]))
"""Axes as different as those of a camera and an IMU usually are."""
T_WORLDS = make_pose(so3_exp(np.array([0.3, 2.0, -0.4])), np.array([5.0, -2.0, 1.0]))


def moving(turn_rad: Array, count: int = 200, fps: float = 10.0) -> Trajectory:
    """A camera on a curve that rotates about the axes by these amplitudes."""
    t = np.arange(count) / fps
    swing = turn_rad * np.sin(np.outer(t, [0.9, 1.3, 0.7]))
    path = np.column_stack([np.sin(0.3 * t), 0.2 * np.cos(0.5 * t), 0.1 * t])
    return Trajectory(t, make_pose(so3_exp(swing), path))


def shaken(trajectory: Trajectory, sigma: float) -> Trajectory:
    xi = sigma * np.random.default_rng(0).standard_normal((len(trajectory), 6))
    return Trajectory(trajectory.timestamps_s, trajectory.poses_world_camera @ se3_exp(xi))


def reference_of(camera: Trajectory, T_camera_body: Array) -> Trajectory:
    body = body_trajectory(camera, T_camera_body)
    return Trajectory(body.timestamps_s, T_WORLDS @ body.poses_world_camera)


def test_exact_motion_gives_the_exact_lever_arm() -> None:
    camera = moving(np.array([0.4, 0.5, 0.3]))
    found = hand_eye(camera, reference_of(camera, T_CAMERA_IMU))
    np.testing.assert_allclose(found, T_CAMERA_IMU, atol=1e-6)


def test_noise_has_little_effect_on_the_lever_arm() -> None:
    camera = moving(np.array([0.4, 0.5, 0.3]))
    found = hand_eye(shaken(camera, 0.003), reference_of(camera, T_CAMERA_IMU))
    off = inverse(T_CAMERA_IMU) @ found
    assert np.linalg.norm(off[:3, 3]) < 0.005
    assert np.arccos((np.trace(off[:3, :3]) - 1) / 2) < 0.005


def test_rotation_about_one_axis_leaves_the_unobservable_part_zero() -> None:
    """A robot on a floor: rotation about y, motion in x, z; the body's height is unobservable."""
    t = np.arange(200) / 10
    turns = np.column_stack([0 * t, np.sin(0.9 * t), 0 * t])
    path = np.column_stack([np.sin(0.3 * t), 0 * t, 0.1 * t])
    camera = Trajectory(t, make_pose(so3_exp(turns), path))
    X = make_pose(so3_exp(np.array([0.0, 0.7, 0.0])), np.array([0.1, 0.4, -0.2]))
    found = hand_eye(camera, reference_of(camera, X))
    np.testing.assert_allclose(found[:3, :3], X[:3, :3], atol=1e-5)
    np.testing.assert_allclose(found[:3, 3], [0.1, 0.0, -0.2], atol=1e-5)


def test_a_camera_without_rotation_is_rejected() -> None:
    camera = moving(np.zeros(3))
    with pytest.raises(InputError, match=r"turns by at most 0\.00 degrees.*without --hand-eye"):
        hand_eye(camera, reference_of(camera, T_CAMERA_IMU))
