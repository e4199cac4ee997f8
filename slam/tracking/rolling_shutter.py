"""Rolling shutter: keypoints moved to where they are at one moment, and the camera's velocity.

An image whose rows are exposed one after the other, top first, shows each row from another pose of
a camera that moves. To first order a row that is exposed t later than another is seen from
``T_world_camera @ se3_exp(t * twist)``. The moment that stands for the image is that of the mean
row of its keypoints: then an error of the velocity moves them apart, but not all one way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, se3_log
from bmask_slam.tracking.pose_optimisation import PoseEstimate, jacobian, residuals

ACCELERATION = 2.0
"""By how much a hand's velocity changes, in rad/s and m/s each second: a standard deviation."""
FAR_M = 1e6


@dataclass(frozen=True)
class PreviousPose:
    """Where the camera was: T_world_camera (4, 4), and how many seconds before the image."""

    T_world_camera: Array
    ago_s: float


@dataclass(frozen=True)
class Motion:
    """The camera's velocity in its own frame: twist (6,) [rad/s, m/s], standard deviation."""

    twist: Array
    sigma: float


def motion_since(
    previous: PreviousPose | None, T_world_camera: Array, camera: Camera
) -> Motion | None:
    """The mean motion from a pose to another; None where it is unknown or does not matter."""
    if previous is None or camera.rolling_shutter_s == 0:
        return None
    between = inverse(previous.T_world_camera) @ T_world_camera
    return Motion(se3_log(between) / previous.ago_s, ACCELERATION * previous.ago_s)


def share_of_rows(rows: Array, camera: Camera) -> Array:
    """By what share (N,) of the image, from -1/2 to 1/2, rows (N,) lie below its middle."""
    return (rows + 0.5) / camera.height - 0.5


def exposed_after_s(rows: Array, camera: Camera) -> Array:
    """How many seconds (N,) after the image's middle its rows (N,) are exposed."""
    return camera.rolling_shutter_s * share_of_rows(rows, camera)


def velocities(points_camera: Array, twist: Array) -> Array:
    """Velocities (N, 3) in m/s of still points (N, 3) in the frame of a camera that moves.

    With angular velocity w and velocity v, twist (6,) or (N, 6), this is - w x p - v.
    """
    return -np.cross(twist[..., :3], points_camera) - twist[..., 3:]


def at_one_moment(features: Features, camera: Camera, motion: Motion | None) -> Features:
    """The features as a camera that exposes all rows at once would have them.

    Where depth is missing the keypoint moves as at the median depth.
    """
    if motion is None or len(features) == 0:
        return features
    later_s = _after_mean_row_s(features, camera)
    known = np.isfinite(features.depth_m)
    usual_m = np.median(features.depth_m[known]) if known.any() else FAR_M
    points = camera.backproject(features.pixels, np.where(known, features.depth_m, usual_m))
    points = points - later_s[:, None] * velocities(points, motion.twist)
    depth_m = np.where(known, points[:, 2], np.nan)
    return replace(
        features,
        pixels=camera.project(points),
        depth_m=depth_m,
        disparity_px=camera.stereo_bf_px_m / depth_m,
    )


def corrected(
    motion: Motion, estimate: PoseEstimate, points_world: Array, seen: Features, camera: Camera
) -> Motion:
    """The motion that the landmarks themselves tell, with what was known of it as a prior.

    ``seen`` are N inliers of an estimate, at one moment by that motion, of landmarks (N, 3). A
    pose tangent x and an error d of the twist leave r + J x + t J d of their residuals r, for rows
    exposed t after the mean one.
    """
    measured = seen.measurements
    known = np.isfinite(measured)
    r, points_camera = residuals(
        estimate.T_world_camera, points_world, np.where(known, measured, 0.0), camera
    )
    noise = np.array([estimate.noise_scale, estimate.noise_scale, 1.0])
    weight = np.where(known, 1 / (seen.sigmas_px * noise), 0.0)
    J_pose = jacobian(points_camera, camera) * weight[..., None]
    later_s = _after_mean_row_s(seen, camera)
    J = np.concatenate([J_pose, later_s[:, None, None] * J_pose], axis=2).reshape(-1, 12)
    H = J.T @ J + np.diag(np.repeat([0.0, motion.sigma**-2], 6))
    step = -np.linalg.solve(H, J.T @ (r * weight).ravel())
    return replace(motion, twist=motion.twist + step[6:])


def _after_mean_row_s(features: Features, camera: Camera) -> Array:
    later_s = exposed_after_s(features.image_pixels[:, 1], camera)
    return later_s - later_s.mean()
