"""What a live run tells ROS 2: poses with covariance, tf, the path, landmarks, its health."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import (
    adjoint,
    inverse,
    make_pose,
    orthonormalised,
    quaternion_from_rotation,
)
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.results import LandmarkCloud
from bmask_slam.live.ros2.dds import LATCHED, STATE, Node, typestore
from bmask_slam.tracking.results import FrameResult, TrackingStatus

OPTICAL = make_pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
"""T_base_camera of a camera that looks along the base's x, where nothing else is said (REP 103)."""
UNKNOWN_VARIANCE = 1e6
PERIOD_S = 1.0
"""Between two messages with the map and the health."""
MAX_POSES, MAX_POINTS = 1000, 20_000
"""Of the path, and of landmarks, those seen most often, in a message."""
DIAGNOSTIC_LEVELS = {"OK": 0, "WEAK": 1, "DEAD_RECKONING": 1, "LOST": 2}
PACKAGES = {
    **dict.fromkeys(("Time",), "builtin_interfaces"),
    **dict.fromkeys(("Header",), "std_msgs"),
    **dict.fromkeys(("Odometry", "Path"), "nav_msgs"),
    **dict.fromkeys(("PointCloud2", "PointField"), "sensor_msgs"),
    **dict.fromkeys(("DiagnosticArray", "DiagnosticStatus", "KeyValue"), "diagnostic_msgs"),
    **dict.fromkeys(("TFMessage",), "tf2_msgs"),
}
"""Of message types; the others are of geometry_msgs."""


@dataclass(frozen=True)
class Ros2Frames:
    """Names of frames, and where the camera is on the robot.

    Attributes:
        map, odom, base, camera: tf's frames. ``odom`` is ``map``: corrections of the graph move
            the base.
        base_camera: T_base_camera as 16 numbers by rows; the base's x is forward, its z up. Empty:
            a level camera that looks along x.
        prefix: of the topics.
    """

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"
    camera: str = "camera_optical_frame"
    base_camera: tuple[float, ...] = ()
    prefix: str = "/bmask_slam"

    def __post_init__(self) -> None:
        if self.base_camera:
            T = np.array(self.base_camera)
            good = T.size == 16 and np.isfinite(T).all()
            R = T.reshape(4, 4)[:3, :3] if good else np.zeros((3, 3))
            if not good or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
                raise InputError("base_camera: must be the 16 numbers of a pose T_base_camera")

    @property
    def T_base_camera(self) -> Array:
        """(4, 4)."""
        if not self.base_camera:
            return OPTICAL
        return orthonormalised(np.array(self.base_camera, float).reshape(4, 4))


def type_name(last: str) -> str:
    """The full name of a message type, such as nav_msgs/msg/Path."""
    return f"{PACKAGES.get(last, 'geometry_msgs')}/msg/{last}"


def message(last: str, *values: Any) -> Any:
    """A message of a type by the last part of its name, with its fields in order."""
    return typestore().types[type_name(last)](*values)


def header(stamp_s: float, frame: str) -> Any:
    """A std_msgs/Header."""
    seconds, nanoseconds = divmod(round(stamp_s * 1e9), 1_000_000_000)
    return message("Header", message("Time", seconds, nanoseconds), frame)


def pose(T: Array) -> Any:
    """A geometry_msgs/Pose."""
    x, y, z, w = map(float, quaternion_from_rotation(T[:3, :3]))
    return message(
        "Pose", message("Point", *map(float, T[:3, 3])), message("Quaternion", x, y, z, w)
    )


def transform(stamp_s: float, frames: tuple[str, str], T: Array) -> Any:
    """A geometry_msgs/TransformStamped of T_parent_child."""
    x, y, z, w = map(float, quaternion_from_rotation(T[:3, :3]))
    moved = message("Vector3", *map(float, T[:3, 3]))
    both = message("Transform", moved, message("Quaternion", x, y, z, w))
    return message("TransformStamped", header(stamp_s, frames[0]), frames[1], both)


def ros_covariance(covariance: Array | None, T_base_camera: Array, T_map_base: Array) -> Array:
    """ROS's covariance (6, 6) of the base's pose: x y z and turns about the map's fixed axes.

    From that of the tangent [rotation, translation] at the camera, by ``Ad(T_base_camera)`` and the
    base's rotation in the map; large where it is not known.
    """
    if covariance is None or not np.isfinite(covariance).all():
        return np.eye(6) * UNKNOWN_VARIANCE
    R, Ad = T_map_base[:3, :3], adjoint(T_base_camera)
    J = np.vstack([R @ Ad[3:], R @ Ad[:3]])
    return np.asarray(J @ covariance @ J.T)


