"""Sensors by ROS 2: columns, stamps that are refused, mountings by tf, and the wheels' frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from ros2_player import wheels

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.sensors.streams import Measurements, SensorStreams
from bmask_slam.live.ros2.messages import header, message
from bmask_slam.live.ros2.outputs import OPTICAL, Robot, Ros2Frames, Ros2Outputs
from bmask_slam.live.ros2.sensors import FAR_S, ImageClock, Ros2Sensors, mounted
from bmask_slam.live.ros2.transport import typestore
from bmask_slam.sequences.bags.sensors import SensorTopics
from bmask_slam.tracking.results import FrameResult, TrackingStatus, Velocity

CLOCK = ImageClock(1000.0, 0.0)


class StandIn:
    """A node, and its readers and writers: what is put into ``topics`` is received."""

    def __init__(self, **kinds: str) -> None:
        self.kinds, self.broken = {f"/{name}": kind for name, kind in kinds.items()}, 0
        self.topics: dict[str, list[Any]] = {}

    def published(self) -> dict[str, str]:
        return self.kinds

    def reader(self, topic: str, *_: Any) -> Any:
        queue, node = self.topics.setdefault(topic, []), self

        class Reader:
            broken = node.broken

            def take(self, _: int = 0) -> list[Any]:
                taken = list(queue)
                queue.clear()
                return taken

        return Reader()

    def writer(self, topic: str, *_: Any) -> Any:
        queue = self.topics.setdefault(topic, [])

        class Writer:
            send = staticmethod(queue.append)

        return Writer()


def imu(stamp_s: float, force: float = 9.8) -> Any:
    types = typestore().types
    nine = np.zeros(9)
    level, rate = message("Quaternion", 0.0, 0.0, 0.0, 1.0), message("Vector3", 0.1, 0.2, 0.3)
    up = message("Vector3", 0.0, 0.0, force)
    kind = types["sensor_msgs/msg/Imu"]
    return kind(header(stamp_s, "imu_link"), level, nine, rate, nine, up, nine)


def test_measurements_on_the_images_clock() -> None:
    node = StandIn(imu="sensor_msgs/msg/Imu")
    sensors = Ros2Sensors(node, SensorTopics(imu="/imu"), 0.0)
    node.topics["/imu"] += [imu(999.0)]
    assert sensors.frames() == {"imu": "imu_link"}
    node.topics["/imu"] += [imu(999.5), imu(999.5), imu(999.2), imu(1000.0 + 2 * FAR_S)]
    node.topics["/imu"] += [imu(999.6, np.nan), imu(999.7)]
    (found,) = sensors.take(CLOCK)
    assert found.sensor == "imu"
    assert np.allclose(found.rows[:, 0], [999.0, 999.5, 999.7])
    assert np.allclose(found.rows[0, 1:], [0.1, 0.2, 0.3, 0, 0, 9.8])
    assert (sensors.late, sensors.broken) == (3, 1)
    node.topics["/imu"].append(imu(3.0))
    (found,) = sensors.take(ImageClock(1001.0, 998.0))  # the clock was set back, also the images'
    assert found.rows[0, 0] == 1001.0


def test_a_topic_of_another_type_is_refused() -> None:
    with pytest.raises(InputError, match="there is /imu"):
        Ros2Sensors(StandIn(imu="sensor_msgs/msg/Imu"), SensorTopics(imu="/other"), 0.0)


def test_satellites_become_metres_from_the_first() -> None:
    node = StandIn(fix="sensor_msgs/msg/NavSatFix")
    types = typestore().types
    fixed, no = (types["sensor_msgs/msg/NavSatStatus"](status, 1) for status in (0, -1))
    sensors = Ros2Sensors(node, SensorTopics(position="/fix"), 0.0)
    rows = []
    for k, status in enumerate((fixed, no, fixed)):
        kind = types["sensor_msgs/msg/NavSatFix"]
        at = (48.0 + k * 1e-5, 11.0, 500.0)
        variances = np.diag([4.0] * 3).ravel()
        node.topics["/fix"].append(kind(header(999.0 + k, "gps"), status, *at, variances, 2))
        rows += [row for found in sensors.take(CLOCK) for row in found.rows]
    assert np.allclose(rows[0][1:], [0, 0, 0, 2])
    assert np.allclose(rows[1], [1001.0, 0, 2.224, 0, 2], atol=1e-3)
    assert sensors.broken == 1


def test_mountings_by_tf_unless_they_are_given() -> None:
    T_camera_imu, T_camera_base = se3_exp(np.arange(6.0) / 9), se3_exp(-np.arange(6.0) / 7)
    known = {"imu_link": T_camera_imu, "base_link": T_camera_base}
    frames = {"imu": "imu_link", "odometry": "base_link", "position": "gps"}
    found = mounted(SensorsConfig(), frames, known.get)
    assert np.allclose(T_of(found.imu.imu_in_camera), T_camera_imu)
    assert np.allclose(T_of(found.odometry.camera_in_base), inverse(T_camera_base))
    assert found.position == SensorsConfig().position
    own = SensorsConfig()
    own = replace(own, imu=replace(own.imu, imu_in_camera=(1.0, 0, 0, 0, 0, 0, 1)))
    assert mounted(own, frames, known.get).imu == own.imu


def test_the_wheels_frame_in_the_map() -> None:
    """T_map_base = T_map_odom @ T_odom_base, also while tracking is lost."""
    node = StandIn(odom="nav_msgs/msg/Odometry")
    sensors = Ros2Sensors(node, SensorTopics(odometry="/odom"), 0.0)
    node.topics["/odom"] += [wheels(0), wheels(3)]
    sensors.take(CLOCK)
    T_odom_base = sensors.T_odom_base(1000.02)
    assert T_odom_base is not None
    assert sensors.T_odom_base(999.9) is None
    assert sensors.T_odom_base(1000.3) is None
    robot = Robot(OPTICAL, T_odom_base=sensors.T_odom_base)
    outputs = Ros2Outputs(node, Ros2Frames(), robot)
    (static,) = node.topics["/tf_static"]
    assert [t.child_frame_id for t in static.transforms] == ["camera_optical_frame"]
    T_world_camera = se3_exp(np.array([0, 0.1, 0, 0.5, 0, 0.2]))
    found = FrameResult(0, 1000.02, TrackingStatus.OK, T_world_camera)
    outputs.frame(found)
    outputs.frame(FrameResult(1, 1000.05, TrackingStatus.LOST, None))
    moved = [tf.transforms[0] for tf in node.topics["/tf"]]
    assert [(t.header.frame_id, t.child_frame_id) for t in moved] == [("map", "odom")] * 2
    assert moved[1].header.stamp.nanosec == 150_000_000  # 0.1 s ahead
    t = moved[1].transform.translation
    T_map_base = OPTICAL @ T_world_camera @ inverse(OPTICAL)
    assert np.allclose([t.x, t.y, t.z], (T_map_base @ inverse(T_odom_base))[:3, 3])
    assert len(node.topics["/bmask_slam/odometry"]) == 1


def test_without_wheels_the_base_moves_in_odom() -> None:
    node = StandIn()
    outputs = Ros2Outputs(node, Ros2Frames(), Robot(make_pose(np.eye(3), np.zeros(3))))
    outputs.frame(FrameResult(0, 1.0, TrackingStatus.OK, se3_exp(np.ones(6))))
    links = [
        (t.header.frame_id, t.child_frame_id)
        for topic in ("/tf_static", "/tf")
        for one in node.topics[topic]
        for t in one.transforms
    ]
    assert links == [("map", "odom"), ("base_link", "camera_optical_frame"), ("odom", "base_link")]


def test_the_bases_velocity_is_in_its_own_frame() -> None:
    """The camera 0.5 m before the axis of a base that turns and drives: v = v_base + w x r."""
    node = StandIn()
    T_base_camera = make_pose(OPTICAL[:3, :3], np.array([0.5, 0.0, 0.3]))
    outputs = Ros2Outputs(node, Ros2Frames(), Robot(T_base_camera))
    turn, drive = np.array([0.0, 0.0, 0.4]), np.array([1.0, 0.0, 0.0])
    at_camera = drive + np.cross(turn, T_base_camera[:3, 3])
    R = T_base_camera[:3, :3].T
    twist = np.r_[R @ turn, R @ at_camera]
    found = FrameResult(0, 1.0, TrackingStatus.OK, se3_exp(np.ones(6)))
    outputs.frame(found)
    outputs.frame(replace(found, timestamp_s=2.0, velocity=Velocity(twist, 0.01 * np.eye(6))))
    unknown, known = (one.twist for one in node.topics["/bmask_slam/odometry"])
    assert (unknown.covariance == -1).all()
    linear, angular = known.twist.linear, known.twist.angular
    assert np.allclose([linear.x, linear.y, linear.z], drive)
    assert np.allclose([angular.x, angular.y, angular.z], turn)
    covariance = known.covariance.reshape(6, 6)
    assert np.allclose(covariance[3:, 3:], 0.01 * np.eye(3))
    assert covariance[1, 1] == pytest.approx(0.01 * (1 + 0.5**2 + 0.3**2))


def test_streams_grow_without_being_sorted_anew() -> None:
    streams, kept = SensorStreams(), []
    for k in range(50):
        rows = np.full((3, 7), float(k))
        rows[:, 0] = 3 * k + np.arange(3)
        streams.add(Measurements("imu", rows))
        kept.append((streams.of("imu"), streams.of("imu").copy()))
    assert np.array_equal(streams.of("imu")[:, 0], np.arange(150))
    assert all(np.array_equal(view, copy) for view, copy in kept)
    streams.add(Measurements("imu", np.array([[1.5, *[0.0] * 6]])))
    streams.add(Measurements("imu", np.array([[200.0, *[0.0] * 6]])))
    assert streams.of("imu")[[2, -1], 0].tolist() == [1.5, 200.0]
