"""Frame tracking: predict, match the local map by projection, optimise the pose, judge it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bmask_slam.features.brisk import Features, joined, select
from bmask_slam.features.matching import Matches, WindowIndex, consistent_rotation, match_pairs
from bmask_slam.features.patch_alignment import register_patches
from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.tracking.config import TrackingConfig
from bmask_slam.tracking.guided_landmarks import Guided, weighted, with_guided, without_unused
from bmask_slam.tracking.pose.newcomers import Matched, moving_newcomers
from bmask_slam.tracking.pose.pose_optimisation import (
    PoseEstimate,
    PoseOptimisationConfig,
    optimise_pose,
)
from bmask_slam.tracking.pose.rolling_shutter import (
    CameraVelocity,
    PreviousPose,
    at_one_moment,
    corrected,
    motion_since,
)
from bmask_slam.tracking.results import Tracked, TrackingStatus, lost
from bmask_slam.world.landmark_table import LandmarkTable
from bmask_slam.world.world_map import WorldMap

COARSE_STEP = 1e-3
"""Tolerance of the first estimate in radians and metres: less than a pixel."""


class Tracker:
    """Tracks one frame against a map that the caller owns; keeps no state between frames."""

    def __init__(self, camera: Camera, config: TrackingConfig):
        self.camera = camera
        self.config = config
        self._narrow = replace(config.pose, kernel_widths=config.pose.kernel_widths[-2:])
        self._coarse = replace(config.pose, final_rounds=1, step_tolerance=COARSE_STEP)
        self._second = replace(self._narrow, final_rounds=1, step_tolerance=COARSE_STEP)

    def track(
        self,
        features: Features,
        T_predicted: Array,
        recent_ids: Ints,
        local_ids: Ints,
        world: WorldMap,
        previous: PreviousPose | None = None,
    ) -> Tracked:
        """The frame's pose from the landmarks of the last frame, then from the whole local map.

        The previous pose gives the camera's velocity, for a rolling shutter.
        """
        recent_ids = world.landmarks.remaining(recent_ids)
        motion = motion_since(previous, T_predicted, self.camera)
        estimate = self._first_estimate(
            at_one_moment(features, self.camera, motion),
            T_predicted,
            recent_ids,
            local_ids,
            world.landmarks,
        )
        if estimate is None:
            return lost(T_predicted, features)
        return self.refine(features, estimate.T_world_camera, local_ids, world, previous)

    def refine(
        self,
        features: Features,
        T_world_camera: Array,
        local_ids: Ints,
        world: WorldMap,
        previous: PreviousPose | None = None,
        guided: Guided | None = None,
    ) -> Tracked:
        """The pose from all landmarks of the local map, given a good initial one (4, 4).

        Guided landmarks that match no keypoint are measured where they were followed to.
        """
        landmarks, detected, radius_px = world.landmarks, features, self.config.local_radius_px
        if guided is not None:
            features = joined(features, guided.features)
        motion = motion_since(previous, T_world_camera, self.camera)
        still = at_one_moment(features, self.camera, motion)
        visible, matches = self.search(
            still, WindowIndex(still.pixels), T_world_camera, local_ids, radius_px, landmarks
        )
        if guided is not None:
            visible, matches = with_guided(visible, matches, guided)
        if self.config.subpixel.enabled:
            features = self._registered(
                features, matches.train, visible[matches.query], T_world_camera[:3, 3], world
            )
        features, loose = weighted(features, matches, guided, self.config.image_motion)

        def pose_by(some: Matches) -> tuple[Features, PoseEstimate]:
            return self._refined(features, some, visible, T_world_camera, landmarks, motion)

        seen, estimate, moving = self._without_moving(pose_by, matches, visible, world, previous)
        if not estimate.ok or estimate.inliers.sum() < self.config.weak_inliers:
            return lost(T_world_camera, detected, len(matches))
        found = self._result(seen, matches[~moving], visible, estimate, loose[~moving])
        found = replace(found, moving_ids=visible[matches.query[moving]])
        return without_unused(found, guided) if guided else found

    def _result(
        self,
        features: Features,
        matches: Matches,
        visible: Ints,
        estimate: PoseEstimate,
        loose: Mask,
    ) -> Tracked:
        """The frame with its pose; ``loose`` are the matches that rest on the flow alone."""
        kept, loose = matches[estimate.inliers], loose[estimate.inliers]
        agreed = (~loose).sum() >= self.config.min_inliers and 2 * len(kept) >= len(matches)
        certain = agreed and estimate.position_sigma_m <= self.config.max_sigma_m
        scale = estimate.noise_scale
        features = replace(features, sigmas_px=features.sigmas_px * [scale, scale, 1.0])
        return Tracked(
            status=TrackingStatus.OK if certain else TrackingStatus.WEAK,
            T_world_camera=estimate.T_world_camera,
            features=features,
            keypoints=kept.train,
            landmark_ids=visible[kept.query],
            matches=len(matches),
            visible_ids=visible,
            information=estimate.information,
            flow_only=visible[kept.query[loose]],
        )

    def _without_moving(
        self,
        pose_by: Callable[[Matches], tuple[Features, PoseEstimate]],
        matches: Matches,
        ids: Ints,
        world: WorldMap,
        previous: PreviousPose | None,
    ) -> tuple[Features, PoseEstimate, Mask]:
        """What ``pose_by`` gives without new landmarks that move, and which matches (N,) these are.

        Query numbers of the matches are positions in ``ids``.
        """
        found, estimate = pose_by(matches)
        moving = np.zeros(len(matches), bool)
        if previous is None or not estimate.ok:
            return found, estimate, moving
        matched = Matched.of(found, matches.train, ids[matches.query], previous.now_s, world)
        rules = self.config.newcomers, self._second
        moving = moving_newcomers(matched, estimate.T_world_camera, self.camera, *rules)
        if moving.any():
            found, estimate = pose_by(matches[~moving])
        return found, estimate, moving

    def _refined(
        self,
        features: Features,
        matches: Matches,
        ids: Ints,
        T_world_camera: Array,
        landmarks: LandmarkTable,
        motion: CameraVelocity | None,
    ) -> tuple[Features, PoseEstimate]:
        """The pose, and the features at one moment, by the motion estimated from them."""
        still = at_one_moment(features, self.camera, motion)
        estimate = self._optimise(still, matches, ids, T_world_camera, landmarks, self._narrow)
        if motion is None or not estimate.ok:
            return still, estimate
        kept = matches[estimate.inliers]
        points_world = landmarks.points_world[ids[kept.query]]
        seen = select(still, kept.train)
        motion = corrected(motion, estimate, points_world, seen, self.camera)
        still = at_one_moment(features, self.camera, motion)
        return still, self._optimise(
            still, matches, ids, estimate.T_world_camera, landmarks, self._narrow
        )

    def _registered(
        self,
        features: Features,
        keypoints: Ints,
        ids: Ints,
        centre_world: Array,
        world: WorldMap,
    ) -> Features:
        """The features with matched keypoints registered to the patches of their landmarks."""
        config = self.config.subpixel
        start = features.image_pixels[keypoints]
        patches, zooms = world.landmarks.nearest_patches(ids, centre_world, config.limits)
        refined, correlation = register_patches(
            features.gray, start, patches, config.iterations, zooms
        )
        shift = np.linalg.norm(refined - start, axis=1)
        limit = config.max_shift_px * np.sqrt(features.scales[keypoints])
        good = (correlation > config.min_correlation) & (shift < limit)
        rows = keypoints[good]
        image_pixels, pixels = features.image_pixels.copy(), features.pixels.copy()
        sigmas = features.sigmas_px.copy()
        image_pixels[rows] = refined[good]
        pixels[rows] = self.camera.undistort(refined[good])
        usual, followed = config.sigma_px, self.config.image_motion
        guided = sigmas[rows, 0] >= followed.sigma_px
        sigmas[rows, :2] = np.where(guided, followed.patch_sigma_px, usual)[:, None]
        return replace(features, image_pixels=image_pixels, pixels=pixels, sigmas_px=sigmas)

    def search(
        self,
        features: Features,
        index: WindowIndex,
        T_world_camera: Array,
        ids: Ints,
        radius_px: float,
        landmarks: LandmarkTable,
    ) -> tuple[Ints, Matches]:
        """Landmarks in view and their matches (query: position among those, train: keypoint).

        A landmark is in view if it projects into the image, and is seen from within
        ``max_view_angle_deg`` of the direction it was last seen from. The window grows with the
        keypoint's scale; keypoints of another scale than predicted are not candidates.
        """
        ids, pixels, z = self.in_view(T_world_camera, ids, landmarks)
        scale = np.maximum(landmarks.extent[ids] / z, 1.0)
        query, train = index.pairs(pixels, radius_px * np.minimum(np.sqrt(scale), 3.0))
        ratio = features.scales[train] / scale[query]
        limit = self.config.match.max_scale_ratio
        fits = (ratio < limit) & (ratio > 1 / limit)
        pairs = (query[fits], train[fits])
        tables = (landmarks.descriptors[ids], features.descriptors)
        matches = match_pairs(pairs, tables, self.config.match)
        tolerance = self.config.match.max_angle_rad
        if tolerance is None:
            return ids, matches
        turn = features.angles_rad[matches.train] - landmarks.angles_rad[ids[matches.query]]
        return ids, consistent_rotation(matches, turn, tolerance)

    def in_view(
        self, T_world_camera: Array, ids: Ints, landmarks: LandmarkTable
    ) -> tuple[Ints, Array, Array]:
        """Those of the landmarks that are in view, their pixels (N, 2) and z-depths (N,) in m."""
        camera, points_world = self.camera, landmarks.points_world[ids]
        points_camera = transform(inverse(T_world_camera), points_world)
        front = np.flatnonzero(points_camera[:, 2] > 0.1)
        points_camera = points_camera[front]
        pixels = camera.project(points_camera)
        u, v = pixels.T
        inside = (u > 0) & (u < camera.width - 1) & (v > 0) & (v < camera.height - 1)
        rows = front[inside]
        towards = T_world_camera[:3, 3] - points_world[rows]
        distance = np.sqrt(np.einsum("ij,ij->i", towards, towards))
        along = np.einsum("ij,ij->i", towards, landmarks.directions[ids[rows]])
        seen = along > np.cos(np.deg2rad(self.config.max_view_angle_deg)) * distance
        chosen = np.flatnonzero(inside)[seen]
        return ids[rows[seen]], pixels[chosen], points_camera[chosen, 2]

    def _first_estimate(
        self,
        features: Features,
        T_predicted: Array,
        recent_ids: Ints,
        local_ids: Ints,
        landmarks: LandmarkTable,
    ) -> PoseEstimate | None:
        """A pose near the prediction, from the last frame's landmarks or from the local map."""
        index = WindowIndex(features.pixels)
        near, wide = self.config.search_radius_px, self.config.wide_radius_px
        for ids, radius in ((recent_ids, near), (local_ids, near), (local_ids, wide)):
            visible, matches = self.search(features, index, T_predicted, ids, radius, landmarks)
            estimate = self._optimise(
                features, matches, visible, T_predicted, landmarks, self._coarse
            )
            if estimate.ok and estimate.inliers.sum() >= self.config.weak_inliers:
                return estimate
        return None

    def _optimise(
        self,
        features: Features,
        matches: Matches,
        ids: Ints,
        T_world_camera: Array,
        landmarks: LandmarkTable,
        config: PoseOptimisationConfig,
    ) -> PoseEstimate:
        return optimise_pose(
            T_world_camera,
            landmarks.points_world[ids[matches.query]],
            features.measurements[matches.train],
            features.sigmas_px[matches.train],
            self.camera,
            config,
        )