def point_cloud(stamp_s: float, frame: str, points: Array, colours: Bytes) -> Any:
    """A sensor_msgs/PointCloud2 of points (N, 3) with colours (N, 3): x y z rgb, 16 bytes each."""
    rows = np.zeros(len(points), [("xyz", "<f4", 3), ("bgr", "u1", 3), ("pad", "u1")])
    rows["xyz"], rows["bgr"] = points, colours[:, ::-1]
    fields = [message("PointField", n, 4 * k, 7, 1) for k, n in enumerate(("x", "y", "z", "rgb"))]
    data = np.frombuffer(rows.tobytes(), np.uint8)
    size = 16 * len(points)
    return message(
        "PointCloud2", header(stamp_s, frame), 1, len(points), fields, False, 16, size, data, True
    )


class Ros2Outputs:
    """Publishes the results of a live run.

    The map's frame is the base's at the first keyframe: z up if the robot stood level.
    """

    def __init__(self, node: Node, frames: Ros2Frames) -> None:
        self._frames = frames
        self._T_map_world = frames.T_base_camera
        self._T_camera_base = inverse(frames.T_base_camera)
        prefix = frames.prefix

        def writer(topic: str, last: str, quality: Any = STATE) -> Any:
            return node.writer(topic, type_name(last), quality)

        self._odometry = writer(f"{prefix}/odometry", "Odometry")
        self._pose = writer(f"{prefix}/pose", "PoseWithCovarianceStamped")
        self._path = writer(f"{prefix}/path", "Path", LATCHED)
        self._landmarks = writer(f"{prefix}/landmarks", "PointCloud2", LATCHED)
        self._diagnostics = writer("/diagnostics", "DiagnosticArray")
        self._tf = writer("/tf", "TFMessage")
        self._tf_static = writer("/tf_static", "TFMessage", LATCHED)
        links = (
            ((frames.map, frames.odom), np.eye(4)),
            ((frames.base, frames.camera), frames.T_base_camera),
        )
        static = [transform(0.0, names, T) for names, T in links]
        self._tf_static.send(message("TFMessage", static))

    def frame(self, result: FrameResult) -> None:
        """Publish a frame's pose; one that is lost has none."""
        if result.T_world_camera is None or result.status is TrackingStatus.LOST:
            return
        f, stamp_s = self._frames, result.timestamp_s
        T_map_base = self._T_map_world @ result.T_world_camera @ self._T_camera_base
        covariance = ros_covariance(result.covariance, f.T_base_camera, T_map_base).ravel()
        known = message("PoseWithCovariance", pose(T_map_base), covariance)
        zero = message("Vector3", 0.0, 0.0, 0.0)
        twist = message("TwistWithCovariance", message("Twist", zero, zero), np.full(36, -1.0))
        self._odometry.send(message("Odometry", header(stamp_s, f.odom), f.base, known, twist))
        self._pose.send(message("PoseWithCovarianceStamped", header(stamp_s, f.map), known))
        moved = transform(stamp_s, (f.odom, f.base), T_map_base)
        self._tf.send(message("TFMessage", [moved]))

    def map(self, stamp_s: float, path_world: Array, points_world: Array, colours: Bytes) -> None:
        """Publish keyframe poses (K, 4, 4) and landmarks (N, 3) with colours (N, 3)."""
        f, poses = self._frames, self._T_map_world @ path_world @ self._T_camera_base
        stamped = [message("PoseStamped", header(stamp_s, f.map), pose(T)) for T in poses]
        self._path.send(message("Path", header(stamp_s, f.map), stamped))
        R, t = self._T_map_world[:3, :3], self._T_map_world[:3, 3]
        self._landmarks.send(point_cloud(stamp_s, f.map, points_world @ R.T + t, colours))

    def health(self, stamp_s: float, values: dict[str, Any]) -> None:
        """Publish numbers and texts by name; ``status`` gives the level."""
        status = str(values.get("status", ""))
        rows = [message("KeyValue", name, str(value)) for name, value in values.items()]
        level = DIAGNOSTIC_LEVELS.get(status, 2)
        told = message("DiagnosticStatus", level, "bmask_slam: tracking", status, "", rows)
        self._diagnostics.send(message("DiagnosticArray", header(stamp_s, ""), [told]))


class LiveRun(Protocol):
    """What ``Ros2Publisher`` asks of a live run; `LiveSlam` has it."""

    def map(self) -> LandmarkCloud: ...
    def trajectory(self) -> Trajectory: ...
    def health(self) -> Any: ...


class Ros2Publisher:
    """Called with the result of each frame; publishes it, and the map and health each second."""

    def __init__(self, node: Node, frames: Ros2Frames) -> None:
        self._outputs = Ros2Outputs(node, frames)
        self._due_s = 0.0

    def __call__(self, result: FrameResult, run: LiveRun) -> None:
        """Publish a result, and the map where a second has passed."""
        self._outputs.frame(result)
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + PERIOD_S
        cloud, path = run.map(), run.trajectory().poses_world_camera
        path = path[:: len(path) // MAX_POSES + 1]
        best = np.argsort(-cloud.observations, kind="stable")[:MAX_POINTS]
        points, colours = cloud.points_world[best], cloud.colours[best]
        self._outputs.map(result.timestamp_s, path, points, colours)
        health = asdict(run.health())
        counts = health.pop("source")
        self._outputs.health(result.timestamp_s, health | counts)
