"""The package for rclpy: its files fit together, and it runs with a stand-in for rclpy."""

from __future__ import annotations

import importlib
import re
import sys
import threading
import time
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

pytest.importorskip("rosbags")

from fake_rclpy import FakeNode, install
from repository import ROOT
from ros2_player import COLOUR, DEPTH, INFO, T_BASE_CAMERA, image, info, place, pose
from synthetic_view import render_plane

from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.graph.geometry import inverse
from bmask_slam.live.ros2.messages import type_name
from bmask_slam.live.ros2.outputs import OPTICAL, Robot, Ros2Frames, Ros2Outputs
from bmask_slam.live.ros2.transport import decoded, encoded

PACKAGE = ROOT / "examples" / "ros2" / "bmask_slam_ros"
TYPES = {COLOUR: "sensor_msgs/msg/Image", DEPTH: "sensor_msgs/msg/Image",
         INFO: "sensor_msgs/msg/CameraInfo"}  # fmt: skip


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a module of the package anew, with a node in place of rclpy's."""

    def load(name: str, node: FakeNode, without: str = "") -> ModuleType:
        install(monkeypatch, node, without)
        for known in [m for m in sys.modules if m.startswith("bmask_slam_ros")]:
            monkeypatch.delitem(sys.modules, known)
        return importlib.import_module(f"bmask_slam_ros.{name}")

    monkeypatch.syspath_prepend(str(PACKAGE))
    return load


def published(modules: Any) -> dict[str, str]:
    """Types by the topics that are published."""
    node = FakeNode({})
    transport = modules("transport", node)
    Ros2Outputs(transport.RclpyNode(node), Ros2Frames(), Robot(OPTICAL))
    return node.topics


def test_the_files_of_the_package_fit_together(modules) -> None:
    xml = ElementTree.parse(PACKAGE / "package.xml").getroot()
    needed = {kind.partition("/")[0] for kind in published(modules).values()}
    depends = {one.text for one in xml.iter("exec_depend")}
    assert needed | {"rclpy", "std_srvs", "rosidl_runtime_py"} <= depends
    setup = (PACKAGE / "setup.py").read_text()
    assert f'NAME = "{xml.findtext("name")}"' in setup
    assert f'version="{xml.findtext("version")}"' in setup
    assert (PACKAGE / "resource" / "bmask_slam_ros").exists()
    for folder in re.findall(r'glob\("(\w+)/', setup):
        assert any((PACKAGE / folder).iterdir())
    compile((PACKAGE / "launch" / "bmask_slam.launch.py").read_text(), "launch", "exec")


def test_parameters_and_topics_are_known(modules) -> None:
    text = (PACKAGE / "config" / "params.yaml").read_text()
    params = read_yaml(PACKAGE / "config" / "params.yaml")["bmask_slam"]["ros__parameters"]
    defaults = {f.name: getattr(Ros2Frames(), f.name) for f in fields(Ros2Frames)}
    assert {k: v for k, v in params.items() if k != "options"}.items() <= defaults.items()
    assert "base_camera" in text
    rviz = (PACKAGE / "rviz" / "bmask_slam.rviz").read_text()
    shown = re.findall(r"Value: (/\S+)", rviz)
    assert len(shown) >= 5
    assert set(shown) <= published(modules).keys()


def test_what_the_parameters_need_is_said_to_be_installed() -> None:
    """Of package.xml and docs/live.md: the dense map, masks, and messages without cyclonedds."""
    options = read_yaml(PACKAGE / "config" / "params.yaml")["bmask_slam"]["ros__parameters"][
        "options"
    ]
    assert "--map" in options
    docs = (ROOT / "docs" / "live.md").read_text()
    texts = (PACKAGE / "package.xml").read_text(), docs[docs.index("### With ROS") :]
    for text in texts:
        extras = re.search(r"pip install 'bmask-slam\[([\w,]+)\]'", text)
        assert extras is not None
        assert extras[1].split(",") == ["semantics", "dense", "ros"]


def test_a_package_that_ros_lacks_costs_its_topics_only(modules) -> None:
    node = FakeNode({})
    transport = modules("transport", node, without="vision_msgs")
    Ros2Outputs(transport.RclpyNode(node), Ros2Frames(), Robot(OPTICAL))
    assert "/bmask_slam/objects" not in node.topics
    assert "/bmask_slam/odometry" in node.topics
    assert any("vision_msgs" in line for line in node.logged)


def test_a_dropped_reader_ends_its_subscription(modules) -> None:
    node = FakeNode({})
    ros = modules("transport", node).RclpyNode(node)
    node.announce(COLOUR, TYPES[COLOUR])
    reader = ros.reader(COLOUR, TYPES[COLOUR])
    node.hand_on(COLOUR, b"\0\1\0\0broken")
    assert not list(reader.take())
    assert reader.broken == 1
    del reader
    assert not node._listeners[COLOUR]


def play(node: FakeNode, ended: threading.Event, told: dict[str, Any]) -> None:
    """A camera, and somebody who calls the services once there are poses."""
    rendered = [render_plane(pose(k), k) for k in range(10)]
    k, called = 0, None
    while not ended.is_set():
        stamp_s, frame = 1000 + k / 30, rendered[place(k)]
        images = (image(stamp_s, "rgb8", frame.rgb), image(stamp_s, "32FC1", frame.depth_m))
        for topic, sent in zip((INFO, COLOUR, DEPTH), (info(stamp_s), *images), strict=True):
            node.hand_on(topic, encoded(sent, TYPES[topic]))
        tracked = bool(node.sent.get("/bmask_slam/odometry"))
        if tracked and called is None:

            def call() -> None:
                told["only"] = node.call("/bmask_slam/localise_only", data=True)
                told["saved"] = node.call("/bmask_slam/save_map")

            called = threading.Thread(target=call)
            called.start()
        k += tracked
        time.sleep(1 / 15)
    if called is not None:
        called.join(10)


def test_the_node_tracks_and_serves(modules, tmp_path: Path) -> None:
    options = ["--segmenter", "none", "--calibrate", "off", "--max-frames", "30"]
    out = tmp_path / "run"
    given = {
        "options": [*options, "--out", str(out)],
        "base_camera": tuple(T_BASE_CAMERA.ravel()),
        "prefix": "/bmask_slam",
        "use_sim_time": False,
    }
    node = FakeNode(given)
    for topic, kind in TYPES.items():
        node.announce(topic, kind)
    ended, told = threading.Event(), {}  # type: ignore[var-annotated]
    player = threading.Thread(target=play, args=(node, ended, told))
    player.start()
    try:
        assert modules("node", node).main() == 0
    finally:
        ended.set()
        player.join(20)
    assert told == {"only": (True, "frames are only located in the map"),
                    "saved": (True, str(out / "map"))}  # fmt: skip
    poses = [decoded(d, type_name("Odometry")) for d in node.sent["/bmask_slam/odometry"]]
    assert len(poses) >= 8
    last = poses[-1]
    k = round(30 * (last.header.stamp.sec + 1e-9 * last.header.stamp.nanosec - 1000))
    expected = T_BASE_CAMERA @ inverse(pose(0)) @ pose(k) @ inverse(T_BASE_CAMERA)
    where = last.pose.pose.position
    assert np.allclose([where.x, where.y, where.z], expected[:3, 3], atol=0.003)
    assert (out / "trajectory.txt").exists()


def test_what_is_wrong_is_one_line(modules) -> None:
    node = FakeNode({"options": ["--max-frames", "1", "--silence", "0.1"]})
    assert modules("node", node).main() == 1
    assert len(node.logged) == 1
