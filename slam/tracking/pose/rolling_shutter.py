"""Rolling shutter: keypoints moved to where they are at one moment, and the camera's velocity.

If the rows of an image are exposed one after the other, top first, a moving camera sees each row
from another pose. To first order a row that is exposed t later than another is seen from
``T_world_camera @ se3_exp(t * twist)``. All keypoints are referred to the time of
their mean row: an error of the velocity then has no mean effect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, se3_log
from bmask_slam.tracking.pose.pose_optimisation import PoseEstimate, jacobian, median, residuals

ACCELERATION = 2.0
"""Standard deviation of the acceleration of a hand-held camera, in rad/s^2 and m/s^2."""
FAR_M = 1e6


@dataclass(frozen=True)
class PreviousPose:
    """An earlier pose: T_world_camera (4, 4), and how many seconds before the image it was.

    Attributes:
        now_s: the image's stamp.
    """

    T_world_camera: Array
    ago_s: float
    now_s: float

    def twist_to(self, T_world_camera: Array) -> Array:
        """The mean velocity (6,) from it to the image's pose (4, 4)."""
        return se3_log(inverse(self.T_world_camera) @ T_world_camera) / self.ago_s


@dataclass(frozen=True)
class CameraVelocity:
    """The camera's velocity in its own frame: twist (6,) in rad/s and m/s, and its sigma."""

    twist: Array
    sigma: float


def motion_since(
    previous: PreviousPose | None, T_world_camera: Array, camera: Camera
) -> CameraVelocity | None:
    """The mean motion from a pose to another; None if unknown, or with a global shutter."""
    if previous is None or camera.rolling_shutter_s == 0:
        return None
    return CameraVelocity(previous.twist_to(T_world_camera), ACCELERATION * previous.ago_s)


def velocities(points_camera: Array, twist: Array) -> Array:
    """Velocities (N, 3) in m/s of static points (N, 3) in the frame of a moving camera.

    With angular velocity w and velocity v, twist (6,) or (N, 6), this is - w x p - v.
    """
    (x, y, z), (a, b, c) = points_camera.T, twist.T[:3]
    turning = np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=1)
    return -turning - twist[..., 3:]


def at_one_moment(features: Features, camera: Camera, motion: CameraVelocity | None) -> Features:
    """The features as seen by a camera that exposes all rows at once.

    Keypoints without depth are corrected with the median depth.
    """
    if motion is None or len(features) == 0:
        return features
    later_s = after_mean_row_s(features, camera)
    known = np.isfinite(features.depth_m)
    usual_m = median(features.depth_m[known]) if known.any() else FAR_M
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
    motion: CameraVelocity,
    estimate: PoseEstimate,
    points_world: Array,
    seen: Features,
    camera: Camera,
) -> CameraVelocity:
    """The motion estimated from landmarks, with the previous estimate as a prior.

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
    later_s = after_mean_row_s(seen, camera)
    J = np.concatenate([J_pose, later_s[:, None, None] * J_pose], axis=2).reshape(-1, 12)
    H = J.T @ J + np.diag(np.repeat([0.0, motion.sigma**-2], 6))
    step = -np.linalg.solve(H, J.T @ (r * weight).ravel())
    return replace(motion, twist=motion.twist + step[6:])


def after_mean_row_s(features: Features, camera: Camera) -> Array:
    """Seconds (N,) from the exposure of the keypoints' mean row to that of each."""
    later_s = camera.exposed_after_s(features.image_pixels[:, 1])
    return later_s - later_s.mean()
