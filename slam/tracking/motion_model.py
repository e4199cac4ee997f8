"""Where the camera was last and how it moved: what the next frame is predicted from."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.geometry import carried_along, inverse, orthonormalised, se3_exp, se3_log
from bmask_slam.graph.sensors.odometry import Motion, MotionSensor
from bmask_slam.tracking.pose.rolling_shutter import PreviousPose

UNEVEN = 0.25
"""Frames count as evenly spaced if their intervals differ by a smaller share."""
MAX_AGO_S = 0.2
"""The velocity for the rolling shutter is not taken from an older pose."""
MAX_STEPS = 4.0
"""The motion is extrapolated over at most so many times the interval in which it was measured."""


class MotionModel:
    """The last pose that an image gave, and the motion that led to it.

    Attributes:
        T_world_last: (4, 4).
        last_s, now_s: time of that pose, and of the frame that was begun last; NaN before.
    """

    def __init__(self) -> None:
        self.T_world_last = np.eye(4)
        self.last_s = self.now_s = np.nan
        self._T_last_next = np.eye(4)
        self._interval_s = np.nan  # during which T_last_next happened

    def state(self) -> Arrays:
        """Poses and times."""
        return {
            "T_world_last": self.T_world_last,
            "T_last_next": self._T_last_next,
            "stamps_s": np.array([self.last_s, self.now_s, self._interval_s]),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self.T_world_last, self._T_last_next = state["T_world_last"], state["T_last_next"]
        self.last_s, self.now_s, self._interval_s = state["stamps_s"].tolist()

    @property
    def ago_s(self) -> float:
        """Time from the last pose to the present frame."""
        return self.now_s - self.last_s

    def previous(self, lost_frames: int) -> PreviousPose | None:
        """The last pose; None where it is too old to give a velocity, or frames were lost since."""
        recent = lost_frames == 0 and 0 < self.ago_s < MAX_AGO_S  # False for NaN
        return PreviousPose(self.T_world_last, self.ago_s, self.now_s) if recent else None

    def restart(self, T_world_camera: Array) -> None:
        """Begin at a pose (4, 4), without speed."""
        self.T_world_last, self._T_last_next = T_world_camera, np.eye(4)

    def stop(self) -> None:
        """Nothing is known of the speed any more."""
        self._T_last_next = np.eye(4)

    def advance(self, T_world_tracked: Array, T_world_camera: Array, steady: bool) -> None:
        """The present frame has a pose, as tracked and as optimised; ``steady``: so had the last.

        Both are (4, 4). The motion is known in that case only.
        """
        self._T_last_next = inverse(self.T_world_last) @ T_world_tracked if steady else np.eye(4)
        self.T_world_last = T_world_camera
        self._interval_s, self.last_s = self.ago_s, self.now_s

    def follow_map(self, T_old: Array, T_new: Array) -> None:
        """The map was moved, as a keyframe from T_old to T_new (4, 4)."""
        self.T_world_last = carried_along(self.T_world_last, T_old, T_new)

    def by_velocity(self) -> Array:
        """T_world_camera (4, 4) of the present frame if the last motion goes on."""
        known = self._interval_s > 0  # False for NaN
        steps = self.ago_s / self._interval_s if known else 1.0
        if not abs(steps - 1) >= UNEVEN:
            return orthonormalised(self.T_world_last @ self._T_last_next)
        motion = min(max(steps, 0.0), MAX_STEPS) * se3_log(self._T_last_next)
        return orthonormalised(self.T_world_last @ se3_exp(motion))

    def by_odometry(self, sensors: MotionSensor) -> tuple[Array, Motion] | None:
        """T_world_camera (4, 4) of the present frame, and the motion since the last pose.

        None where odometry does not know it.
        """
        moved = sensors.motion(self.last_s, self.now_s)
        if moved is None:
            return None
        return orthonormalised(self.T_world_last @ moved.T_a_b), moved
