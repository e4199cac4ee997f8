"""The examples run unchanged."""

from __future__ import annotations

import runpy
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
from recorded_bags import image
from repository import ROOT
from scipy.spatial.transform import Rotation
from synthetic_view import CAMERA, render_plane

from bmask_slam.graph.geometry import inverse, se3_exp


def test_live(office, tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "live.py"), str(office)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 16
    assert not any("LOST" in line for line in lines[:15])
    assert (tmp_path / "runs" / "live" / "trajectory.txt").is_file()


def message(stamp: tuple[int, int], body: SimpleNamespace) -> SimpleNamespace:
    """A ROS message of this time, seconds and nanoseconds."""
    body.header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp[0], nanosec=stamp[1]))
    return body


def new_pose() -> SimpleNamespace:
    """An empty PoseStamped."""
    pose = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
    return SimpleNamespace(header=SimpleNamespace(), pose=pose)


def test_ros2_node(tmp_path, monkeypatch) -> None:
    """Images of a plane are sent as messages; the published poses are the camera's."""
    monkeypatch.chdir(tmp_path)
    published: list[Any] = []
    bridge = runpy.run_path(str(ROOT / "examples" / "ros2_node.py"))["Bridge"](
        new_pose, published.append
    )
    K, size = CAMERA.K.ravel(), {"width": CAMERA.width, "height": CAMERA.height}
    info = SimpleNamespace(**size, k=K, d=[], p=[], distortion_model="plumb_bob")
    truth = [se3_exp(np.array([0, 0.02 * k, 0.01 * k, 0.03 * k, 0, 0])) for k in range(4)]
    try:
        for k, T_world_camera in enumerate(truth):
            frame = render_plane(T_world_camera, k)
            millimetres = np.rint(1000 * frame.depth_m).astype(np.uint16)
            stamp = (1700000000 + k, 500)
            rgb = message(stamp, image("bgr8", frame.rgb[..., ::-1]))
            if k == 2:
                rgb.encoding = "unheard of"
            bridge.track(rgb, message(stamp, image("16UC1", millimetres)), info)
    finally:
        bridge.slam.close()
    assert [pose.header.stamp.sec - 1700000000 for pose in published] == [0, 1, 3]
    for k, found in zip((0, 1, 3), published, strict=True):
        expected = inverse(truth[0]) @ truth[k]
        position, turn = found.pose.position, found.pose.orientation
        assert np.allclose([position.x, position.y, position.z], expected[:3, 3], atol=0.003)
        R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        assert np.allclose(R, expected[:3, :3], atol=0.002)
    assert (tmp_path / "runs" / "ros2" / "trajectory.txt").is_file()
