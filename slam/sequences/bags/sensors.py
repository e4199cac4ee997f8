"""Sensors beside the camera from a ROS bag: IMU, odometry, positions, an accelerometer.

Only topics that are named are read: how a sensor is mounted is said by ``sensors.*``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.sensors.streams import Measurements, measurements
from bmask_slam.sequences.bags.bag_file import open_bag
from bmask_slam.sequences.bags.ros_images import stamp_s

_IMU, ODOMETRY = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
FIX, _POSE = "sensor_msgs/msg/NavSatFix", "geometry_msgs/msg/PoseStamped"
_POINT = "geometry_msgs/msg/PointStamped"
TYPES: dict[str, tuple[str, ...]] = {
    "imu": (_IMU,),
    "accelerometer": (_IMU,),
    "odometry": (ODOMETRY, _POSE),
    "position": (FIX, _POSE, _POINT, ODOMETRY),
}
"""The types of messages that each sensor may have."""
WGS84_A_M, WGS84_E2 = 6378137.0, 6.69437999014e-3
"""Semi-major axis, and squared eccentricity."""


@dataclass(frozen=True)
class SensorTopics:
    """The topic of each sensor; "" for none."""

    imu: str = ""
    odometry: str = ""
    position: str = ""
    accelerometer: str = ""


def read_sensors(path: Path, wanted: SensorTopics) -> list[Measurements]:
    """The measurements of the topics that are named. A bag is read once, before its images.

    Positions of satellites become metres east, north and up of the first one. Of messages with the
    same stamp the first is kept.

    Raises:
        InputError: a topic is missing, of another type, or has no measurement.
    """
    topics = {sensor: topic for sensor, topic in asdict(wanted).items() if topic}
    if not topics:
        return []
    rows: dict[str, list[list[float]]] = {sensor: [] for sensor in topics}
    with open_bag(path) as bag:
        kinds = {topic.name: topic.type for topic in bag.topics if topic.messages}
        for sensor, topic in topics.items():
            if kinds.get(topic) not in TYPES[sensor]:
                has = ", ".join(name for name, kind in kinds.items() if kind in TYPES[sensor])
                raise InputError(
                    f"{path}: no {' or '.join(TYPES[sensor])} on {topic} for --{sensor}-topic; "
                    f"the bag has {has or 'none'}"
                )
        for topic, message in bag.messages(*topics.values()):
            for sensor in (sensor for sensor, name in topics.items() if name == topic):
                row = sensor_row(sensor, message, kinds[topic])
                if np.isfinite(row[:-1]).all() and (sensor == "position" or np.isfinite(row[-1])):
                    rows[sensor].append([stamp_s(message.header), *row])
    return [_measured(s, rows[s], f"{path}, {topics[s]}", kinds[topics[s]]) for s in topics]


def _measured(sensor: str, rows: list[list[float]], where: str, kind: str) -> Measurements:
    if not rows:
        raise InputError(f"{where}: no usable measurement; leave the topic out")
    table = np.array(rows)
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    if kind == FIX:
        table[:, 1:4] = east_north_up(table[:, 1:4])
    return measurements(sensor, table, where)


def east_north_up(fixes: Array) -> Array:
    """Latitude, longitude in degrees and height in m (N, 3) as metres from the first (N, 3)."""
    lat, lon = np.radians(fixes[:, :2].T)
    n = WGS84_A_M / np.sqrt(1 - WGS84_E2 * np.sin(lat) ** 2)
    across = (n + fixes[:, 2]) * np.cos(lat)
    up = (n * (1 - WGS84_E2) + fixes[:, 2]) * np.sin(lat)
    ecef = np.column_stack([across * np.cos(lon), across * np.sin(lon), up])
    (s, c), (t, d) = (np.sin(lat[0]), np.cos(lat[0])), (np.sin(lon[0]), np.cos(lon[0]))
    R_enu_ecef = np.array([[-t, d, 0], [-s * d, -s * t, c], [c * d, c * t, s]])
    return np.asarray((ecef - ecef[0]) @ R_enu_ecef.T)


def sensor_row(sensor: str, message: Any, kind: str) -> list[float]:
    """A measurement in the sensor's columns, without its stamp; a satellite fix in degrees."""
    return _ROWS[sensor](message, kind)


def _imu(message: Any, _: str) -> list[float]:
    return [*_xyz(message.angular_velocity), *_xyz(message.linear_acceleration)]


def _accelerometer(message: Any, _: str) -> list[float]:
    return _xyz(message.linear_acceleration)


def _odometry(message: Any, kind: str) -> list[float]:
    pose = _pose(message, kind)
    q = pose.orientation
    return [*_xyz(pose.position), q.x, q.y, q.z, q.w]


def _position(message: Any, kind: str) -> list[float]:
    if kind == FIX:
        known = message.position_covariance_type > 0
        variance = np.mean(np.asarray(message.position_covariance, float).reshape(3, 3).diagonal())
        sigma = float(np.sqrt(variance)) if known and variance > 0 else np.nan
        fixed = message.status.status >= 0
        return [message.latitude if fixed else np.nan, message.longitude, message.altitude, sigma]
    point = message.point if kind == _POINT else _pose(message, kind).position
    return [*_xyz(point), np.nan]


_ROWS: dict[str, Callable[[Any, str], list[float]]] = {
    "imu": _imu,
    "accelerometer": _accelerometer,
    "odometry": _odometry,
    "position": _position,
}


def _pose(message: Any, kind: str) -> Any:
    return message.pose.pose if kind == ODOMETRY else message.pose


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]
