"""A synthetic room: cameras on a circle looking in, points all around, exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, transform

CAMERA = Camera(640, 480, fx=525.0, fy=520.0, cx=318.5, cy=241.5)


@dataclass(frozen=True)
class Room:
    """Truth, measurements, and noisy initial values (the first pose is exact)."""

    poses_world_camera: Array
    points_world: Array
    observations: Observations
    initial_poses: Array
    initial_points: Array

    def update_of(self, keyframe: int) -> GraphUpdate:
        """The update of this keyframe with the landmarks that it is the first to observe."""
        observations = self.observations
        rows = np.flatnonzero(observations.keyframe_ids == keyframe)
        earlier = observations.landmark_ids[observations.keyframe_ids < keyframe]
        new = np.setdiff1d(observations.landmark_ids[rows], earlier)
        return GraphUpdate(
            np.array([keyframe]),
            self.initial_poses[[keyframe]],
            new,
            self.initial_points[new],
            observations.select(rows),
        )

    def updates(self) -> list[GraphUpdate]:
        """One update a keyframe, in order."""
        return [self.update_of(k) for k in range(len(self.poses_world_camera))]

    def moved(self, T_new_old: Array) -> Room:
        """The same room and measurements in another world frame."""
        return Room(
            T_new_old @ self.poses_world_camera,
            transform(T_new_old, self.points_world),
            self.observations,
            T_new_old @ self.initial_poses,
            transform(T_new_old, self.initial_points),
        )


def make_room(
    keyframes: int = 12,
    points: int = 120,
    noise_px: float = 0.0,
    mono_share: float = 0.0,
    seed: int = 0,
    disparity_noise_px: float | None = None,
) -> Room:
    """A room with this pixel noise in u, v and disparity; sigmas 1 px where it is zero.

    ``disparity_noise_px`` gives the disparity a noise of its own.
    """
    sigmas_px = np.array([noise_px, noise_px, noise_px])
    if disparity_noise_px is not None:
        sigmas_px[2] = disparity_noise_px
    rng = np.random.default_rng(seed)
    poses = circle(np.arange(keyframes))
    points_world = rng.uniform([-2.0, -1.2, -2.0], [2.0, 1.2, 2.0], (points, 3))
    keyframe_ids, landmark_ids, measurements = _measure(poses, points_world)
    measurements = noisy(measurements, rng.normal(0, 1, measurements.shape) * sigmas_px)
    measurements[rng.random(len(measurements)) < mono_share, 2] = np.nan
    disturbed = poses @ se3_exp(rng.normal(0, [0.001] * 3 + [0.005] * 3, (keyframes, 6)))
    disturbed[0] = poses[0]
    return Room(
        poses,
        points_world,
        Observations(
            keyframe_ids,
            landmark_ids,
            measurements,
            np.tile(np.where(sigmas_px > 0, sigmas_px, 1.0), (len(measurements), 1)),
        ),
        disturbed,
        points_world + rng.normal(0, 0.01, points_world.shape),
    )


def noisy(measurements: Array, noise_px: Array) -> Array:
    """Measurements (M, 3) ``(u_left, v, u_right)`` with noise (M, 3) of u, v and disparity.

    The right image is virtual: u_right = u_left_noisy - (disparity + disparity noise).
    """
    u_left, v, u_right = measurements.T
    u_noisy = u_left + noise_px[:, 0]
    disparity = (u_left - u_right) + noise_px[:, 2]
    return np.stack([u_noisy, v + noise_px[:, 1], u_noisy - disparity], axis=1)


def circle(keyframes: NDArray[Any]) -> Array:
    """Poses (N, 4, 4) of the keyframes (N,) on a circle, or between them; y down.

    They are 3.5 m from the middle, 11 degrees apart, and look at it.
    """
    angle = np.radians(11.0) * keyframes
    centre = 3.5 * np.stack([np.sin(angle), 0.1 * np.cos(3 * angle), -np.cos(angle)], axis=1)
    z = -centre / np.linalg.norm(centre, axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return make_pose(np.stack([x, np.cross(z, x), z], axis=2), centre)


def _measure(poses: Array, points_world: Array) -> tuple[Array, Array, Array]:
    points_camera = transform(inverse(poses), points_world)
    z = CAMERA.project_stereo(points_camera)
    inside = (points_camera[..., 2] > 0.5) & (z[..., 0] > 0) & (z[..., 0] < CAMERA.width)
    inside &= (z[..., 1] > 0) & (z[..., 1] < CAMERA.height)
    keyframe_ids, landmark_ids = np.nonzero(inside)
    return keyframe_ids, landmark_ids, z[inside]
