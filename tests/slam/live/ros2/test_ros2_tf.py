"""tf of a robot: odometry by /tf, and where the camera is, which must stay there."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from ros2_player import COLOUR, DEPTH, INFO, T_BASE_CAMERA, image, info
from synthetic_view import CAMERA
from test_ros2_sensors import CLOCK, StandIn

from bmask_slam.cli import make_parser
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, quaternion_from_rotation, se3_exp
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.live.play import ros2_ends
from bmask_slam.live.ros2.messages import message, transform, type_name
from bmask_slam.live.ros2.outputs import Ros2Frames
from bmask_slam.live.sources.ros2_source import Ros2Options, Ros2Source
from bmask_slam.sequences.bags.sensors import SensorTopics
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult, TrackingStatus

BASE_CAMERA = ("base_link", "camera")
T_FOOT_BASE = make_pose(np.eye(3), np.array([0.0, 0.0, 0.2]))


def tf(stamp_s: float, frames: tuple[str, str], T: np.ndarray) -> Any:
    """A tf2_msgs/TFMessage of one transform."""
    return message("TFMessage", [transform(stamp_s, frames, T)])


def moved(k: int) -> np.ndarray:
    """T_odom_foot at 1000 s and k tenths."""
    return se3_exp(np.array([0, 0, 0.1 * k, 0.2 * k, 0.1, 0]))


def show(node: Any, stamp_s: float) -> None:
    """Publish a frame."""
    size = CAMERA.height, CAMERA.width
    colour, depth = np.zeros((*size, 3), np.uint8), np.ones(size, np.float32)
    node.topics.setdefault(COLOUR, []).append(image(stamp_s, "rgb8", colour))
    node.topics.setdefault(DEPTH, []).append(image(stamp_s, "32FC1", depth))


def robot(still: list[Any], moving: list[Any], odometry_topic: str = "") -> tuple[Any, Ros2Source]:
    """A node on which somebody publishes images, /tf_static and /tf; and a source on it."""
    kinds = {
        COLOUR: "sensor_msgs/msg/Image", DEPTH: "sensor_msgs/msg/Image",
        INFO: "sensor_msgs/msg/CameraInfo", "/tf": type_name("TFMessage"),
        "/tf_static": type_name("TFMessage"), "/odom": type_name("Odometry"),
    }  # fmt: skip
    node = StandIn(**{name[1:]: kind for name, kind in kinds.items()})
    node.service = lambda *_: None  # type: ignore[attr-defined]
    node.topics |= {INFO: [info(1000.0)], "/tf_static": still, "/tf": moving}
    show(node, 1000.0)
    options = Ros2Options(sensors=SensorTopics(odometry=odometry_topic), silence_s=0.1)
    return node, Ros2Source(node, "ros2:0", options)


def test_odometry_by_tf_through_a_frame_between() -> None:
    """odom -> base_footprint moves, base_footprint -> base_link -> camera are still."""
    still = [tf(0, ("base_footprint", "base_link"), T_FOOT_BASE), tf(0, BASE_CAMERA, T_BASE_CAMERA)]
    moving = [tf(1000 + k / 10, ("odom", "base_footprint"), moved(k)) for k in (0, 1, 1, 2)]
    nonsense = tf(1000.15, ("odom", "base_footprint"), np.full((4, 4), np.nan))
    moving[2:2] = [nonsense, tf(1000.1, ("base_link", "wheel"), moved(3))]
    node, source = robot(still, moving)
    config, publish, _ = ros2_ends(source, None, SystemConfig())
    assert np.allclose(T_of(config.sensors.odometry.camera_in_base), T_BASE_CAMERA)
    assert not [t for one in node.topics["/tf_static"] for t in one.transforms]
    (found,) = source.sensors.take(CLOCK)
    assert found.sensor == "odometry"
    assert found.rows[:, 0].tolist() == [1000.0, 1000.1, 1000.2]
    assert (source.sensors.late, source.sensors.broken) == (0, 1)
    for k, row in enumerate(found.rows):
        T = moved(k) @ T_FOOT_BASE
        assert np.allclose(row[1:4], T[:3, 3])
        assert np.allclose(np.abs(row[4:] @ quaternion_from_rotation(T[:3, :3])), 1)
    frame = FrameResult(0, 1000.1, TrackingStatus.OK, np.eye(4))
    publish._outputs.frame(frame)
    (sent,) = node.topics["/tf"][-1].transforms  # map -> odom, of the base where it was then
    assert (sent.header.frame_id, sent.child_frame_id) == ("map", "odom")
    t = sent.transform.translation
    assert np.allclose([t.x, t.y, t.z], inverse(moved(1) @ T_FOOT_BASE)[:3, 3])


def links(node: StandIn) -> set[tuple[str, str]]:
    """Of transforms that were published, or wait to be read."""
    sent = [
        t for name in ("/tf", "/tf_static") for one in node.topics[name] for t in one.transforms
    ]
    return {(t.header.frame_id, t.child_frame_id) for t in sent}


@pytest.mark.parametrize("case", ["not enabled", "no place"])
def test_odometry_that_cannot_be_used_is_not_published_either(case: str, caplog) -> None:
    still = [] if case == "no place" else [tf(0, BASE_CAMERA, T_BASE_CAMERA)]
    node, source = robot(still, [tf(1000 + k, ("odom", "base_link"), moved(k)) for k in (0, 1)])
    config, own = SystemConfig(), SensorsConfig().odometry
    if case == "not enabled":
        sensors = SensorsConfig(odometry=replace(own, enabled=False))
        config = replace(config, sensors=sensors)
    config, publish, _ = ros2_ends(source, None, config)
    assert config.sensors.odometry.camera_in_base == own.camera_in_base
    show(node, 1000.2)
    with caplog.at_level(logging.INFO):
        next(source.frames())
    assert caplog.text.count("/tf has odom -> base_link, which is not published, and not used") == 1
    assert source.sensors.names == ()
    assert source.sensors.take(CLOCK) == []
    publish._outputs.frame(FrameResult(0, 1000.5, TrackingStatus.OK, np.eye(4)))
    assert ("map", "odom") in links(node)
    assert ("odom", "base_link") not in links(node)


def test_a_place_that_is_given_counts_more() -> None:
    given = se3_exp(np.array([0.1, 0.2, 0.3, 1, 2, 3]))
    frames = Ros2Frames(base_camera=tuple(given.ravel()))
    still = [tf(0, BASE_CAMERA, T_BASE_CAMERA)]
    _, source = robot(still, [tf(1000, ("odom", "base_link"), moved(0))])
    found = source.mounted(SensorsConfig(), frames)
    assert np.allclose(T_of(found.odometry.camera_in_base), given)


def test_a_topic_of_odometry_counts_more_than_tf() -> None:
    moving = [tf(1000, ("odom", "base_link"), moved(0))]
    _, source = robot([tf(0, BASE_CAMERA, T_BASE_CAMERA)], moving, odometry_topic="/odom")
    source.mounted(SensorsConfig(), Ros2Frames())
    source._robot.hear()
    assert source.sensors.names == ("odometry",)
    assert source.sensors.take(CLOCK) == []  # /odom is silent


def test_without_a_base_on_tf_it_is_published() -> None:
    still, moving = [tf(0, BASE_CAMERA, T_BASE_CAMERA)], [tf(1000, ("base_link", "arm"), moved(0))]
    node, source = robot(still, moving)
    _, publish, _ = ros2_ends(source, None, SystemConfig())
    publish._outputs.frame(FrameResult(0, 1000.5, TrackingStatus.OK, np.eye(4)))
    assert links(node) >= {("map", "odom"), ("odom", "base_link")}
    assert not source.sensors.has_odometry


def test_a_mounting_by_tf_must_be_still() -> None:
    """base_link -> mast of /tf, mast -> camera of /tf_static; the mast's encoder is noisy."""
    T_mast_camera, mast = se3_exp(np.array([0.3, 0, 0, 0, 0, 1])), ("base_link", "mast")
    up = T_BASE_CAMERA @ inverse(T_mast_camera)
    node, source = robot([tf(0, ("mast", "camera"), T_mast_camera)], [tf(1000, mast, up)])
    assert np.allclose(source.T_base_camera("base_link"), T_BASE_CAMERA)
    node.topics["/tf"].append(tf(1001, mast, up @ se3_exp(np.full(6, 0.001))))
    source._robot.hear()
    node.topics["/tf"].append(tf(1002, mast, up @ se3_exp(np.array([0, 0, 0.1, 0, 0, 0]))))
    show(node, 1000.2)
    with pytest.raises(InputError, match=r"'camera' has moved against 'base_link', by .* 5\.7 deg"):
        next(source.frames())


def test_parameters_that_are_unknown_are_refused_by_the_command(tmp_path: Path) -> None:
    node, _ = robot([tf(0, BASE_CAMERA, T_BASE_CAMERA)], [])
    node.topics[INFO].append(info(1000.0))
    show(node, 1000.0)
    params = tmp_path / "params.yaml"
    params.write_text("bse: base_link")
    words = ["live", "ros2:", "--ros2-params", str(params), "--out", str(tmp_path / "run")]
    arguments = make_parser().parse_args([*words, "--silence", "0.1"])
    arguments.ros2_node = node
    with pytest.raises(InputError, match=r"params.yaml.*bse"):
        arguments.handler(arguments)
