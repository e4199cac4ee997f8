"""How what a run's keyframes see moves in their images, for calibrating a rolling shutter."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.graph.geometry import inverse, se3_log, transform
from bmask_slam.graph.trajectory import Trajectory, nearest_indices
from bmask_slam.run_folder.map_file import SavedRun
from bmask_slam.tracking.rolling_shutter import exposed_after_s, velocities

MAX_LATE_S, MAX_STEP_S = 1e-3, 0.2
MIN_DEPTH_M = 0.1


def twists_at(path: Trajectory, stamps_s: Array) -> Array:
    """Velocities (N, 6) [rad/s, m/s] of a camera in its own frame, by the poses before and after.

    Zero where the path has no pose at a stamp (N,), or none near before or after it.
    """
    at = nearest_indices(path.timestamps_s, stamps_s)
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, len(path) - 1)
    T, step_s = path.poses_world_camera, path.timestamps_s[after] - path.timestamps_s[before]
    told = (np.abs(path.timestamps_s[at] - stamps_s) < MAX_LATE_S) & (step_s < MAX_STEP_S)
    told &= after - before == 2
    motions = se3_log(inverse(T[before]) @ T[after])
    return np.where(told[:, None], motions / np.where(told, step_s, 1.0)[:, None], 0.0)


def seen_motion(seen: Observations, run: SavedRun) -> tuple[Array, Array]:
    """Landmarks (M, 3) in the frames of the keyframes that see them, and their velocities (M, 3).

    In metres and m/s, of still landmarks, by the run's trajectory.
    """
    keyframes, rows = np.unique(seen.keyframe_ids, return_inverse=True)
    stamps_s = run.keyframe_stamps_s[np.searchsorted(run.tables.keyframes.ids, keyframes)]
    twists = twists_at(run.trajectories["trajectory.txt"], stamps_s)
    T_camera_world = inverse(run.tables.keyframes.get(keyframes))[rows]
    points_world = run.tables.landmarks.get(seen.landmark_ids)
    points = transform(T_camera_world, points_world[:, None])[:, 0]
    return points, velocities(points, twists[rows])


def as_exposed(pixels: Array, motion: tuple[Array, Array], camera: Camera) -> Array:
    """Undistorted pixels (M, 2) as the image has them, of ones that tracking took to one moment."""
    if camera.rolling_shutter_s == 0:
        return pixels
    points, velocity = motion
    later_s = exposed_after_s(pixels[:, 1], camera)[:, None]
    in_front = points[:, 2:] > MIN_DEPTH_M
    points = np.where(in_front, points, [0.0, 0.0, 1.0])
    moved = camera.project(points + later_s * velocity) - camera.project(points)
    return pixels + np.where(in_front, moved, 0.0)
