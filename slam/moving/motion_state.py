"""Whether a thing that a mask shows stands or moves, by what other keyframes saw where it is."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.moving.depth_view_buffer import PosedView
from bmask_slam.moving.free_space_check import FreeSpaceCheck


class MotionState(Enum):
    """What views say about a thing."""

    MOVING = "moving"
    """Most of it lies in space that was seen to be free."""
    UNKNOWN = "unknown"
    STATIC = "static"
    """Most of it is where a surface was seen."""
    STILL = "still"
    """It was there for so long that its class says nothing about it."""

    @property
    def is_static(self) -> bool:
        """Whether it stands, for long or not."""
        return self in (MotionState.STATIC, MotionState.STILL)


def motion_state(
    points_world: Array,
    time_s: float,
    views: Sequence[PosedView],
    check: FreeSpaceCheck,
    at_least: int,
) -> MotionState:
    """What views say about a thing at points (N, 3) at a time; nothing if of too few points.

    That it is still is asked of all that was seen, things that were believed to move included: a
    thing with a wrong name would hide its own traces.
    """
    if not views:
        return MotionState.UNKNOWN
    apart_s = np.array([v.timestamp_s - time_s for v in views])
    seen = check.judge_all(points_world, [(v.seen, v.T_world_camera) for v in views])
    if check.stood_still(seen, apart_s, at_least):
        return MotionState.STILL
    told = check.judge_all(points_world, [(v.view, v.T_world_camera) for v in views])
    point_motions = check.agree(told)
    known = np.count_nonzero(point_motions)
    if known < at_least:
        return MotionState.UNKNOWN
    moves = np.count_nonzero(point_motions < 0) > known / 2
    return MotionState.MOVING if moves else MotionState.STATIC
