"""The robot's frames by /tf_static and /tf: mountings, which must be still, and odometry."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, se3_log
from bmask_slam.live.ros2.messages import message, pose, type_name
from bmask_slam.live.ros2.transport import Node, Quality, Reader
from bmask_slam.sequences.bags.transforms import TRANSFORMS, TransformTree

TF = "/tf"
TF_QUALITY = Quality(reliable=True, depth=1000)
"""As tf2's listener has it, but with a queue for the time in which nobody reads."""
KEPT = 4000
"""Poses of odometry that wait to be read."""
MOVED_M, TURNED_RAD = 0.005, 0.01
"""A mounting that differs by more from that at the start has moved."""
_POLL_S = 0.02


class RobotFrames:
    """Frames that move by /tf, and those that do not by /tf_static; for one thread at a time.

    Attributes:
        broken: transforms of /tf that were none.
    """

    def __init__(self, node: Node, where: str, static: Callable[[], Iterable[Any]]) -> None:
        """``where`` is for messages; ``static`` gives the messages of /tf_static so far."""
        self.broken = 0
        self._node, self._where, self._static = node, where, static
        self._tree, self._moving = TransformTree(), set[str]()
        self._reader: Reader | None = None
        self._mountings: dict[tuple[str, str], Array] = {}
        self._odometry: TfOdometry | None = None

    def mounting(self, camera: str, other: str, wait_s: float) -> Array | None:
        """T_camera_other (4, 4); None where tf does not say it in this time.

        If it is by /tf, ``hear`` checks from then on that it stays as it is.
        """
        T = self._wait(lambda: self._tree.pose(camera, other), (TRANSFORMS, TF), wait_s)
        if T is not None and self._tree.between(camera, other) & self._moving:
            self._mountings[camera, other] = T
        return None if T is None else np.asarray(T)

    def odometry(self, odom: str, base: str, wait_s: float) -> TfOdometry | None:
        """The base's motion in ``odom`` by /tf; None where nobody publishes it in this time."""
        found = TfOdometry(self, odom, base)
        self._odometry = found
        if self._wait(lambda: found.waiting or None, (TF,), wait_s) is None:
            self._odometry = None
        return self._odometry

    def hear(self) -> None:
        """Take what /tf has told since the last call.

        Raises:
            InputError: a mounting moves.
        """
        if self._odometry is None and not self._mountings:
            self._reader = None  # nobody asks
        self._take()
        for (camera, other), T in self._mountings.items():
            self._check_still(camera, other, T)

    def _wait(self, find: Callable[[], Any], topics: tuple[str, ...], wait_s: float) -> Any:
        """What ``find`` finds, None after this time, and if none of the topics is published."""
        end_s = time.monotonic() + wait_s
        while True:
            self._learn()
            found, published = find(), self._node.published()
            if found is not None or time.monotonic() > end_s or not published.keys() & topics:
                return found
            time.sleep(_POLL_S)

    def _learn(self) -> None:
        """Read /tf_static, and what others publish on /tf."""
        for received in self._static():
            for one in received.transforms:
                if one.child_frame_id.lstrip("/") not in self._moving:
                    self._tree.add(one, self._where)
        kind = type_name("TFMessage")
        if self._reader is None and self._node.published().get(TF) == kind:
            self._reader = self._node.reader(TF, kind, TF_QUALITY)
        self._take()

    def _take(self) -> None:
        received = [] if self._reader is None else self._reader.take(TF_QUALITY.depth)
        for one in (transform for told in received for transform in told.transforms):
            try:
                self._tree.add(one, self._where)
            except InputError:
                self.broken += 1
                continue
            self._moving.add(one.child_frame_id.lstrip("/"))
            if self._odometry is not None:
                self._odometry.add(one, self._tree)

    def _check_still(self, camera: str, other: str, T: Array) -> None:
        """Raise InputError if T_camera_other is not as it was at the start."""
        now = self._tree.pose(camera, other)
        moved = np.zeros(6) if now is None else se3_log(inverse(T) @ now)
        turned_rad, moved_m = np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])
        if turned_rad > TURNED_RAD or moved_m > MOVED_M:
            raise InputError(
                f"{self._where}: by /tf the camera {camera!r} has moved against {other!r}, by "
                f"{1e3 * moved_m:.0f} mm and {np.degrees(turned_rad):.1f} degrees, but a mounting "
                "must be still; give a frame that the camera is fixed to as `base` in --ros2-params"
            )


class TfOdometry:
    """The base's motion by /tf, read as if it were a topic of odometry.

    Where links between ``odom`` and the base are apart, the uppermost gives the stamps, and the
    others are as they were last.

    Attributes:
        waiting: messages that are not read yet.
        broken: transforms of /tf that were none.
    """

    def __init__(self, frames: RobotFrames, odom: str, base: str) -> None:
        self.broken = 0
        self.waiting: deque[Any] = deque(maxlen=KEPT)
        self._frames, self._odom, self._base = frames, odom.lstrip("/"), base.lstrip("/")
        self._last: Any = None

    def take(self, most: int = 16) -> list[Any]:
        """What was received since the last call, as nav_msgs/Odometry. Raises InputError."""
        self._frames.hear()
        self.broken = self._frames.broken
        return [self.waiting.popleft() for _ in range(min(most, len(self.waiting)))]

    def add(self, one: Any, tree: TransformTree) -> None:
        """A transform of /tf that is in the tree; one that is sent again does not count."""
        above = tree.above(self._base)
        of_base = {one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")} <= above.keys()
        if one.header.frame_id.lstrip("/") != self._odom or not of_base:
            return
        if one.header.stamp == self._last:
            return
        self._last = one.header.stamp
        where = message("PoseWithCovariance", pose(above[self._odom]), np.zeros(36))
        zero = message("Vector3", 0.0, 0.0, 0.0)
        twist = message("TwistWithCovariance", message("Twist", zero, zero), np.zeros(36))
        self.waiting.append(message("Odometry", one.header, self._base, where, twist))
