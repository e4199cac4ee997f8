"""What a live run tells ROS 2: poses with covariance, tf, the path, landmarks, its health."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, orthonormalised
from bmask_slam.labelling.results import MapObjects
from bmask_slam.live.ros2.messages import (
    header,
    message,
    occupancy_grid,
    point_cloud,
    pose,
    poses,
    ros_covariance,
    ros_twist,
    transform,
    type_name,
)
from bmask_slam.live.ros2.objects import detection_array, marker_array
from bmask_slam.live.ros2.transport import LATCHED, STATE, Node
from bmask_slam.mapping.products.occupancy import OccupancyGrid
from bmask_slam.tracking.results import FrameResult, TrackingStatus

OPTICAL = make_pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
"""T_base_camera of a camera that looks along the base's x, where nothing else is said (REP 103)."""
DIAGNOSTIC_LEVELS = {"OK": 0, "WEAK": 1, "DEAD_RECKONING": 1, "LOST": 2}


@dataclass(frozen=True)
class Ros2Frames:
    """Names of frames, and where the camera is on the robot.

    Attributes:
        map, odom, base, camera: tf's frames. Without wheel odometry ``odom`` is ``map``, and
            corrections of the graph move the base.
        base_camera: T_base_camera as 16 numbers by rows; the base's x is forward, its z up. Empty:
            that of /tf_static, or a level camera that looks along x.
        prefix: of the topics.
        tf_ahead_s: with wheel odometry, the transform from ``map`` to ``odom`` is stamped so much
            later than the image, so that it holds until the next one (as nav2's AMCL does).
        floor_m: height of the floor in the base's frame, for the grid. Where the camera's place
            is not known, the floor is the lowest level with many points.
        grid_resolution_m: edge of the grid's cells.
        cloud_voxel_m: the dense cloud has one point in each cube of this edge.
        grid_low_m, grid_high_m: what is lower above the floor is driven over, higher under.
    """

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"
    camera: str = "camera_optical_frame"
    base_camera: tuple[float, ...] = ()
    prefix: str = "/bmask_slam"
    tf_ahead_s: float = 0.1
    floor_m: float = 0.0
    grid_resolution_m: float = 0.05
    grid_low_m: float = 0.1
    grid_high_m: float = 1.5
    cloud_voxel_m: float = 0.03

    def __post_init__(self) -> None:
        for name in ("cloud_voxel_m", "grid_resolution_m"):
            edge_m = getattr(self, name)
            if not 0 < edge_m < np.inf:
                raise InputError(f"{name}: {edge_m:g} is no edge of a cube")
        if self.base_camera:
            T = np.array(self.base_camera)
            good = T.size == 16 and np.isfinite(T).all()
            R = T.reshape(4, 4)[:3, :3] if good else np.zeros((3, 3))
            if not good or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
                raise InputError("base_camera: must be the 16 numbers of a pose T_base_camera")

    @property
    def T_base_camera(self) -> Array | None:
        """(4, 4); None where it is not given."""
        if not self.base_camera:
            return None
        return orthonormalised(np.array(self.base_camera, float).reshape(4, 4))


@dataclass(frozen=True)
class Robot:
    """What is known of the robot.

    Attributes:
        T_base_camera: (4, 4).
        is_known: it is that of the robot, no assumption.
        by_tf: somebody else publishes the camera's place.
        T_odom_base: gives the pose (4, 4) of the base by wheel odometry at a time, None where that
            does not cover it. None: there is no wheel odometry. Who measures it publishes the
            transform from ``odom`` to ``base``, as drivers of robots do.
        ros_time: ROS's stamp of a frame's time.
    """

    T_base_camera: Array
    is_known: bool = False
    by_tf: bool = False
    T_odom_base: Callable[[float], Array | None] | None = None
    ros_time: Callable[[float], float] = float


