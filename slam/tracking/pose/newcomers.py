"""New landmarks that move against those that were there before: no pose is built on them.

Somebody who walks into the image may show more corners than the room behind him, in space that no
earlier view saw. His landmarks are new, and agree with each other better than with the room. So the
landmarks that are known for longer are asked alone: where many of the new ones have left their
places by the pose that these give, and faster than the errors of a map grow, the new ones move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.tracking.pose.pose_optimisation import (
    PoseEstimate,
    PoseOptimisationConfig,
    jacobian,
    optimise_pose,
    residuals,
)
from bmask_slam.world.world_map import WorldMap


@dataclass(frozen=True)
class NewcomerConfig:
    """When new landmarks move against older ones.

    Attributes:
        new_s: a landmark is new for so long after the keyframe that made it.
        min_older: so many inliers among the older ones, half of their matches, give a pose.
        max_sigma_m: largest standard deviation of the position by them.
        gate: a new one has left its place if it is farther off in the image, in variances a degree
            of freedom, ...
        min_speed_m_s: ... and farther than at this speed since its keyframe.
        min_moving: new landmarks move if so many of them have left their places ...
        min_share: ... and this share of the new ones.
    """

    new_s: float = 0.3
    min_older: int = 15
    max_sigma_m: float = 0.03
    gate: float = 6.0
    min_speed_m_s: float = 0.2
    min_moving: int = 15
    min_share: float = 0.25

    def __post_init__(self) -> None:
        if self.new_s < 0 or min(self.gate, self.min_speed_m_s, self.max_sigma_m) <= 0:
            raise ValueError(
                "new_s must not be negative, gate, min_speed_m_s and max_sigma_m positive"
            )
        if min(self.min_older, self.min_moving) < 1 or not 0 <= self.min_share <= 1:
            raise ValueError("min_older and min_moving must be at least 1, min_share in [0, 1]")


@dataclass(frozen=True, eq=False)
class Matched:
    """N landmarks that are matched in a frame.

    Attributes:
        points_world: (N, 3) m.
        measurements: (N, 3) u, v, disparity in undistorted pixels; disparity NaN: monocular.
        sigmas_px: (N, 3) their standard deviations.
        ages_s: (N,) seconds for which the landmarks are known.
    """

    points_world: Array
    measurements: Array
    sigmas_px: Array
    ages_s: Array

    @classmethod
    def of(
        cls, features: Features, keypoints: Ints, ids: Ints, now_s: float, world: WorldMap
    ) -> Matched:
        """Landmarks (N,) that are observed by keypoints (N,) of a frame.

        A landmark is as old as its host: the keyframe that made it, or that one's parent once it
        was culled. One whose host is of an earlier recording with later stamps was always known.
        """
        hosts, place = np.unique(world.landmarks.host[ids], return_inverse=True)
        keyframes = [world.keyframes.get(int(host)) for host in hosts]
        known_s = np.array([np.inf if k is None else now_s - k.timestamp_s for k in keyframes])
        known_s[known_s < 0] = np.inf
        measured = features.measurements[keypoints], features.sigmas_px[keypoints]
        return cls(world.landmarks.points_world[ids], *measured, known_s[place])

    def __getitem__(self, chosen: Mask) -> Matched:
        """Some of them."""
        return Matched(*(column[chosen] for column in vars(self).values()))


def moving_newcomers(
    matched: Matched,
    T_world_camera: Array,
    camera: Camera,
    config: NewcomerConfig,
    pose: PoseOptimisationConfig,
) -> Mask:
    """Which matches (N,) are of new landmarks that have left their places; none unless many have.

    The pose by older ones is found with the rules ``pose``, from that by all, T_world_camera
    (4, 4).
    """
    moving = np.zeros(len(matched.ages_s), bool)
    new = matched.ages_s <= config.new_s
    if new.sum() < config.min_moving or (~new).sum() < config.min_older:
        return moving
    known = matched[~new]
    seen = known.points_world, known.measurements, known.sigmas_px
    older = optimise_pose(T_world_camera, *seen, camera, pose)
    count = older.inliers.sum()
    agree = older.ok and count >= config.min_older and 2 * count >= len(older.inliers)
    if agree and older.position_sigma_m <= config.max_sigma_m:
        moving[new] = _have_left(matched[new], older, camera, config)
    is_many = moving.sum() >= max(config.min_moving, config.min_share * new.sum())
    return moving & is_many


def _have_left(
    matched: Matched, older: PoseEstimate, camera: Camera, config: NewcomerConfig
) -> Mask:
    """Which landmarks (N,) are not where they were, by a pose and its own uncertainty."""
    off, points_camera = residuals(
        older.T_world_camera, matched.points_world, matched.measurements, camera
    )
    off_px, J = off[:, :2], jacobian(points_camera, camera)[:, :2]
    variance = J @ np.linalg.inv(older.information) @ J.transpose(0, 2, 1)
    # twice: a new landmark is where one keyframe measured it
    variance[:, [0, 1], [0, 1]] += 2 * (older.noise_scale * matched.sigmas_px[:, :2]) ** 2
    chi2 = np.einsum("ni,nij,nj->n", off_px, np.linalg.inv(variance), off_px)
    off_m = np.hypot(*(off_px / [camera.fx, camera.fy]).T) * points_camera[:, 2]
    is_fast = off_m > config.min_speed_m_s * matched.ages_s
    return np.asarray(is_fast & (chi2 > 2 * config.gate))
