"""Where frames are, by messages of tf: a tree in which each frame has its pose in its parent."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, rotation_from_quaternion
from bmask_slam.sequences.bags.bag_file import Bag

TRANSFORMS = "/tf_static"
MAX_STATIC = 100
"""Messages of /tf_static that are read; there is one for each node that knows a transform."""
MAX_FRAMES = 10_000
"""Of a tree; further ones are left out."""


class TransformTree:
    """Frames, each with its parent. A slash before a name does not count."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, one: Any, where: str) -> None:
        """A geometry_msgs/TransformStamped; it replaces the one before of the same child.

        Raises:
            InputError: it is no pose.
        """
        parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
        if child in self._parents or len(self._parents) < MAX_FRAMES:
            self._parents[child] = parent, pose_of(one.transform, where)

    def above(self, frame: str) -> dict[str, Array]:
        """The frame and those above it, upwards, each with T_it_frame (4, 4)."""
        return dict(self._upwards(frame.lstrip("/")))

    def pose(self, a: str, b: str) -> Array | None:
        """T_a_b (4, 4); None where the tree does not hold both."""
        of_a, of_b = self.above(a), self.above(b)
        shared = next((frame for frame in of_a if frame in of_b), None)
        return None if shared is None else inverse(of_a[shared]) @ of_b[shared]

    def between(self, a: str, b: str) -> set[str]:
        """The frames whose poses in their parents make T_a_b; the tree holds both."""
        of_a, of_b = self.above(a), self.above(b)
        return set(of_a) ^ set(of_b)

    def _upwards(self, frame: str) -> Iterator[tuple[str, Array]]:
        """See ``above``; ends where a tree runs in a circle."""
        T_here_frame = np.eye(4)
        for _ in range(len(self._parents) + 1):
            yield frame, T_here_frame
            if frame not in self._parents:
                return
            frame, T_parent_here = self._parents[frame]
            T_here_frame = T_parent_here @ T_here_frame


def static_extrinsics(bag: Bag, rgb_frame: str, depth_frame: str) -> Array | None:
    """T_rgb_depth of two frames by /tf_static; None if its tree does not hold both."""
    tree = TransformTree()
    for _, message in islice(bag.messages(TRANSFORMS), MAX_STATIC):
        if not hasattr(message, "transforms"):
            break
        for one in message.transforms:
            tree.add(one, str(bag.path))
    return tree.pose(rgb_frame, depth_frame)


def sdk_extrinsics(bag: Bag, rgb_stream: str, depth_stream: str) -> Array | None:
    """T_rgb_depth by what RealSense's SDK has in ROS 1, each T_stream_reference; None: no such.

    In ROS 2 it has frames of the streams in /tf_static.
    """
    poses = []
    for stream in (rgb_stream, depth_stream):
        message = next((m for _, m in bag.messages(f"{stream}tf/0")), None)
        if message is None or not hasattr(message, "rotation"):
            return None
        poses.append(pose_of(message, str(bag.path)))
    return poses[0] @ inverse(poses[1])


def pose_of(transform: Any, where: str) -> Array:
    """A geometry_msgs/Transform as (4, 4). Raises InputError for what is no pose."""
    q, t = transform.rotation, transform.translation
    words = np.array([q.x, q.y, q.z, q.w, t.x, t.y, t.z], float)
    if not (np.isfinite(words).all() and 0.5 < np.linalg.norm(words[:4]) < 2):
        raise InputError(f"{where}: a transform of {words.tolist()} is no pose; give --camera F")
    return make_pose(rotation_from_quaternion(words[:4]), words[4:])
