"""ROS 2's messages of poses, clouds and the like, of rosbags' classes."""

from __future__ import annotations

from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes
from bmask_slam.graph.geometry import adjoint, make_pose, quaternion_from_rotation
from bmask_slam.live.ros2.transport import typestore
from bmask_slam.mapping.products.occupancy import OccupancyGrid
from bmask_slam.tracking.results import Velocity

UNKNOWN_VARIANCE = 1e6
PACKAGES = {
    **dict.fromkeys(("Time", "Duration"), "builtin_interfaces"),
    **dict.fromkeys(("Header", "ColorRGBA"), "std_msgs"),
    **dict.fromkeys(("Odometry", "Path", "OccupancyGrid", "MapMetaData"), "nav_msgs"),
    **dict.fromkeys(("Image", "PointCloud2", "PointField", "CompressedImage"), "sensor_msgs"),
    **dict.fromkeys(("Marker", "MarkerArray", "MeshFile"), "visualization_msgs"),
    **dict.fromkeys(("ObjectHypothesis", "ObjectHypothesisWithPose"), "vision_msgs"),
    **dict.fromkeys(("BoundingBox3D", "Detection3D", "Detection3DArray"), "vision_msgs"),
    **dict.fromkeys(("DiagnosticArray", "DiagnosticStatus", "KeyValue"), "diagnostic_msgs"),
    **dict.fromkeys(("TFMessage",), "tf2_msgs"),
}
"""Of message types; the others are of geometry_msgs."""


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


def poses(T: Array) -> list[Any]:
    """A geometry_msgs/Pose of each pose (N, 4, 4)."""
    quaternions = quaternion_from_rotation(T[:, :3, :3]).tolist()
    return [
        message("Pose", message("Point", *place), message("Quaternion", *turn))
        for place, turn in zip(T[:, :3, 3].tolist(), quaternions, strict=True)
    ]


def pose(T: Array) -> Any:
    """A geometry_msgs/Pose."""
    return poses(T[None])[0]


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


def ros_twist(velocity: Velocity | None, T_base_camera: Array) -> Any:
    """A geometry_msgs/TwistWithCovariance of the base in its own frame; -1 where it is unknown.

    Since ``T_world_base = T_world_camera @ T_camera_base`` its twist is ``Ad(T_base_camera)`` times
    the camera's. ROS has the shift before the turn.
    """
    if velocity is None:
        zero = message("Vector3", 0.0, 0.0, 0.0)
        return message("TwistWithCovariance", message("Twist", zero, zero), np.full(36, -1.0))
    J = np.roll(adjoint(T_base_camera), 3, axis=0)
    shift, turn = np.split(J @ velocity.twist, 2)
    twist = message("Twist", *(message("Vector3", *part.tolist()) for part in (shift, turn)))
    return message("TwistWithCovariance", twist, (J @ velocity.covariance @ J.T).ravel())


def occupancy_grid(stamp_s: float, frame: str, grid: OccupancyGrid, floor_m: float) -> Any:
    """A nav_msgs/OccupancyGrid of a grid whose floor is at this height of the frame."""
    stamped, (height, width) = header(stamp_s, frame), grid.cells.shape
    T = make_pose(np.eye(3), np.array([*grid.origin_m, floor_m]))
    info = message("MapMetaData", stamped.stamp, grid.resolution_m, width, height, pose(T))
    return message("OccupancyGrid", stamped, info, np.ascontiguousarray(grid.cells).ravel())


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
