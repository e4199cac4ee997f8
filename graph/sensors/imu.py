"""An inertial measurement unit: rates and specific forces between keyframes, and how they begin.

The factors are GTSAM's (`graph.inertial.preintegration`); here readings are cut to the keyframes'
times, and gravity, the gyroscope's bias and velocities get their first values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import so3_exp, so3_log
from bmask_slam.graph.inertial.tables import ImuModel
from bmask_slam.graph.sensors.mounting import Mounting, T_of
from bmask_slam.graph.sensors.streams import SensorStreams

_SPEED_WEIGHT_S = 0.1
"""An error of 1 m/s of a change of velocity counts as one of so many metres."""
_ITERATIONS = 3
_GRAVITY_RATIO = 1.15
"""Gravity as it is found is at most so many times too large or too small."""


@dataclass(frozen=True)
class ImuConfig:
    """Noise and mounting of an IMU; the noise is that of the data sheet of an MPU-9250.

    Attributes:
        enabled: whether measurements are used.
        imu_in_camera: T_camera_imu; p_camera = T_camera_imu @ p_imu. null: it is estimated, with
            the delay, once the camera has turned enough; until then the IMU is not used.
        delay_s: the IMU's stamps are so much later than the camera's for the same moment.
        sigma_gyroscope, sigma_accelerometer: densities of white noise, rad/s/sqrt(Hz) and
            m/s^2/sqrt(Hz).
        sigma_gyroscope_walk, sigma_accelerometer_walk: of the biases, rad/s^2/sqrt(Hz) and
            m/s^3/sqrt(Hz).
        sigma_gyroscope_bias, sigma_accelerometer_bias: how large a bias may be, rad/s and m/s^2.
        gravity_m_s2: size of gravity.
        max_gap_s: no factor over a longer gap between readings ...
        max_apart_s: ... nor between keyframes so far apart.
        begin_s: gravity and velocities begin once keyframes span so long.
        max_blackout_s: longest time that the IMU alone gives the pose of frames.
    """

    enabled: bool = True
    imu_in_camera: Mounting | None = None
    delay_s: float = 0.0
    sigma_gyroscope: float = 1.75e-4
    sigma_accelerometer: float = 3e-3
    sigma_gyroscope_walk: float = 2e-5
    sigma_accelerometer_walk: float = 3e-4
    sigma_gyroscope_bias: float = 0.05
    sigma_accelerometer_bias: float = 0.3
    gravity_m_s2: float = 9.81
    max_gap_s: float = 0.05
    max_apart_s: float = 10.0
    begin_s: float = 1.5
    max_blackout_s: float = 1.5

    @property
    def T_camera_imu(self) -> Array:
        """The mounting (4, 4); the camera itself where it is not given."""
        return np.eye(4) if self.imu_in_camera is None else T_of(self.imu_in_camera)

    @property
    def model(self) -> ImuModel:
        """The same as the factors have it."""
        return ImuModel(
            self.T_camera_imu,
            self.sigma_gyroscope,
            self.sigma_accelerometer,
            self.sigma_gyroscope_walk,
            self.sigma_accelerometer_walk,
            self.sigma_gyroscope_bias,
            self.sigma_accelerometer_bias,
            self.gravity_m_s2,
        )


def readings_between(
    streams: SensorStreams, begin_s: float, end_s: float, config: ImuConfig, ahead_s: float = 0.0
) -> Array | None:
    """Intervals (N, 10) from one time to another, as an `InertialFactor` has them.

    Each is the mean of the readings at its ends, those at both times being interpolated. None where
    the IMU does not cover the time, or has a gap in it; the last reading holds for ``ahead_s``.
    """
    begin_s, end_s = begin_s + config.delay_s, end_s + config.delay_s
    rows = streams.within("imu", begin_s - config.max_gap_s, end_s + config.max_gap_s)
    if len(rows) < 2 or not (rows[0, 0] <= begin_s < min(end_s, rows[-1, 0])):
        return None
    if end_s > rows[-1, 0] + ahead_s:
        return None
    first = int(np.searchsorted(rows[:, 0], begin_s, side="right")) - 1
    last = min(int(np.searchsorted(rows[:, 0], end_s, side="left")), len(rows) - 1)
    used = rows[first : last + 1]
    if np.diff(used[:, 0]).max() > config.max_gap_s:
        return None
    inside = used[(used[:, 0] > begin_s) & (used[:, 0] < end_s), 0]
    times_s = np.concatenate([[begin_s], inside, [end_s]])
    at = np.column_stack([np.interp(times_s, used[:, 0], column) for column in used[:, 1:].T])
    seconds, mean = np.diff(times_s), (at[:-1] + at[1:]) / 2
    alpha = np.diff(at[:, :3], axis=0) / seconds[:, None]
    return np.column_stack([seconds, mean[:, 3:], mean[:, :3], alpha])


@dataclass(frozen=True)
class Beginning:
    """First values: gravity's direction (3,) in the world, and states (K, 9) of keyframes."""

    down: Array
    states: Array


