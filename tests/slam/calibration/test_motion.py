"""Velocities of a camera from its path."""

from __future__ import annotations

import numpy as np

from bmask_slam.calibration.motion import twists_at
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.trajectory import Trajectory

TWIST = np.array([0.4, -0.2, 0.9, 0.3, -0.5, 0.1])


def _path(stamps_s: np.ndarray) -> Trajectory:
    """A camera that moves with TWIST."""
    return Trajectory(stamps_s, se3_exp(stamps_s[:, None] * TWIST))


def test_a_steady_velocity_is_found_at_the_ends_and_beside_a_gap_too() -> None:
    stamps_s = np.array([0.0, 1, 2, 3, 12, 13, 14]) / 30
    twists = twists_at(_path(stamps_s), stamps_s)
    np.testing.assert_allclose(twists, np.tile(TWIST, (7, 1)), atol=1e-9)


def test_a_velocity_that_changes_is_that_at_the_stamp() -> None:
    stamps_s = np.arange(5) / 30
    poses = se3_exp((0.5 * stamps_s**2)[:, None] * TWIST)
    twists = twists_at(Trajectory(stamps_s, poses), stamps_s[1:-1])
    np.testing.assert_allclose(twists, stamps_s[1:-1, None] * TWIST, atol=1e-9)


def test_a_pose_alone_has_no_velocity() -> None:
    stamps_s = np.array([0.0, 1, 2, 20, 40, 41]) / 30
    path = _path(stamps_s)
    assert not twists_at(path, stamps_s[3:4]).any()  # its neighbours are too far in time
    assert not twists_at(path, np.array([10 / 30])).any()  # no pose
    assert not twists_at(_path(stamps_s[:1]), stamps_s[:1]).any()
