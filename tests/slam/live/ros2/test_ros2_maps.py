"""The grid of a live dense map, objects as markers and detections, and when they are published."""

from __future__ import annotations

from concurrent.futures import wait
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from test_ros2_sensors import StandIn

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import (
    inverse,
    make_pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
    se3_exp,
    transform,
)
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.results import LandmarkCloud, MapObjects
from bmask_slam.live.health import Health
from bmask_slam.live.ros2 import messages, publisher
from bmask_slam.live.ros2.grid import GridOptions, LiveGrid
from bmask_slam.live.ros2.messages import occupancy_grid
from bmask_slam.live.ros2.objects import detection_array, marker_array
from bmask_slam.live.ros2.outputs import OPTICAL, Robot, Ros2Frames, Ros2Outputs
from bmask_slam.live.ros2.publisher import Ros2Publisher
from bmask_slam.live.ros2.transport import typestore
from bmask_slam.mapping.products.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.semantics.objects.publication import MapObject
from bmask_slam.tracking.results import FrameResult, TrackingStatus

T_MAP_WORLD = make_pose(OPTICAL[:3, :3], np.array([0.0, 0.0, 0.8]))


def room(wall_m: float, high_m: float = 1.2) -> np.ndarray:
    """Floor before a camera 0.8 m high that looks along x, and a wall across; in its frame."""
    x, y = np.meshgrid(np.arange(0.6, wall_m, 0.02), np.arange(-0.5, 0.5, 0.02))
    floor = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    y, z = np.meshgrid(np.arange(-0.5, 0.5, 0.02), np.arange(0, high_m, 0.02))
    wall = np.stack([0 * y + wall_m, y, z], -1).reshape(-1, 3)
    points_map = np.concatenate([floor, wall]) + np.array([0, 0, 0.001])
    return transform(inverse(T_MAP_WORLD), points_map).astype(np.float32)


def at(grid: OccupancyGrid, x: float, y: float) -> int:
    column, row = np.floor((np.array([x, y]) - grid.origin_m) / grid.resolution_m).astype(int)
    return int(grid.cells[row, column])


@pytest.mark.parametrize("floor_m", [0.0, None])
def test_floor_is_free_and_the_wall_occupied(floor_m: float | None) -> None:
    grid = LiveGrid(T_MAP_WORLD, GridOptions(floor_m=floor_m))
    assert grid.grid({}) is None
    grid.add(4, room(2.02))
    found, height_m = grid.grid({4: np.eye(4)})
    assert height_m == pytest.approx(0, abs=0.02)
    assert at(found, 1.0, 0.2) == FREE
    assert at(found, 2.03, 0.2) == OCCUPIED
    assert at(found, found.origin_m[0] + 0.01, found.origin_m[1] + 0.01) == UNKNOWN


def test_submaps_follow_their_keyframes() -> None:
    """A turn to the left by 90 degrees about the map's z, and 1 m ahead."""
    options = GridOptions(floor_m=0.0)
    grid, world = LiveGrid(T_MAP_WORLD, options), se3_exp(np.arange(6.0) / 5)
    grid.add(4, room(2.02))
    grid.grid({4: np.eye(4)})
    turned = se3_exp(np.array([0, 0, np.pi / 2, 1.0 * np.pi / 2, 0, 0]))
    T = inverse(T_MAP_WORLD) @ turned @ T_MAP_WORLD
    found, _ = grid.grid({4: T})
    x, y = turned[:2, :3] @ [2.03, 0.2, 0] + turned[:2, 3]
    assert at(found, x, y) == OCCUPIED
    other = LiveGrid(T_MAP_WORLD @ inverse(world), options)  # another world, the same map
    other.add(4, room(2.02))
    same, _ = other.grid({4: world @ T})
    assert np.mean(same.cells == found.cells) > 0.95
    assert grid.grid({}) is None  # the keyframe was culled