def begin(T_world_camera: Array, readings: Sequence[Array], config: ImuConfig) -> Beginning | None:
    """First values by the poses of keyframes (K, 4, 4) and the readings (K - 1) between them.

    The gyroscope's bias is the median of what the turns differ by. Gravity g and the IMU's
    velocities v then solve ``p_b = p_a + v_a t + R_a dp + g t^2 / 2`` and ``v_b = v_a + R_a dv +
    g t`` (dp, dv: the readings' integrals in frame a). None if that contradicts gravity's size.
    """
    T = T_world_camera @ config.T_camera_imu
    R, p, lever = T[:, :3, :3], T[:, :3, 3], T[:, :3, 3] - T_world_camera[:, :3, 3]
    times_s, bias = np.array([r[:, 0].sum() for r in readings]), np.zeros(3)
    for _ in range(_ITERATIONS):
        turns = [turned(r, bias)[-1] for r in readings]
        off = so3_log(np.array(turns).mT @ R[:-1].mT @ R[1:])
        bias = bias - np.median(off / times_s[:, None], axis=0)
    A, b = np.zeros((len(readings), 2, 1 + len(T))), np.zeros((len(readings), 2, 3))
    for k, (rows, t) in enumerate(zip(readings, times_s.tolist(), strict=True)):
        dv, dp = integrals(rows, bias)
        A[k, 0, [0, k + 1]] = t * t / 2, t
        A[k, 1, [0, k + 1, k + 2]] = t, 1.0, -1.0
        b[k] = p[k + 1] - p[k] - R[k] @ dp, -R[k] @ dv
    weights = np.array([1.0, _SPEED_WEIGHT_S])[:, None]
    x = np.linalg.lstsq(
        (A * weights).reshape(-1, 1 + len(T)), (b * weights).reshape(-1, 3), rcond=None
    )[0]
    size = float(np.linalg.norm(x[0]))
    if not 1 / _GRAVITY_RATIO < size / config.gravity_m_s2 < _GRAVITY_RATIO:
        return None
    rates = np.array([*(r[0, 4:7] for r in readings), readings[-1][-1, 4:7]]) - bias
    velocities = x[1:] - np.cross((R @ rates[:, :, None])[:, :, 0], lever)
    states = np.column_stack([velocities, np.tile([0, 0, 0, *bias], (len(T), 1))])
    return Beginning(x[0] / size, states)


def turned(readings: Array, bias_rad_s: Array) -> Array:
    """Rotations (N + 1, 3, 3) of the IMU at the ends of readings (N, 10), from the first time."""
    R = [np.eye(3)]
    for step in so3_exp((readings[:, 4:7] - bias_rad_s) * readings[:, :1]):
        R.append(R[-1] @ step)
    return np.array(R)


def integrals(readings: Array, bias_rad_s: Array) -> tuple[Array, Array]:
    """The force's first and second integral over readings (N, 10), in the first IMU frame."""
    seconds = readings[:, :1]
    middle = turned(readings, bias_rad_s)[:-1] @ so3_exp(
        (readings[:, 4:7] - bias_rad_s) * seconds / 2
    )
    steps = (middle @ readings[:, 1:4, None])[:, :, 0] * seconds
    dv = np.cumsum(steps, axis=0)
    return dv[-1], np.sum((dv - steps / 2) * seconds, axis=0)
