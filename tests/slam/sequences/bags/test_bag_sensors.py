"""Topics of sensors beside the camera, and metres from degrees."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_bags import TYPES
from rosbags.rosbag2 import StoragePlugin, Writer

from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.bags.sensors import SensorTopics, east_north_up, read_sensors

STORE = TYPES[False]
T = STORE.types


def header(stamp_s: float) -> Any:
    return T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](int(stamp_s), 500_000_000), "")


def vector(x: float, y: float, z: float) -> Any:
    return T["geometry_msgs/msg/Vector3"](x, y, z)


def pose() -> Any:
    point = T["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
    return T["geometry_msgs/msg/Pose"](point, T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8))


def messages(stamp_s: float) -> dict[str, Any]:
    nine, many = np.zeros(9), np.zeros(36)
    still = T["geometry_msgs/msg/Twist"](vector(0, 0, 0), vector(0, 0, 0))
    moving = T["geometry_msgs/msg/TwistWithCovariance"](still, many)
    level = T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    fixed = T["sensor_msgs/msg/NavSatStatus"](0, 1)
    variances = np.diag([4.0, 4.0, 4.0]).ravel()
    where = T["geometry_msgs/msg/PoseWithCovariance"](pose(), many)
    rate, force = vector(0.1, 0.2, 0.3), vector(1.0, 2.0, 9.0)
    degrees = 48.0 + (stamp_s - 7) * 1e-5, 11.0, 500.0
    return {
        "/imu": T["sensor_msgs/msg/Imu"](header(stamp_s), level, nine, rate, nine, force, nine),
        "/odom": T["nav_msgs/msg/Odometry"](header(stamp_s), "base", where, moving),
        "/fix": T["sensor_msgs/msg/NavSatFix"](header(stamp_s), fixed, *degrees, variances, 2),
        "/pose": T["geometry_msgs/msg/PoseStamped"](header(stamp_s), pose()),
    }


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "drive"
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections: dict[str, Any] = {}
        for k in (7, 8, 8):
            for topic, message in messages(k).items():
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
                writer.write(connections[topic], k * 10**9, STORE.serialize_cdr(message, kind))
    return path


def test_each_sensor_is_read_from_its_topic_once_for_a_stamp(bag: Path) -> None:
    wanted = SensorTopics(imu="/imu", odometry="/odom", position="/fix", accelerometer="/imu")
    found = {m.sensor: m.rows for m in read_sensors(bag, wanted)}
    assert [rows[:, 0].tolist() for rows in found.values()] == [[7.5, 8.5]] * 4
    assert found["imu"][0, 1:].tolist() == [0.1, 0.2, 0.3, 1.0, 2.0, 9.0]
    assert found["accelerometer"][0, 1:].tolist() == [1.0, 2.0, 9.0]
    assert found["odometry"][0, 1:].tolist() == [1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8]
    np.testing.assert_allclose(found["position"][1, 1:], [0, 1.112, 0, 2.0], atol=1e-3)
    (poses,) = read_sensors(bag, SensorTopics(position="/pose"))
    np.testing.assert_array_equal(poses.rows[0, 1:], [1, 2, 3, np.nan])
    assert read_sensors(bag, SensorTopics()) == []


def test_a_topic_of_another_type_names_those_that_would_do(bag: Path) -> None:
    with pytest.raises(InputError, match=r"no sensor_msgs/msg/Imu on /odom .* the bag has /imu"):
        read_sensors(bag, SensorTopics(imu="/odom"))


def test_degrees_become_metres_east_north_and_up() -> None:
    """A degree is 111.3 km of the equator, 110.6 of its meridian; in the south east stays east."""
    at = east_north_up(np.array([[0, 30, 0], [0, 30.001, 0], [0.001, 30, 0], [0, 30, 5]]))
    np.testing.assert_allclose(at[1:], [[111.32, 0, 0], [0, 110.57, 0], [0, 0, 5]], atol=0.01)
    south = east_north_up(np.array([[-60, 170, 0], [-60, 170.001, 0], [-60.001, 170, 0]]))
    np.testing.assert_allclose(south[1:], [[55.80, 0, 0], [0, -111.41, 0]], atol=0.01)