def test_what_has_gone_becomes_free() -> None:
    """A wall that one view saw at 1.5 m, and three others not."""
    grid = LiveGrid(T_MAP_WORLD, GridOptions(floor_m=0.0))
    for number, size_m in enumerate(((1.52, 1.2), *3 * [(2.52, 2.0)])):
        grid.add(number, room(*size_m))
    found, _ = grid.grid(dict.fromkeys(range(4), np.eye(4)))
    assert at(found, 1.53, 0.2) == FREE
    assert at(found, 2.53, 0.2) == OCCUPIED


def test_grid_message() -> None:
    cells = np.array([[0, 100, -1], [1, 2, 3]], np.int8)
    found = occupancy_grid(1.0, "map", OccupancyGrid(0.05, np.array([-1.0, 2.0]), cells), 0.1)
    assert (found.info.width, found.info.height, found.info.resolution) == (3, 2, 0.05)
    origin = found.info.origin.position
    assert (origin.x, origin.y, origin.z) == (-1.0, 2.0, 0.1)
    assert found.data.tolist() == [0, 100, -1, 1, 2, 3]
    name = "nav_msgs/msg/OccupancyGrid"
    back = typestore().deserialize_cdr(typestore().serialize_cdr(found, name), name)
    assert back.data.tolist() == found.data.tolist()


def some_objects() -> MapObjects:
    T_map_box = make_pose(np.eye(3), np.array([2.0, 1.0, 0.4]))
    box = OrientedBox(inverse(T_MAP_WORLD) @ T_map_box, np.array([0.5, 0.6, 0.8]))
    none = np.zeros(0, np.int64)
    one = MapObject(7, 2, np.array([0.1, 0.205, 0.69, 0.005]), np.zeros(3), box, none, none, 0, 1)
    return MapObjects(LabelSet(("background", "cup", "chair", "dog")), [one], np.array([0, -1, 0]))


def test_objects_with_the_probabilities_of_labels() -> None:
    found = detection_array(1.5, "map", some_objects(), T_MAP_WORLD)
    (one,) = found.detections
    scores = {r.hypothesis.class_id: r.hypothesis.score for r in one.results}
    assert scores == {"chair": 0.69, "cup": 0.205, "background": 0.1}
    assert one.results[0].hypothesis.class_id == "chair"
    centre, size = one.bbox.center.position, one.bbox.size
    assert np.allclose([centre.x, centre.y, centre.z], [2, 1, 0.4])
    assert (size.x, size.y, size.z, one.id) == (0.5, 0.6, 0.8, "7")
    name = "vision_msgs/msg/Detection3DArray"
    data = typestore().serialize_cdr(found, name)
    assert typestore().serialize_cdr(typestore().deserialize_cdr(data, name), name) == data


def test_objects_as_markers() -> None:
    clear, box, label = marker_array(1.5, "map", some_objects(), T_MAP_WORLD).markers
    assert clear.action == 3
    assert (box.type, box.ns, box.id, box.scale.z) == (1, "objects", 7, 0.8)
    assert np.allclose([box.pose.position.x, box.pose.position.z], [2, 0.4])
    assert (label.type, label.text, label.id) == (9, "chair 0.69", 7)
    assert label.pose.position.z == pytest.approx(0.4 + 0.4 + 0.1)


def test_the_poses_of_a_path_are_made_at_once(monkeypatch) -> None:
    """One by one the quaternions of 1000 poses take 30 ms, each second, beside tracking."""
    node, rng = StandIn(), np.random.default_rng(0)
    outputs, counted = Ros2Outputs(node, Ros2Frames(), Robot(T_MAP_WORLD)), []
    monkeypatch.setattr(
        messages,
        "quaternion_from_rotation",
        lambda R: counted.append(R) or quaternion_from_rotation(R),
    )
    path = np.array([se3_exp(xi) for xi in rng.normal(size=(50, 6))])
    outputs.map(1.0, path, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert len(counted) == 1
    (sent,) = node.topics["/bmask_slam/path"]
    for stamped, T in zip(sent.poses, T_MAP_WORLD @ path @ inverse(T_MAP_WORLD), strict=True):
        at, q = stamped.pose.position, stamped.pose.orientation
        assert np.allclose([at.x, at.y, at.z], T[:3, 3])
        turn = rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))
        assert np.allclose(turn, T[:3, :3])
        assert (stamped.header.frame_id, stamped.header.stamp.sec) == ("map", 1)


