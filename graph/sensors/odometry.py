"""Odometry of wheels or another camera: measured motion from one keyframe to the next.

The error of odometry is a random walk: independent errors of each step, whose variances grow with
the distance, the turn and the time. A motion ``T_a_b = T_a_1 T_1_2 ... T_n_b`` therefore has the
covariance ``sum_i Ad(inverse(T_i_b)) Q_i Ad(inverse(T_i_b))^T`` of its tangent at b (Barfoot and
Furgale 2014, eq. 27, to first order).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import (
    adjoint,
    inverse,
    make_pose,
    rotation_from_quaternion,
    se3_exp,
    se3_log,
    so3_log,
)
from bmask_slam.graph.sensors.mounting import Mounting, T_of
from bmask_slam.graph.sensors.streams import SensorStreams

Kernel = Literal["none", "huber", "cauchy", "dcs"]
"""The settings of a robust kernel; "none": plain Gaussian."""


def kernel_of(setting: Kernel) -> str | None:
    """The kernel of a relative pose by its setting."""
    return None if setting == "none" else setting


@dataclass(frozen=True)
class OdometryConfig:
    """Noise and mounting of odometry.

    Attributes:
        enabled: whether measurements are used.
        camera_in_base: pose of the camera in the frame whose motion is measured.
        sigma_translation_m_per_sqrt_m: 0.02 is 2 cm after a metre and 20 cm after 100 m.
        sigma_rotation_rad_per_sqrt_m, sigma_rotation_rad_per_sqrt_rad,
        sigma_rotation_rad_per_sqrt_s: of the heading, by distance, turn and time.
        sigma_floor_m, sigma_floor_rad: of any motion, however short.
        robust: kernel against slip.
        max_gap_s: the longest time between measurements in which motion is taken to be even.
        max_blackout_s: for so long odometry alone gives the camera's pose.
    """

    enabled: bool = True
    camera_in_base: Mounting = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    sigma_translation_m_per_sqrt_m: float = 0.02
    sigma_rotation_rad_per_sqrt_m: float = 0.01
    sigma_rotation_rad_per_sqrt_rad: float = 0.02
    sigma_rotation_rad_per_sqrt_s: float = 0.001
    sigma_floor_m: float = 0.001
    sigma_floor_rad: float = 0.0005
    robust: Kernel = "cauchy"
    max_gap_s: float = 0.3
    max_blackout_s: float = 10.0


@dataclass(frozen=True)
class Motion:
    """The camera's motion from one time to another.

    Attributes:
        T_a_b: (4, 4), ``p_a = T_a_b @ p_b``.
        covariance: (6, 6) of the tangent ``[rotation rad, translation m]`` at b (right side).
    """

    T_a_b: Array
    covariance: Array


class MotionSensor(Protocol):
    """Knows how the camera moved, without images."""

    def motion(self, begin_s: float, end_s: float) -> Motion | None:
        """The motion between two times; None where it is not known."""


def motion_between(
    streams: SensorStreams, begin_s: float, end_s: float, config: OdometryConfig, ahead_s: float = 0
) -> Motion | None:
    """The camera's motion between two times; None where odometry does not cover it.

    With ``ahead_s`` the last motion may be extrapolated for so long.
    """
    rows = streams.of("odometry")
    if not config.enabled or len(rows) < 2 or not begin_s < end_s:
        return None
    if begin_s < rows[0, 0] or end_s > rows[-1, 0] + ahead_s:
        return None
    first = int(np.searchsorted(rows[:, 0], begin_s, side="right")) - 1
    last = int(np.searchsorted(rows[:, 0], end_s, side="left"))
    first, last = min(first, len(rows) - 2), min(last, len(rows) - 1)
    used = rows[first : max(last, first + 1) + 1]
    if np.diff(used[:, 0]).max() > config.max_gap_s:
        return None
    stamps_s = np.concatenate([[begin_s], used[1:-1, 0], [end_s]])
    T_odom_base = interpolated(used, stamps_s)
    return _of_camera(T_odom_base, stamps_s, config)


def interpolated(rows: Array, stamps_s: Array) -> Array:
    """Poses (M, 4, 4) at times (M,), along the geodesic between rows (N, 8) in TUM's columns.

    Times beyond the rows go on with the motion of the nearest two.
    """
    before = np.clip(np.searchsorted(rows[:, 0], stamps_s, side="right") - 1, 0, len(rows) - 2)
    T = make_pose(rotation_from_quaternion(rows[:, 4:8]), rows[:, 1:4])
    share = (stamps_s - rows[before, 0]) / (rows[before + 1, 0] - rows[before, 0])
    steps = se3_log(inverse(T[before]) @ T[before + 1])
    return np.asarray(T[before] @ se3_exp(share[:, None] * steps))


def _of_camera(T_odom_base: Array, stamps_s: Array, config: OdometryConfig) -> Motion:
    """The camera's motion over poses (N, 4, 4) of the base, with the noise of the steps."""
    T_base_camera = T_of(config.camera_in_base)
    steps = inverse(T_odom_base[:-1]) @ T_odom_base[1:]
    ends = inverse(T_odom_base[1:]) @ T_odom_base[-1]  # T_i_b of the end i of each step
    A = adjoint(inverse(ends @ T_base_camera))
    covariance = np.sum(A @ step_covariances(steps, np.diff(stamps_s), config) @ A.mT, axis=0)
    covariance += np.diag([config.sigma_floor_rad**2] * 3 + [config.sigma_floor_m**2] * 3)
    T_a_b = inverse(T_base_camera) @ inverse(T_odom_base[0]) @ T_odom_base[-1] @ T_base_camera
    return Motion(T_a_b, (covariance + covariance.T) / 2)


def step_covariances(steps: Array, durations_s: Array, config: OdometryConfig) -> Array:
    """(N, 6, 6) of each step's tangent at its end, from its length, turn and duration."""
    length_m = np.linalg.norm(steps[:, :3, 3], axis=1)
    turn_rad = np.linalg.norm(so3_log(steps[:, :3, :3]), axis=1)
    rotation = (
        config.sigma_rotation_rad_per_sqrt_m**2 * length_m
        + config.sigma_rotation_rad_per_sqrt_rad**2 * turn_rad
        + config.sigma_rotation_rad_per_sqrt_s**2 * durations_s
    )
    translation = config.sigma_translation_m_per_sqrt_m**2 * length_m
    diagonal = np.stack([rotation] * 3 + [translation] * 3, axis=1)
    return np.asarray(diagonal[:, :, None] * np.eye(6))
