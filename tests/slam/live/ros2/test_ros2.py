"""ROS 2 over DDS: bytes as rosbags', and a second process that plays frames and hears poses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from ros2_player import BEGIN_S, pose

from bmask_slam.cli import main
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import (
    inverse,
    make_pose,
    rotation_from_quaternion,
    se3_exp,
    se3_log,
)
from bmask_slam.live.ros2.dds import carried_type, dds_name, idl_struct, ros_name, typestore
from bmask_slam.live.ros2.outputs import OPTICAL, Ros2Frames, ros_covariance
from bmask_slam.live.sources.opening import SourceOptions, open_source

TYPES = (
    "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/Imu", "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path", "nav_msgs/msg/OccupancyGrid", "tf2_msgs/msg/TFMessage",
    "geometry_msgs/msg/PoseWithCovarianceStamped", "visualization_msgs/msg/MarkerArray",
    "diagnostic_msgs/msg/DiagnosticArray",
)  # fmt: skip
LOOPBACK = """<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo"
multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>
<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
DOMAIN, FRAMES = 77, 10


def example(name: str, rng: np.random.Generator, as_idl: bool) -> Any:
    """A message with random values: of rosbags, or of the struct that cyclonedds knows."""
    store = typestore()
    values = {f: _value(kind, rng, as_idl) for f, kind in store.fielddefs[name][1]}
    return (idl_struct(name) if as_idl else store.types[name])(**values)


def _value(kind: Any, rng: np.random.Generator, as_idl: bool) -> Any:
    node, described = kind[0].name, kind[1]
    if node == "NAME":
        return example(described, rng, as_idl)
    if node == "BASE":
        base = described[0]
        if base == "string":
            return "abcdefgh"[: int(rng.integers(0, 8))]
        if base == "bool":
            return bool(rng.integers(0, 2))
        return float(np.float32(rng.normal())) if "float" in base else int(rng.integers(0, 100))
    count = described[1] if node == "ARRAY" else int(rng.integers(1, 4))
    values = [_value(described[0], rng, as_idl) for _ in range(count)]
    if as_idl or described[0][0].name == "NAME" or described[0][1][0] == "string":
        return values
    return np.array(values, described[0][1][0])


@pytest.mark.parametrize("name", TYPES)
def test_bytes_are_those_of_rosbags(name: str) -> None:
    for seed in range(3):
        ours = example(name, np.random.default_rng(seed), True)
        theirs = example(name, np.random.default_rng(seed), False)
        expected = bytes(typestore().serialize_cdr(theirs, name))
        found = ours.serialize(use_version_2=False)
        assert found[4:] == expected[4:].ljust(len(found) - 4, b"\0")
        assert found[:2] == expected[:2] == b"\x00\x01"  # CDR, little endian
        back = carried_type(name).deserialize(found)
        assert type(typestore().deserialize_cdr(back.cdr, name)) is type(theirs)


def test_names_of_types() -> None:
    assert dds_name("sensor_msgs/msg/Image") == "sensor_msgs::msg::dds_::Image_"
    assert ros_name("sensor_msgs::msg::dds_::Image_") == "sensor_msgs/msg/Image"
    assert ros_name("other::Type") == ""
    assert carried_type("sensor_msgs/msg/Image").__idl__.idl_transformed_typename == (
        "sensor_msgs::msg::dds_::Image_"
    )


def test_the_covariance_is_that_of_the_bases_pose() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    covariance = A @ A.T * 1e-6
    T_base_camera, T_map_base = (se3_exp(rng.normal(size=6)) for _ in range(2))
    found = ros_covariance(covariance, T_base_camera, T_map_base)
    J = np.zeros((6, 6))
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = 1e-6
        moved = T_map_base @ T_base_camera @ se3_exp(xi) @ inverse(T_base_camera)
        turn = moved[:3, :3] @ T_map_base[:3, :3].T  # about the map's axes
        J[:3, axis] = (moved - T_map_base)[:3, 3] / 1e-6
        J[3:, axis] = se3_log(make_pose(turn, np.zeros(3)))[:3] / 1e-6
    assert np.allclose(found, J @ covariance @ J.T, rtol=1e-4, atol=1e-12)


def test_frames_are_checked() -> None:
    with pytest.raises(InputError, match="16 numbers"):
        Ros2Frames(base_camera=(1.0,) * 16)
    level = OPTICAL[:3, :3] @ np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]).T
    assert np.allclose(level, [[1, 0, 0], [0, -1, 0], [0, 0, -1]])  # forward, right, down


@pytest.mark.parametrize("text", ["ros2:x", "ros2:500"])
def test_other_domains_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="domain"):
        open_source(text, SourceOptions(silence_s=0.1))


def test_a_second_process_plays_frames_and_hears_poses(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    helpers = Path(__file__).parents[3] / "helpers"
    path = os.pathsep.join([str(helpers), *filter(None, sys.path)])
    words = [sys.executable, helpers / "ros2_player.py", DOMAIN, 10, tmp_path / "heard"]
    with subprocess.Popen(list(map(str, words)), env={**os.environ, "PYTHONPATH": path}) as player:
        out = tmp_path / "run"
        options = ("--segmenter", "none", "--calibrate", "off", "--quiet", "--silence", "30")
        code = main(["live", f"ros2:{DOMAIN}", "--out", str(out), "--max-frames", str(FRAMES - 2),
                     *options])  # fmt: skip
        if code:
            player.kill()
        assert code == 0
        assert player.wait(60) == 0
    heard = json.loads((tmp_path / "heard").read_text())
    odometry = heard["/bmask_slam/odometry"]
    assert len(odometry) >= FRAMES - 4  # of best effort
    assert {(o["frame"], o["child"]) for o in odometry} == {("odom", "base_link")}
    for one in odometry:
        k = round(30 * (one["stamp_s"] - BEGIN_S))
        R = rotation_from_quaternion(np.array(one["quaternion"]))
        found = make_pose(R, np.array(one["position"]))
        expected = OPTICAL @ inverse(pose(0)) @ pose(k) @ inverse(OPTICAL)
        assert np.allclose(found, expected, atol=0.003)
    links = {tuple(link) for tf in heard["/tf"] + heard["/tf_static"] for link in tf["links"]}
    assert links == {
        ("map", "odom"), ("odom", "base_link"), ("base_link", "camera_optical_frame")
    }  # fmt: skip
    assert heard["/bmask_slam/landmarks"][-1]["points"] > 50
    assert heard["/bmask_slam/landmarks"][-1]["fields"] == ["x", "y", "z", "rgb"]
    assert heard["/bmask_slam/path"][-1]["poses"] >= 1
    assert heard["/diagnostics"][-1]["status"] == "OK"
    assert len(heard["/bmask_slam/pose"]) == len(odometry)
