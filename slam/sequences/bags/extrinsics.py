"""Where the cameras of a bag are, by the transforms in it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, rotation_from_quaternion
from bmask_slam.sequences.bags.bag_file import Bag

TRANSFORMS = "/tf_static"
MAX_STATIC = 100
"""Messages of /tf_static that are read; there is one for each node that knows a transform."""


def sdk_extrinsics(bag: Bag, rgb_stream: str, depth_stream: str) -> Array | None:
    """T_rgb_depth by what RealSense's SDK has in ROS 1, each T_stream_reference; None: no such.

    In ROS 2 it has frames of the streams in /tf_static.
    """
    poses = []
    for stream in (rgb_stream, depth_stream):
        message = next((m for _, m in bag.messages(f"{stream}tf/0")), None)
        if message is None or not hasattr(message, "rotation"):
            return None
        poses.append(_pose_of(message, bag))
    return poses[0] @ inverse(poses[1])


def static_extrinsics(bag: Bag, rgb_frame: str, depth_frame: str) -> Array | None:
    """T_rgb_depth of two frames by /tf_static; None if its tree does not hold both."""
    parents: dict[str, tuple[str, Array]] = {}
    for count, (_, message) in enumerate(bag.messages(TRANSFORMS)):
        if count == MAX_STATIC or not hasattr(message, "transforms"):
            break
        for one in message.transforms:
            parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
            parents[child] = parent, _pose_of(one.transform, bag)
    rgb, depth = (dict(_upwards(f.lstrip("/"), parents)) for f in (rgb_frame, depth_frame))
    shared = next((frame for frame in rgb if frame in depth), None)
    return None if shared is None else inverse(rgb[shared]) @ depth[shared]


def _upwards(frame: str, parents: dict[str, tuple[str, Array]]) -> Iterator[tuple[str, Array]]:
    """A frame and those above it, each with T_it_frame; ends where a tree runs in a circle."""
    T_here_frame = np.eye(4)
    for _ in range(len(parents) + 1):
        yield frame, T_here_frame
        if frame not in parents:
            return
        frame, T_parent_here = parents[frame]
        T_here_frame = T_parent_here @ T_here_frame


def _pose_of(transform: Any, bag: Bag) -> Array:
    """A geometry_msgs/Transform as (4, 4). Raises InputError for what is no pose."""
    q, t = transform.rotation, transform.translation
    words = np.array([q.x, q.y, q.z, q.w, t.x, t.y, t.z], float)
    if not (np.isfinite(words).all() and 0.5 < np.linalg.norm(words[:4]) < 2):
        raise InputError(f"{bag.path}: a transform of {words.tolist()} is no pose; give --camera F")
    return make_pose(rotation_from_quaternion(words[:4]), words[4:])