class Run:
    """Stands in for a `LiveSlam` with a dense map and a segmenter."""

    def __init__(self) -> None:
        self.listeners: list[Any] = []

    def map(self) -> LandmarkCloud:
        one = np.zeros(1, np.int64)
        return LandmarkCloud(one, np.ones((1, 3)), np.zeros((1, 3), np.uint8), one)

    def trajectory(self) -> Trajectory:
        return Trajectory(np.ones(1), np.eye(4)[None])

    def health(self) -> Health:
        return Health(status="OK", source={"late": 1})

    def segment(self) -> int:
        return 0

    def keyframe_poses(self) -> dict[int, np.ndarray]:
        return {4: np.eye(4)}

    def objects(self) -> MapObjects:
        return OBJECTS

    def on_submap(self, listener: Any) -> None:
        self.listeners.append(listener)


OBJECTS = some_objects()


def test_maps_are_published_when_they_are_due(monkeypatch) -> None:
    clock = SimpleNamespace(monotonic=lambda: clock.now_s, thread_time=lambda: 0.0, now_s=0.0)
    monkeypatch.setattr(publisher, "time", clock)
    node, run = StandIn(), Run()
    publish = Ros2Publisher(node, Ros2Frames(), Robot(T_MAP_WORLD, True))
    for k in range(80):
        clock.now_s = 100 + k / 10
        segment = 1 if k == 3 else 0  # of a map that ROS does not know
        publish(FrameResult(k, 5 + k / 10, TrackingStatus.OK, np.eye(4), segment), run)
        if k == 0:
            (add,) = run.listeners
            add(4, room(2.02), np.zeros((len(room(2.02)), 3), np.uint8))
    assert publish._making is not None
    publish._making.result(10)
    counts = {topic: len(sent) for topic, sent in node.topics.items()}
    assert counts["/bmask_slam/odometry"] == counts["/bmask_slam/pose"] == 79
    assert counts["/bmask_slam/path"] == counts["/diagnostics"] == 8
    assert counts["/bmask_slam/objects"] == counts["/bmask_slam/object_markers"] == 1
    assert 1 <= counts["/bmask_slam/map"] == counts["/bmask_slam/cloud"] <= 2
    assert node.topics["/bmask_slam/map"][-1].info.width > 20
    publish.finish(Run())  # which has tracked nothing
    assert len(node.topics["/bmask_slam/path"]) == 8
    publish.finish(run)
    assert len(node.topics["/bmask_slam/path"]) == len(node.topics["/bmask_slam/landmarks"]) == 9
    for topic in ("map", "cloud"):
        name = f"/bmask_slam/{topic}"
        assert len(node.topics[name]) == counts[name] + 1


