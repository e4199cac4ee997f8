"""The mounting and delay of an IMU by the camera's motion: exact, with noise, not observable."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, make_pose, se3_log, so3_exp
from bmask_slam.graph.sensors.imu import ImuConfig, readings_between
from bmask_slam.graph.sensors.imu_mounting import ImuMounting, find_mounting
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.sensors.streams import Measurements, SensorStreams
from bmask_slam.rendering.sensors import imu

HERTZ, DELAY_S = 200.0, 0.012
MOUNTED = ImuConfig(imu_in_camera=(0.2, -0.1, 0.05, 0.5, -0.5, 0.5, -0.5))
QUIET = replace(MOUNTED, **dict.fromkeys([f for f in vars(MOUNTED) if f.startswith("sigma")], 0.0))


def path(axes: Array) -> Array:
    """Poses (N, 4, 4) of a camera for 8 s that swings about these axes, z up."""
    t = np.arange(1601)[:, None] / HERTZ
    p = 0.3 * np.sin(t * [1.3, 0.9, 1.7] + [0.1, 0.4, 0.9])
    return make_pose(so3_exp(axes * np.sin(t * [2.1, 1.5, 2.6] + [1.0, 0.2, 0.5])), p)


def found(axes: Array, config: ImuConfig, rng: np.random.Generator | None) -> ImuMounting:
    """By keyframes every 0.2 s, of a world that is not upright; with noise where numbers are."""
    poses, streams = path(axes), SensorStreams()
    rows = imu(poses, HERTZ, config, np.random.default_rng(1) if rng is None else rng)
    rows[:, 0] += DELAY_S
    streams.add(Measurements("imu", rows))
    stamps_s = np.arange(0.2, 7.6, 0.2)
    T = make_pose(so3_exp(np.array([1.2, 0.7, -0.4])), np.ones(3)) @ poses
    T = T[np.rint(stamps_s * HERTZ).astype(int)]
    if rng is not None:  # a map drifts: errors of its steps are independent
        turns, shifts = 0.001 * rng.normal(size=(2, len(T), 3))
        steps, walk = inverse(T[:-1]) @ T[1:] @ make_pose(so3_exp(turns), shifts)[1:], [T[0]]
        for step in steps:
            walk.append(walk[-1] @ step)
        T = np.array(walk)

    def cut(delay_s: float) -> list[Array] | None:
        late = replace(ImuConfig(), delay_s=delay_s)
        pairs = [readings_between(streams, a, b, late) for a, b in pairwise(stamps_s)]
        known = [rows for rows in pairs if rows is not None]
        return known if len(known) == len(pairs) else None

    mounting = find_mounting(T, cut, ImuConfig())
    assert mounting is not None
    return mounting


SWINGS = np.array([0.5, 0.4, 0.3])


def test_an_exact_mounting_and_delay_are_found() -> None:
    """A wrong frame, sign or unit moves them by more than the bounds."""
    mounting = found(SWINGS, QUIET, None)
    off = se3_log(inverse(T_of(MOUNTED.imu_in_camera or ())) @ mounting.T_camera_imu)
    assert np.abs(off[:3]).max() < 1e-4
    assert np.abs(off[3:]).max() < 0.005
    assert mounting.delay_s == pytest.approx(DELAY_S, abs=1e-4)


def test_the_sigmas_are_those_of_drawn_noise() -> None:
    """NEES of 6 mountings within its 99 % band, with the biases of an MPU-9250."""
    X, nees, late = T_of(MOUNTED.imu_in_camera or ()), [], []
    for seed in range(6):
        mounting = found(SWINGS, MOUNTED, np.random.default_rng(seed))
        off = se3_log(inverse(X) @ mounting.T_camera_imu)
        nees.append(float(np.mean((off[:3] / mounting.sigmas_rad) ** 2)))
        late.append((mounting.delay_s - DELAY_S) / mounting.delay_sigma_s)
        assert mounting.sigmas_rad.max() < 0.003
        assert np.abs(off[3:]).max() < 4 * mounting.lever_sigma_m
    assert 0.35 < np.mean(nees) < 2.05
    assert 0.3 < np.std(late) < 1.8


def test_turns_about_one_axis_leave_the_rotation_open() -> None:
    mounting = found(np.array([0.0, 0.5, 0.0]), MOUNTED, np.random.default_rng(3))
    assert mounting.sigmas_rad.max() > 0.05
