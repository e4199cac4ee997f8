"""Walks of people: closed rounds on the floor, fixed in the room or moving with the camera."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from bmask_slam.graph.arrays import Array
from bmask_slam.rendering.engine.meshes import pose
from bmask_slam.rendering.engine.path import CameraPath, duration_s, steady_poses

Places = tuple[tuple[float, float], ...]
"""Way points (x, y) in metres of a closed round."""

_STEPS_HZ = 50.0
_TURN_S = 0.3
"""Standard deviation of the smoothing of headings."""
_BEYOND_S = 2.0
"""How long after the camera's last frame an escort still has a pose."""


def on_round(places: Places, walked_m: float, phase: float) -> tuple[Array, float]:
    """The pose T_world_person (4, 4) after this distance, from a start at a share of the round.

    The person looks ahead, along -y of the person's frame. Also returns the distance from the
    round's first way point.
    """
    curve = _closed(places)
    distance_m = walked_m + phase * curve.x[-1]
    x, y = curve(distance_m % curve.x[-1])
    dx, dy = curve(distance_m % curve.x[-1], 1)
    return pose(x, y, 0.0, float(np.rad2deg(np.arctan2(dx, -dy)))), distance_m


class Escort:
    """A round that moves with the camera: its way points are (right, ahead) of the camera.

    The person faces along its motion in the room, and its stride follows the distance walked there.
    """

    def __init__(self, path: CameraPath, places: Places, speed_m_s: float, phase: float) -> None:
        """``speed_m_s`` is the speed along the round, relative to the camera."""
        self._times_s = np.arange(0.0, duration_s(path) + _BEYOND_S, 1 / _STEPS_HZ)
        curve = _closed(places)
        walked_m = speed_m_s * self._times_s + phase * curve.x[-1]
        before = curve(walked_m % curve.x[-1])
        camera = steady_poses(path, self._times_s)
        ahead = camera[:, :2, 2] / np.linalg.norm(camera[:, :2, 2], axis=1, keepdims=True)
        right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
        self._world = camera[:, :2, 3] + before[:, :1] * right + before[:, 1:] * ahead
        motion = np.gradient(self._world, axis=0)
        facing = gaussian_filter1d(motion, _TURN_S * _STEPS_HZ, axis=0, mode="nearest")
        self._headings_deg = np.rad2deg(np.unwrap(np.arctan2(facing[:, 0], -facing[:, 1])))
        self._walked_m = np.cumsum(np.linalg.norm(motion, axis=1))

    def at(self, time_s: float) -> tuple[Array, float]:
        """The pose T_world_person (4, 4), and the distance walked in the room in metres."""
        columns = (*self._world.T, self._headings_deg, self._walked_m)
        x, y, heading_deg, walked_m = (np.interp(time_s, self._times_s, c) for c in columns)
        return pose(x, y, 0.0, float(heading_deg)), float(walked_m)


def _closed(places: Places) -> CubicSpline:
    """The round as (x, y) of the distance along its chords."""
    points = np.array([*places, places[0]], float)
    knots = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    return CubicSpline(knots, points, bc_type="periodic")
