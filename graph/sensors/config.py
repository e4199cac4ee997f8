"""The settings of all sensors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from bmask_slam.graph.errors import InputError, naming
from bmask_slam.graph.sensors.accelerometer import AccelerometerConfig
from bmask_slam.graph.sensors.imu import ImuConfig
from bmask_slam.graph.sensors.markers import MarkersConfig
from bmask_slam.graph.sensors.mounting import Mounting, T_of
from bmask_slam.graph.sensors.odometry import OdometryConfig
from bmask_slam.graph.sensors.planar import PlanarConfig
from bmask_slam.graph.sensors.position import PositionConfig

POSITIVE = {
    "accelerometer": ("sigma_mounting_rad", "sigma_rad"),
    "position": ("sigma_m",),
    "imu": (
        "gravity_m_s2",
        "sigma_gyroscope",
        "sigma_gyroscope_walk",
        "sigma_gyroscope_bias",
        "sigma_accelerometer",
        "sigma_accelerometer_walk",
        "sigma_accelerometer_bias",
    ),
    "planar": ("sigma_height_m", "sigma_tilt_rad"),
    "markers": ("corner_px", "size_sigma", "sigma_m", "sigma_rad"),
}
"""Settings by sensor that are divided by, or whose factors have no inverse where they are 0."""


@dataclass(frozen=True)
class SensorsConfig:
    """Settings of the sensors beside the camera.

    ``late_s``: a measurement that comes so long after the newest keyframe's time, or later, is
    refused.
    """

    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    accelerometer: AccelerometerConfig = field(default_factory=AccelerometerConfig)
    position: PositionConfig = field(default_factory=PositionConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    planar: PlanarConfig = field(default_factory=PlanarConfig)
    markers: MarkersConfig = field(default_factory=MarkersConfig)
    late_s: float = 10.0

    def __post_init__(self) -> None:
        """Raise InputError for a mounting that is no pose, or a sigma that is not positive."""
        for name, mounting in self._mountings():
            with naming(f"sensors.{name}"):
                T_of(mounting)
        for sensor, names in POSITIVE.items():
            for name in names:
                value = getattr(getattr(self, sensor), name)
                if not 0 < value < math.inf:
                    raise InputError(f"sensors.{sensor}.{name} = {value:g}: give a positive number")

    def _mountings(self) -> Iterator[tuple[str, Mounting]]:
        """All mountings and known poses, by the names of their settings."""
        yield "odometry.camera_in_base", self.odometry.camera_in_base
        yield "accelerometer.accelerometer_in_camera", self.accelerometer.accelerometer_in_camera
        yield "planar.camera_in_base", self.planar.camera_in_base
        if self.imu.imu_in_camera is not None:
            yield "imu.imu_in_camera", self.imu.imu_in_camera
        for number, *pose in self.markers.poses:
            x, y, z, qx, qy, qz, qw = pose
            yield f"markers.poses: {number}", (x, y, z, qx, qy, qz, qw)

    @property
    def enabled(self) -> tuple[str, ...]:
        """Names of the sensors that are used."""
        sensors = ("odometry", "accelerometer", "position", "imu", "markers")
        return tuple(name for name in sensors if getattr(self, name).enabled)

    def check_enabled(self, sensor: str) -> None:
        """Raise InputError for a sensor that is not used."""
        if sensor not in self.enabled:
            raise InputError(
                f"{sensor}: not enabled; set sensors.{sensor}.enabled to true, and how it is "
                "mounted"
            )
