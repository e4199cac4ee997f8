"""All outputs over DDS: what a publisher sends of a run is what a second process hears."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from ros2_messages import HEARD
from ros2_processes import LOOPBACK, begin_process
from test_ros2_maps import T_MAP_WORLD, Run, room

from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.live.ros2.dds import DdsNode
from bmask_slam.live.ros2.outputs import Robot, Ros2Frames
from bmask_slam.live.ros2.publisher import Ros2Publisher
from bmask_slam.mapping.products.occupancy import FREE, OCCUPIED
from bmask_slam.tracking.results import FrameResult, TrackingStatus

DOMAIN, LONGEST_S = 80, 120.0
COVARIANCE = np.diag(np.arange(1.0, 7.0)) * 1e-6
T_WORLD_CAMERA = se3_exp(np.array([0, 0, 0.3, 0, 0, 0.5]))


@pytest.fixture(scope="module")
def heard(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict]]:
    """What a second process hears of a run with a dense map and objects."""
    out = tmp_path_factory.mktemp("heard") / "heard"
    points, information = room(2.02), np.linalg.inv(COVARIANCE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CYCLONEDDS_URI", LOOPBACK)
        publish = Ros2Publisher(DdsNode(DOMAIN), Ros2Frames(), Robot(T_MAP_WORLD, True))
        run, k, end_s = Run(), 0, time.monotonic() + LONGEST_S
        with begin_process("ros2_listener", DOMAIN, out) as listener:
            while listener.poll() is None and time.monotonic() < end_s:
                where = TrackingStatus.OK, T_WORLD_CAMERA
                publish(FrameResult(k, 5 + k / 10, *where, information=information), run)
                if k == 0:
                    run.listeners[0](4, points, np.full((len(points), 3), (9, 8, 7), np.uint8))
                k += 1
                time.sleep(0.05)
            listener.communicate(timeout=60)
        assert listener.returncode == 0
    return json.loads(out.read_text())


def test_all_topics_are_heard(heard) -> None:
    assert {topic for topic, messages in heard.items() if messages} == set(HEARD)


def test_poses_have_their_covariance(heard) -> None:
    T_map_base = T_MAP_WORLD @ T_WORLD_CAMERA @ inverse(T_MAP_WORLD)
    R = (T_MAP_WORLD @ T_WORLD_CAMERA)[:3, :3]  # a turn about the camera moves the base
    lever = np.cross(np.eye(3), inverse(T_MAP_WORLD)[:3, 3]).T
    J = np.block([[R @ lever, R], [R, np.zeros((3, 3))]])
    expected = J @ COVARIANCE @ J.T
    for topic in ("odometry", "pose"):
        one = heard[f"/bmask_slam/{topic}"][-1]
        assert one["position"] == pytest.approx(T_map_base[:3, 3].tolist(), abs=1e-9)
        assert np.allclose(one["covariance"], expected.ravel(), rtol=1e-6, atol=1e-15)


def test_the_grid_is_heard_with_wall_and_floor(heard) -> None:
    grid = heard["/bmask_slam/map"][-1]
    cells = np.array(grid["cells"]).reshape(grid["size"])
    assert grid["resolution"] == pytest.approx(0.05)
    row, free, wall = (
        int(np.floor((at - origin) / 0.05))
        for at, origin in ((0.2, grid["origin"][1]), *((x, grid["origin"][0]) for x in (1, 2.03)))
    )
    assert (cells[row, free], cells[row, wall]) == (FREE, OCCUPIED)
    assert cells.size > 20 * 20


def test_the_cloud_is_heard_with_its_colours(heard) -> None:
    cloud = heard["/bmask_slam/cloud"][-1]
    points_map = transform(T_MAP_WORLD, room(2.02).astype(float))
    nearest_m = np.linalg.norm(points_map - cloud["first"]["xyz"], axis=1).min()
    assert nearest_m < 1e-5
    assert cloud["first"]["bgr"] == [7, 8, 9]
    cells = np.unique(np.floor(points_map / 0.03), axis=0)
    assert cloud["points"] == len(cells)


def test_objects_are_heard_as_detections_and_markers(heard) -> None:
    (one,) = heard["/bmask_slam/objects"][-1]["objects"]
    assert one["id"] == "7"
    assert one["scores"] == {"chair": 0.69, "cup": 0.205, "background": 0.1}
    assert one["size"] == [0.5, 0.6, 0.8]
    markers = heard["/bmask_slam/object_markers"][-1]["markers"]
    assert markers == [["", 0, 3, ""], ["objects", 7, 0, ""], ["labels", 7, 0, "chair 0.69"]]
