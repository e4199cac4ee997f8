"""Whether a thing that a mask shows stands or moves, by what other keyframes saw where it is."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np

from bmask_slam.graph.geometry import Array
from bmask_slam.moving.depth_view_buffer import PosedView
from bmask_slam.moving.free_space_check import StaticCheck


class Stance(Enum):
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
        return self in (Stance.STATIC, Stance.STILL)


def stance(
    points_world: Array,
    time_s: float,
    views: Sequence[PosedView],
    check: StaticCheck,
    at_least: int,
) -> Stance:
    """What views say about a thing at points (N, 3) at a time; nothing if of too few points.

    That it is still is asked of all that was seen, things that were believed to move included: a
    thing with a wrong name would hide its own traces.
    """
    if not views:
        return Stance.UNKNOWN
    apart_s = np.array([v.timestamp_s - time_s for v in views])
    seen = check.judge_all(points_world, [(v.seen, v.T_world_camera) for v in views])
    if check.stood_still(seen, apart_s, at_least):
        return Stance.STILL
    told = check.judge_all(points_world, [(v.view, v.T_world_camera) for v in views])
    verdicts = check.agree(told)
    known = np.count_nonzero(verdicts)
    if known < at_least:
        return Stance.UNKNOWN
    moves = np.count_nonzero(verdicts < 0) > known / 2
    return Stance.MOVING if moves else Stance.STATIC
