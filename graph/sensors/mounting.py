"""How sensors are mounted, and the sigmas of what they do not measure."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose, rotation_from_quaternion

Mounting = tuple[float, float, float, float, float, float, float]
"""A pose in TUM's columns: x y z in metres, qx qy qz qw."""
Lever = tuple[float, float, float]
"""A point in metres."""
FREE_RAD, FREE_M = 100.0, 1000.0
"""Sigmas of what a measurement says nothing about."""


def T_of(mounting: Mounting) -> Array:
    """The pose (4, 4) of a mounting. Raises InputError for one that is none."""
    values = np.array(mounting, float)
    if values.shape != (7,) or not np.isfinite(values).all() or not np.any(values[3:]):
        raise InputError(f"{mounting}: give seven numbers, x y z in metres and qx qy qz qw")
    return make_pose(rotation_from_quaternion(values[3:]), values[:3])
