"""Sensors beside the camera of a rendered sequence: exact motion with the noise that is assumed.

The noise has the sigmas of the default `SensorsConfig`, so that an estimate can be judged by them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import (
    inverse,
    make_pose,
    quaternion_from_rotation,
    se3_exp,
    so3_exp,
    so3_log,
)
from bmask_slam.graph.sensors.accelerometer import UP
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.imu import ImuConfig
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.sensors.odometry import OdometryConfig, step_covariances
from bmask_slam.graph.sensors.position import PositionConfig
from bmask_slam.graph.sensors.streams import COLUMNS, FILES
from bmask_slam.rendering.config import MARKERS, RenderConfig
from bmask_slam.rendering.engine.path import CameraPath, camera_poses

GRAVITY_M_S2 = 9.81
FORCE_HZ, FORCE_SIGMA_M_S2, FORCE_BIAS_M_S2 = 200.0, 0.05, 0.03
"""Of the accelerometer: rate, white noise of a sample, constant error of each axis."""
POSITION_S, POSITION_SIGMA_M = 1.0, 0.1
"""Time between positions, and their error: those of ultra-wideband."""
T_ENU_RENDERED = make_pose(so3_exp(np.array([0.0, 0.0, 0.7])), np.array([40.0, -25.0, 8.0]))
"""The frame of positions: not that of the ground truth, with the same way up."""


def odometry(
    T_world_camera: Array, stamps_s: Array, config: OdometryConfig, rng: np.random.Generator
) -> Array:
    """Rows (N, 8) of odometry along poses (N, 4, 4), a random walk of the configured noise."""
    T_world_base = T_world_camera @ inverse(T_of(config.camera_in_base))
    steps = inverse(T_world_base[:-1]) @ T_world_base[1:]
    Q = step_covariances(steps, np.diff(stamps_s), config)
    noise = rng.standard_normal((len(steps), 6)) * np.sqrt(np.diagonal(Q, axis1=1, axis2=2))
    T = [np.eye(4)]
    for step in steps @ se3_exp(noise):
        T.append(T[-1] @ step)
    poses = np.array(T)
    quaternions = quaternion_from_rotation(poses[:, :3, :3])
    return np.column_stack([stamps_s, poses[:, :3, 3], quaternions])


def positions(
    T_world_camera: Array, stamps_s: Array, config: PositionConfig, rng: np.random.Generator
) -> Array:
    """Rows (M, 5) of the antenna's positions in a local frame, one a second."""
    every = max(1, round(POSITION_S / np.diff(stamps_s).mean())) if len(stamps_s) > 1 else 1
    T, times_s = T_ENU_RENDERED @ T_world_camera[::every], stamps_s[::every]
    antennas = T[:, :3, :3] @ np.array(config.antenna_in_camera) + T[:, :3, 3]
    measured = antennas + POSITION_SIGMA_M * rng.standard_normal(antennas.shape)
    return np.column_stack([times_s, measured, np.full(len(T), POSITION_SIGMA_M)])


def accelerometer(
    T_world_camera: Array, mounting: Array, hertz: float, rng: np.random.Generator
) -> Array:
    """Rows (N, 4) of specific force, ``R_world_sensor^T (a_world + g up)``, at an even rate."""
    acceleration = np.gradient(np.gradient(T_world_camera[:, :3, 3], axis=0), axis=0) * hertz**2
    force_world = acceleration + GRAVITY_M_S2 * UP
    R_world_sensor = T_world_camera[:, :3, :3] @ mounting[:3, :3]
    force = (R_world_sensor.mT @ force_world[:, :, None])[:, :, 0]
    bias = FORCE_BIAS_M_S2 * rng.standard_normal(3)
    force += bias + FORCE_SIGMA_M_S2 * rng.standard_normal(force.shape)
    return np.column_stack([np.arange(len(force)) / hertz, force])


def imu(T_world_camera: Array, hertz: float, config: ImuConfig, rng: np.random.Generator) -> Array:
    """Rows (N, 7) of an IMU at poses (N, 4, 4) of an even rate: rates and forces with their biases.

    Rates are those from the pose before to the one after (at the ends from or to the pose itself),
    forces the second differences of the IMU's position, so that their integrals lead back to the
    poses.
    """
    T = T_world_camera @ config.T_camera_imu
    R, p = T[:, :3, :3], T[:, :3, 3]
    padded = np.concatenate([R[:1], R, R[-1:]])
    steps = np.r_[1, np.full(len(R) - 2, 2), 1]
    rates = so3_log(padded[:-2].mT @ padded[2:]) * hertz / steps[:, None]
    p = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    force_world = np.diff(p, 2, axis=0) * hertz**2 + config.gravity_m_s2 * UP
    forces = (R.mT @ force_world[:, :, None])[:, :, 0]
    walks = (config.sigma_gyroscope_walk, config.sigma_accelerometer_walk)
    whites = (config.sigma_gyroscope, config.sigma_accelerometer)
    begins = (config.sigma_gyroscope_bias, config.sigma_accelerometer_bias)
    columns = [np.arange(len(T)) / hertz]
    for exact, white, walk, begin in zip((rates, forces), whites, walks, begins, strict=True):
        steps = walk / np.sqrt(hertz) * rng.standard_normal(exact.shape)
        bias = begin * rng.standard_normal(3) + np.cumsum(steps, axis=0)
        noise = white * np.sqrt(hertz) * rng.standard_normal(exact.shape)
        columns.append(exact + bias + noise)
    return np.column_stack(columns)


def write_sensors(folder: Path, wanted: RenderConfig, poses: Array, path: CameraPath) -> None:
    """Write the files of sensors for the poses (N, 4, 4) of a path's frames."""
    config, stamps_s = SensorsConfig(), np.arange(len(poses)) / wanted.fps
    for number, name in enumerate(name for name in wanted.sensors if name != MARKERS):
        rng = np.random.default_rng([wanted.seed, 23, number])
        if name == "odometry":
            rows = odometry(poses, stamps_s, config.odometry, rng)
        elif name == "position":
            rows = positions(poses, stamps_s, config.position, rng)
        else:
            mounting = T_of(config.accelerometer.accelerometer_in_camera)
            count = max(int(len(poses) / wanted.fps * FORCE_HZ), 3)  # for an acceleration
            fine = camera_poses(path, FORCE_HZ, wanted.seed, sweeping=wanted.sweeping)[:count]
            if name == "imu":
                rows = imu(fine, FORCE_HZ, config.imu, rng)
            else:
                rows = accelerometer(fine, mounting, FORCE_HZ, rng)
        (folder / FILES[name]).write_text(_text(name, rows), encoding="utf-8")


def _text(name: str, rows: Array) -> str:
    """The file of a sensor; an IMU's as EuRoC writes it."""
    if name == "imu":
        lines = ["#timestamp [ns]," + ",".join(COLUMNS[name][1:])]
        lines += [f"{row[0] * 1e9:.0f}," + ",".join(f"{x:.9f}" for x in row[1:]) for row in rows]
    else:
        lines = [f"# {name}, rendered", f"# {' '.join(COLUMNS[name])}"]
        lines += [f"{row[0]:.6f} " + " ".join(f"{x:.9f}" for x in row[1:]) for row in rows.tolist()]
    return "\n".join(lines) + "\n"