class Ros2Outputs:
    """Publishes the results of a live run.

    The map's frame is the base's at the first keyframe: z up if the robot stood level.
    """

    def __init__(self, node: Node, frames: Ros2Frames, robot: Robot) -> None:
        self._frames, self._robot = frames, robot
        self._T_map_world = robot.T_base_camera
        self._T_camera_base = inverse(robot.T_base_camera)
        self._T_map_odom: Array | None = None
        prefix = frames.prefix

        def writer(topic: str, last: str, quality: Any = STATE) -> Any:
            return node.writer(topic, type_name(last), quality)

        self._odometry = writer(f"{prefix}/odometry", "Odometry")
        self._pose = writer(f"{prefix}/pose", "PoseWithCovarianceStamped")
        self._path = writer(f"{prefix}/path", "Path", LATCHED)
        self._landmarks = writer(f"{prefix}/landmarks", "PointCloud2", LATCHED)
        self._grid = writer(f"{prefix}/map", "OccupancyGrid", LATCHED)
        self._cloud = writer(f"{prefix}/cloud", "PointCloud2", LATCHED)
        self._markers = writer(f"{prefix}/object_markers", "MarkerArray", LATCHED)
        self._detections = writer(f"{prefix}/objects", "Detection3DArray", LATCHED)
        self._diagnostics = writer("/diagnostics", "DiagnosticArray")
        self._tf = writer("/tf", "TFMessage")
        self._tf_static = writer("/tf_static", "TFMessage", LATCHED)
        static = []
        if robot.T_odom_base is None:
            static.append(transform(0.0, (frames.map, frames.odom), np.eye(4)))
        if not robot.by_tf:
            static.append(transform(0.0, (frames.base, frames.camera), robot.T_base_camera))
        if static:
            self._tf_static.send(message("TFMessage", static))

    def frame(self, result: FrameResult, known: bool = True) -> None:
        """Publish a frame's pose; one that is lost has none, and leaves ``odom`` where it was.

        ``known``: its map is the one that is published.
        """
        f, stamp_s = self._frames, self._robot.ros_time(result.timestamp_s)
        lost = result.status is TrackingStatus.LOST or not known
        if result.T_world_camera is None or lost:
            self._send_map_odom(stamp_s)
            return
        T_map_base = self._T_map_world @ result.T_world_camera @ self._T_camera_base
        covariance = ros_covariance(result.covariance, self._robot.T_base_camera, T_map_base)
        where = message("PoseWithCovariance", pose(T_map_base), covariance.ravel())
        twist = ros_twist(result.velocity, self._robot.T_base_camera)
        frame = f.odom if self._robot.T_odom_base is None else f.map
        self._odometry.send(message("Odometry", header(stamp_s, frame), f.base, where, twist))
        self._pose.send(message("PoseWithCovarianceStamped", header(stamp_s, f.map), where))
        if self._robot.T_odom_base is None:
            moved = transform(stamp_s, (f.odom, f.base), T_map_base)
            self._tf.send(message("TFMessage", [moved]))
            return
        T_odom_base = self._robot.T_odom_base(result.timestamp_s)
        if T_odom_base is not None:
            self._T_map_odom = T_map_base @ inverse(T_odom_base)
        self._send_map_odom(stamp_s)

    def _send_map_odom(self, stamp_s: float) -> None:
        """Publish where odometry's frame is in the map, once it is known."""
        if self._T_map_odom is not None:
            frames, ahead_s = (self._frames.map, self._frames.odom), self._frames.tf_ahead_s
            moved = transform(stamp_s + ahead_s, frames, self._T_map_odom)
            self._tf.send(message("TFMessage", [moved]))

    def map(self, stamp_s: float, path_world: Array, points_world: Array, colours: Bytes) -> None:
        """Publish keyframe poses (K, 4, 4) and landmarks (N, 3) with colours (N, 3)."""
        f, path_map = self._frames, self._T_map_world @ path_world @ self._T_camera_base
        top = header(stamp_s, f.map)
        stamped = [message("PoseStamped", top, where) for where in poses(path_map)]
        self._path.send(message("Path", header(stamp_s, f.map), stamped))
        R, t = self._T_map_world[:3, :3], self._T_map_world[:3, 3]
        self._landmarks.send(point_cloud(stamp_s, f.map, points_world @ R.T + t, colours))

    def objects(self, stamp_s: float, found: MapObjects) -> None:
        """Publish objects as markers and as detections."""
        where = stamp_s, self._frames.map, found, self._T_map_world
        self._markers.send(marker_array(*where))
        self._detections.send(detection_array(*where))

    def grid(self, stamp_s: float, grid: OccupancyGrid, floor_m: float) -> None:
        """Publish the map to drive on; ``floor_m`` is the floor's height in the map's frame."""
        self._grid.send(occupancy_grid(stamp_s, self._frames.map, grid, floor_m))

    def cloud(self, stamp_s: float, points_map: Array, colours: Bytes) -> None:
        """Publish the dense map's points (N, 3), in the map's frame, with colours (N, 3)."""
        self._cloud.send(point_cloud(stamp_s, self._frames.map, points_map, colours))

    def begin(self) -> None:
        """Forget where odometry's frame was in the map: another map begins."""
        self._T_map_odom = None

    def health(self, stamp_s: float, values: dict[str, Any]) -> None:
        """Publish numbers and texts by name; ``status`` gives the level."""
        status = str(values.get("status", ""))
        rows = [message("KeyValue", name, str(value)) for name, value in values.items()]
        level = DIAGNOSTIC_LEVELS.get(status, 2)
        told = message("DiagnosticStatus", level, "bmask_slam: tracking", status, "", rows)
        self._diagnostics.send(message("DiagnosticArray", header(stamp_s, ""), [told]))
