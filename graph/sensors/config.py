"""The settings of all sensors."""

from __future__ import annotations

from dataclasses import dataclass, field

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.sensors.accelerometer import AccelerometerConfig
from bmask_slam.graph.sensors.imu import ImuConfig
from bmask_slam.graph.sensors.markers import MarkersConfig
from bmask_slam.graph.sensors.odometry import OdometryConfig
from bmask_slam.graph.sensors.planar import PlanarConfig
from bmask_slam.graph.sensors.position import PositionConfig


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
