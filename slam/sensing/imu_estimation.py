"""The mounting of an IMU that nobody has given: estimated from keyframes until it is known well."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from bmask_slam.events import EventLog
from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.geometry import quaternion_from_rotation
from bmask_slam.graph.sensors.imu import ImuConfig, readings_between
from bmask_slam.graph.sensors.imu_mounting import ImuMounting, find_mounting
from bmask_slam.graph.sensors.streams import SensorStreams
from bmask_slam.world.keyframe import Keyframe

KNOWN_RAD, WELL_KNOWN_RAD = 0.005, 0.001
"""The IMU is used once the mounting's sigmas are below; below the second, they stay as they are."""
KNOWN_LEVER_M = 0.03
"""A lever with a larger sigma counts as none ..."""
KNOWN_DELAY_S, DELAY_SIGMAS = 0.002, 3.0
"""... and so does a delay that is not known so well, or not so many sigmas long."""
EVERY = 5
"""After so many further keyframes it is tried again."""
NEWEST, APART_S = 100, 0.25
"""By so many of the newest keyframes, those that are so far apart."""
MARGIN_S = 0.05
"""Readings begin so long before, for delays that are tried."""


class MountingEstimator:
    """Estimates how the IMU is mounted, if the configuration does not say it.

    Attributes:
        found: T_camera_imu in TUM's columns and the delay in s, (8,); empty while not known.
        sigma_rad: of its rotation, the largest.
    """

    def __init__(self, config: ImuConfig, events: EventLog) -> None:
        self.found: Array = np.zeros(0)
        self.sigma_rad = np.inf
        self._config, self._events = config, events
        self._tried = 0  # with so many keyframes

    @property
    def config(self) -> ImuConfig | None:
        """The settings with the mounting; None while it is not known."""
        if self._config.imu_in_camera is not None:
            return self._config
        return with_mounting(self._config, self.found) if len(self.found) else None

    def update(self, keyframes: Sequence[Keyframe], streams: SensorStreams) -> None:
        """Estimate by the keyframes of a segment, if that is due."""
        given = self._config.imu_in_camera is not None or not self._config.enabled
        if given or not len(streams.of("imu")) or self.sigma_rad < WELL_KNOWN_RAD:
            return
        if abs(len(keyframes) - self._tried) < EVERY:
            return
        self._tried = len(keyframes)
        mounting = self._estimate(keyframes[-NEWEST:], streams)
        if mounting is None:
            return
        sigma_rad = float(mounting.sigmas_rad.max())
        if sigma_rad < min(KNOWN_RAD, 0.7 * self.sigma_rad):
            self._adopt(mounting, sigma_rad)

    def _estimate(
        self, keyframes: Sequence[Keyframe], streams: SensorStreams
    ) -> ImuMounting | None:
        """By the newest keyframes in a row that the IMU covers."""
        config, begin = self._config, 0
        keyframes = _apart(keyframes)
        stamps_s = [k.timestamp_s for k in keyframes]
        for k, (a, b) in enumerate(pairwise(stamps_s)):
            if readings_between(streams, a - MARGIN_S, b, config) is None:
                begin = k + 1
        poses, times = np.array([k.T_world_camera for k in keyframes[begin:]]), stamps_s[begin:]

        def cut(delay_s: float) -> list[Array] | None:
            late = replace(config, delay_s=delay_s)
            found = [readings_between(streams, a, b, late, 0.1) for a, b in pairwise(times)]
            known = [rows for rows in found if rows is not None]
            return known if len(known) == len(found) else None

        return find_mounting(poses, cut, config) if len(times) > 1 else None

    def _adopt(self, mounting: ImuMounting, sigma_rad: float) -> None:
        T, delay_s = mounting.T_camera_imu, self._config.delay_s
        lever = T[:3, 3] if mounting.lever_sigma_m < KNOWN_LEVER_M else np.zeros(3)
        late_s = abs(mounting.delay_s - delay_s)
        sure = mounting.delay_sigma_s < KNOWN_DELAY_S
        if sure and late_s > DELAY_SIGMAS * mounting.delay_sigma_s:
            delay_s = mounting.delay_s
        quaternion = quaternion_from_rotation(T[None, :3, :3])[0]
        self.found, self.sigma_rad = np.array([*lever, *quaternion, delay_s]), sigma_rad
        place = ", ".join(f"{x:.4f}" for x in self.found[:7])
        how = f"to {mounting.lever_sigma_m:.3f} m" if lever.any() else "not observable, taken as 0"
        text = (
            f"imu: mounting estimated, sensors.imu.imu_in_camera=[{place}]: rotation to "
            f"{np.degrees(sigma_rad):.2f} degrees, lever {how}; sensors.imu.delay_s={delay_s:.4f} "
            f"(found {mounting.delay_s:.4f}, sigma {mounting.delay_sigma_s:.4f})"
        )
        self._events.sensor(text)

    def report(self, streams: SensorStreams) -> None:
        """At the end: say that an IMU was not used, and why."""
        if self._config.enabled and len(streams.of("imu")) and self.config is None:
            self._events.sensor(
                "imu: not used: how it is mounted was not given and cannot be seen; turn the "
                "camera about two axes, or set sensors.imu.imu_in_camera",
                logging.WARNING,
            )

    def begin_session(self) -> None:
        """Another recording: the IMU may be another one."""
        self.found, self.sigma_rad, self._tried = np.zeros(0), np.inf, 0

    def state(self) -> Arrays:
        """What was found."""
        numbers = np.array([self.sigma_rad, self._tried])
        return {"imu_mounting": np.concatenate([numbers, self.found])}

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        if len(state["imu_mounting"]):
            self.sigma_rad, tried = state["imu_mounting"][:2].tolist()
            self._tried, self.found = int(tried), state["imu_mounting"][2:]


def _apart(keyframes: Sequence[Keyframe]) -> list[Keyframe]:
    """The keyframes that are at least ``APART_S`` after the one before: short turns say little."""
    chosen = list(keyframes[:1])
    for keyframe in keyframes:
        if keyframe.timestamp_s - chosen[-1].timestamp_s > APART_S:
            chosen.append(keyframe)
    return chosen


def with_mounting(config: ImuConfig, found: Array) -> ImuConfig:
    """The settings with T_camera_imu in TUM's columns and the delay in s (8,)."""
    x, y, z, qx, qy, qz, qw, delay_s = found.tolist()
    return replace(config, imu_in_camera=(x, y, z, qx, qy, qz, qw), delay_s=delay_s)
