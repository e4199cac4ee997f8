"""What holds a variable: one stereo view, or two views with parallax; loose covariances."""

from __future__ import annotations

import numpy as np

from graph.geometry import Array
from graph.updates import IntArray, Observations


def constrained_landmarks(
    observations: Observations,
    poses_world_camera: Array,
    points_world: Array,
    min_parallax_deg: float,
) -> IntArray:
    """Sorted ids of the landmarks that these observations alone constrain.

    ``poses_world_camera`` (M, 4, 4) and ``points_world`` (M, 3) belong to the observations row
    by row, in any order. The parallax is the angle between the ray from a landmark's first
    keyframe and any other: at least half of the largest angle between any two.
    """
    stereo = np.isfinite(observations.measurements[:, 2])
    by_stereo = np.unique(observations.landmark_ids[stereo])
    rows = np.flatnonzero(~np.isin(observations.landmark_ids, by_stereo))
    if not len(rows):
        return by_stereo
    rows = rows[np.lexsort((observations.keyframe_ids[rows], observations.landmark_ids[rows]))]
    ids, first, group = np.unique(
        observations.landmark_ids[rows], return_index=True, return_inverse=True
    )
    rays = points_world[rows] - poses_world_camera[rows, :3, 3]
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    between = np.linalg.norm(np.cross(rays, rays[first][group]), axis=1)
    angle_rad = np.arctan2(between, np.sum(rays * rays[first][group], axis=1))
    widest_rad = np.maximum.reduceat(angle_rad, first)
    return np.union1d(by_stereo, ids[widest_rad >= np.radians(min_parallax_deg)])


def diagonal_covariance(sigma_rotation_rad: float, sigma_translation_m: float) -> Array:
    """A (6, 6) covariance with equal sigmas for the three rotations and the three shifts."""
    return np.diag([sigma_rotation_rad**2] * 3 + [sigma_translation_m**2] * 3)
