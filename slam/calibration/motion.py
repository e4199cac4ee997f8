"""Motion of landmarks in the images of a run's keyframes, to calibrate a rolling shutter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.graph.geometry import inverse, se3_log, transform
from bmask_slam.graph.trajectory import Trajectory, nearest_indices
from bmask_slam.run_folder.map_file import SavedRun
from bmask_slam.tracking.pose.rolling_shutter import velocities

MAX_LATE_S, MAX_GAP_S = 1e-3, 0.11
MIN_DEPTH_M = 0.1


@dataclass(frozen=True, eq=False)
class LandmarkVelocities:
    """Observed landmarks in the frames of the keyframes that observe them.

    Attributes:
        points: (M, 3) in metres.
        velocities: (M, 3) in m/s, caused by the camera's motion.
    """

    points: Array
    velocities: Array


def twists_at(path: Trajectory, stamps_s: Array) -> Array:
    """Velocities (N, 6) [rad/s, m/s] of a camera in its own frame, from the poses before and after.

    At an end of the path, or beside a gap, the pose itself takes the place of the one that is
    missing. Zero where the path has no pose at a stamp (N,), or none near before and after it.
    """
    T, times_s = path.poses_world_camera, path.timestamps_s
    at = nearest_indices(times_s, stamps_s)
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, len(path) - 1)
    before = np.where(times_s[at] - times_s[before] < MAX_GAP_S, before, at)
    after = np.where(times_s[after] - times_s[at] < MAX_GAP_S, after, at)
    known = (np.abs(times_s[at] - stamps_s) < MAX_LATE_S) & (after > before)
    step_s = np.where(known, times_s[after] - times_s[before], 1.0)
    motions = se3_log(inverse(T[before]) @ T[after])
    return np.where(known[:, None], motions / step_s[:, None], 0.0)


def landmark_motion(observations: Observations, run: SavedRun) -> LandmarkVelocities:
    """The motion of the observed static landmarks by the run's trajectory."""
    keyframes, rows = np.unique(observations.keyframe_ids, return_inverse=True)
    stamps_s = run.keyframe_stamps_s[np.searchsorted(run.tables.keyframes.ids, keyframes)]
    twists = twists_at(run.trajectories["trajectory.txt"], stamps_s)
    T_camera_world = inverse(run.tables.keyframes.get(keyframes))[rows]
    points_world = run.tables.landmarks.get(observations.landmark_ids)
    points = transform(T_camera_world, points_world[:, None])[:, 0]
    return LandmarkVelocities(points, velocities(points, twists[rows]))


def as_exposed(pixels: Array, motion: LandmarkVelocities, camera: Camera) -> Array:
    """Undistorted pixels (M, 2) in the image as exposed, of pixels corrected to one moment.

    This undoes the rolling-shutter correction of tracking.
    """
    if camera.rolling_shutter_s == 0:
        return pixels
    later_s = camera.exposed_after_s(pixels[:, 1])[:, None]
    in_front = motion.points[:, 2:] > MIN_DEPTH_M
    points = np.where(in_front, motion.points, [0.0, 0.0, 1.0])
    moved = camera.project(points + later_s * motion.velocities) - camera.project(points)
    return pixels + np.where(in_front, moved, 0.0)