def test_a_grid_that_cannot_be_made_is_one_warning_and_later_ones_are_made(
    monkeypatch, caplog
) -> None:
    clock = SimpleNamespace(monotonic=lambda: clock.now_s, thread_time=lambda: 0.0, now_s=100.0)
    monkeypatch.setattr(publisher, "time", clock)
    node, run, make, calls = StandIn(), Run(), LiveGrid.grid, []

    def failing(grid: LiveGrid, poses: dict[int, np.ndarray]) -> Any:
        calls.append(poses)
        if len(calls) <= 2:
            raise MemoryError("a grid of kilometres")
        return make(grid, poses)

    monkeypatch.setattr(LiveGrid, "grid", failing)
    publish = Ros2Publisher(node, Ros2Frames(), Robot(T_MAP_WORLD, True))
    for k in range(4):
        clock.now_s += publisher.GRID_S
        publish(FrameResult(k, 5 + k, TrackingStatus.OK, np.eye(4), 0), run)
        if k == 0:
            run.listeners[0](4, room(2.02), np.zeros((len(room(2.02)), 3), np.uint8))
        wait([publish._making])
    assert len(calls) == 4 and node.topics["/bmask_slam/map"][-1].info.width > 20
    assert len(node.topics["/bmask_slam/odometry"]) == 4
    said = [r for r in caplog.records if r.levelname == "WARNING"]
    assert len(said) == 1 and "could not be made; later ones are tried" in said[0].getMessage()


def test_a_path_that_takes_long_is_published_less_often(monkeypatch) -> None:
    """After an hour, that of all frames takes longer than the interval of two images."""
    clock = SimpleNamespace(monotonic=lambda: clock.now_s, thread_time=lambda: 0.0, now_s=100.0)
    monkeypatch.setattr(publisher, "time", clock)
    node, run = StandIn(), Run()

    def trajectory() -> Trajectory:
        clock.now_s += 0.2
        return Trajectory(np.ones(1), np.eye(4)[None])

    run.trajectory = trajectory  # type: ignore[method-assign]
    publish = Ros2Publisher(node, Ros2Frames(), Robot(T_MAP_WORLD, True))
    for k in range(120):
        publish(FrameResult(k, 5 + k / 10, TrackingStatus.OK, np.eye(4), 0), run)
        clock.now_s += 0.1
    counts = {topic: len(sent) for topic, sent in node.topics.items()}
    assert counts["/bmask_slam/path"] == counts["/bmask_slam/landmarks"] == 4
    assert counts["/diagnostics"] >= 11


def test_what_is_published_last_is_of_the_map_at_the_end() -> None:
    node, run = StandIn(), Run()
    publish = Ros2Publisher(node, Ros2Frames(), Robot(T_MAP_WORLD, True))
    publish(FrameResult(0, 5.0, TrackingStatus.OK, np.eye(4), 0), run)
    points = room(2.02)
    run.listeners[0](4, points, np.zeros((len(points), 3), np.uint8))
    moved, T = some_objects(), make_pose(np.eye(3), np.array([0.5, 0.0, 0.0]))
    run.objects = lambda: moved  # type: ignore[method-assign]
    run.keyframe_poses = lambda: {4: T}  # type: ignore[method-assign]
    publish.finish(run)
    assert len(node.topics["/bmask_slam/objects"]) == 2
    cloud = node.topics["/bmask_slam/cloud"][-1]
    xyz = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 4)[:, :3]
    expected = transform(T_MAP_WORLD @ T, points.astype(float))
    assert np.allclose(xyz.min(axis=0), expected.min(axis=0), atol=0.04)
    assert node.topics["/bmask_slam/map"][-1].info.width > 20


def test_a_segment_that_is_joined_later_is_in_the_grid() -> None:
    grid = LiveGrid(T_MAP_WORLD, GridOptions(floor_m=0.0))
    grid.add(4, room(2.02))
    grid.add(9, room(2.52))
    assert grid.grid({9: np.eye(4)}) is not None  # 4 is of another segment
    far = make_pose(np.eye(3), np.array([5.0, 0.0, 0.0]))
    joined, _ = grid.grid({4: far, 9: np.eye(4)})
    alone, _ = grid.grid({9: np.eye(4)})
    assert joined.cells.size > alone.cells.size


@pytest.mark.parametrize("name", ["grid_resolution_m", "cloud_voxel_m"])
def test_an_edge_of_nothing_is_refused(name: str) -> None:
    for edge_m in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InputError, match=name):
            Ros2Frames(**{name: edge_m})
