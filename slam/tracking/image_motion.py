"""The camera's motion from one image to the next, by optical flow, where features may not match.

In a blurred image few corners are found, and their descriptors change; a fast turn takes them out
of the windows in which they are searched. The flow of the last frame's corners (pyramidal
Lucas-Kanade: Bouguet 2000; OpenCV's) needs neither: the corners of the last frame have depth, so
that their pixels in the new image give its pose relative to the last one. The map is searched from
there.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Bytes, Image, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.tracking.pose.pose_optimisation import (
    PoseEstimate,
    PoseOptimisationConfig,
    median,
    optimise_pose,
)
from bmask_slam.world.landmark_table import LandmarkTable

SHRUNK = 2
"""Flow is computed in images smaller by this factor: half the time, twice the reach."""

MIN_DEPTH_M = 0.1


@dataclass(frozen=True)
class ImageMotionConfig:
    """When the flow is computed, of how many corners, and what counts as followed.

    It is computed where the last frame was ``surprise_px`` away from where constant velocity had
    expected it, and where the last frame or this one has fewer than ``few_inliers``. A corner is
    followed if the flow back ends within ``round_trip_px`` of it, and until its standard deviation,
    which grows by ``sigma_px`` a frame, is ``max_sigma_px``; that of a landmark begins anew, at
    ``patch_sigma_px``, where its patch is found. What the flow alone shows has together the weight
    of the frame's other matches, or of ``least_weight`` points. ``window_px`` and ``levels`` are of
    the pyramid of the half-size image, the other pixels of the full image.
    """

    enabled: bool = True
    surprise_px: float = 10.0
    few_inliers: int = 120
    corners: int = 250
    window_px: int = 13
    levels: int = 3
    round_trip_px: float = 1.0
    sigma_px: float = 1.5
    patch_sigma_px: float = 0.5
    max_sigma_px: float = 8.0
    least_weight: int = 15
    min_inliers: int = 20
    max_ago_s: float = 0.5
    pose: PoseOptimisationConfig = field(
        default_factory=lambda: PoseOptimisationConfig(final_rounds=1, step_tolerance=1e-3)
    )

    def __post_init__(self) -> None:
        if self.window_px < 3:  # OpenCV's limit
            raise ValueError("window_px must be at least 3")


@dataclass(frozen=True, eq=False)
class LastView:
    """What the last tracked frame saw, N keypoints.

    Attributes:
        gray: (H / 2, W / 2) uint8.
        image_pixels: (N, 2) in the image as it is.
        points_camera: (N, 3) m, in the frame's camera.
        landmark_ids: (N,) those that they observe, -1 for none.
        sigmas_px: (N,) standard deviations of the pixels.
        inliers: number of landmarks that it was tracked with.
    """

    gray: Image
    image_pixels: Array
    points_camera: Array
    landmark_ids: Ints
    sigmas_px: Array
    inliers: int


def nothing_seen() -> LastView:
    """The view of a camera that has not tracked a frame."""
    none = np.zeros((0, 3))
    empty = np.zeros((0, 0), np.uint8)
    return LastView(empty, none[:, :2], none, np.zeros(0, np.int64), none[:, 0], 0)


def thinned(rows: Ints, count: int) -> Ints:
    """Up to a number of rows, at equal steps."""
    if len(rows) <= count:
        return rows
    return rows[np.linspace(0, len(rows) - 1, count).astype(int)]


def shrunk(gray: Image) -> Image:
    """An image (H, W) at half its size."""
    height, width = gray.shape
    return cv2.resize(gray, (width // SHRUNK, height // SHRUNK), interpolation=cv2.INTER_AREA)


@dataclass(frozen=True, eq=False)
class Followed:
    """M corners of the last frame that were found in the new one.

    Attributes:
        rows: (M,) of the last view.
        image_pixels: (M, 2) where they are now.
        sigmas_px: (M,) standard deviations of these pixels.
        estimate: the pose of the new camera in the last one's frame, and which of them fit it.
    """

    rows: Ints
    image_pixels: Array
    sigmas_px: Array
    estimate: PoseEstimate


class ImageMotion:
    """Estimates the motion between two images of a camera; keeps no state between frames."""

    def __init__(self, camera: Camera, config: ImageMotionConfig) -> None:
        self.camera = camera
        self.config = config

    def surprise_px(self, seen: LastView, T_predicted: Array, T_world_camera: Array) -> float:
        """The median distance at which the corners of a view were expected, from where they are.

        The poses (4, 4) of its camera are the predicted and the true one.
        """
        there = seen.points_camera
        expected = transform(inverse(T_predicted) @ T_world_camera, there)
        front = (expected[:, 2] > MIN_DEPTH_M) & (there[:, 2] > MIN_DEPTH_M)
        if not front.any():
            return 0.0
        apart = self.camera.project(expected[front]) - self.camera.project(there[front])
        return median(np.linalg.norm(apart, axis=1))

    def view(
        self,
        features: Features,
        landmark_ids: Ints,
        T_world_camera: Array,
        landmarks: LandmarkTable,
    ) -> LastView:
        """What a tracked frame saw, for the next one.

        ``landmark_ids`` (N,) are those of the features, -1 for none. Landmarks are taken first.
        """
        known = np.flatnonzero(landmark_ids >= 0)
        inliers = len(known)
        known = thinned(known[landmarks.in_map[landmark_ids[known]]], self.config.corners)
        deep = np.flatnonzero((landmark_ids < 0) & np.isfinite(features.depth_m))
        deep = thinned(deep, self.config.corners - len(known))
        points_world = landmarks.points_world[landmark_ids[known]]
        rows = np.concatenate([known, deep])
        points = np.concatenate(
            [
                transform(inverse(T_world_camera), points_world),
                self.camera.backproject(features.pixels[deep], features.depth_m[deep]),
            ]
        )
        return LastView(
            shrunk(features.gray),
            features.image_pixels[rows],
            points,
            landmark_ids[rows],
            features.sigmas_px[rows, 0],
            inliers,
        )

    def follow(
        self, last: LastView, features: Features, T_last_next: Array, ago_s: float
    ) -> Followed | None:
        """The corners of the last view in a frame, and its pose; None if there are too few.

        T_last_next (4, 4) is the expected motion, at which the search begins; the last view is
        ``ago_s`` older than the frame.
        """
        points = last.points_camera
        if len(points) < self.config.min_inliers or not last.gray.size:
            return None
        ahead = transform(inverse(T_last_next), points)
        ahead[:, 2] = np.maximum(ahead[:, 2], MIN_DEPTH_M)
        start = self.camera.project_distorted(ahead)
        found, kept = self._flow(last, shrunk(features.gray), start)
        sigmas_px = np.hypot(last.sigmas_px[kept], self.config.sigma_px)
        certain = sigmas_px < self.config.max_sigma_px
        found, kept, sigmas_px = found[certain], kept[certain], sigmas_px[certain]
        if len(kept) < self.config.min_inliers:
            return None
        pixels = self.camera.undistort(found)
        if self.camera.rolling_shutter_s and ago_s > 0:
            # A row exposed s intervals later than the middle one shows 1 + s times the motion.
            before = self.camera.project(points[kept])
            share = self.camera.share_of_rows(found[:, 1])
            later = share * self.camera.rolling_shutter_s / ago_s
            pixels = before + (pixels - before) / (1 + later)[:, None]
        measured = np.column_stack([pixels, np.full(len(kept), np.nan)])
        sigmas = np.repeat(sigmas_px[:, None], 3, axis=1)
        estimate = optimise_pose(
            T_last_next, points[kept], measured, sigmas, self.camera, self.config.pose
        )
        if not estimate.ok or estimate.inliers.sum() < self.config.min_inliers:
            return None
        return Followed(kept, found, sigmas_px, estimate)

    def _flow(self, last: LastView, gray: Bytes, start: Array) -> tuple[Array, Ints]:
        """Pixels (M, 2) of the last view's corners in a half-size image, and their rows (M,)."""
        config = self.config
        side = (config.window_px, config.window_px)
        options = {"winSize": side, "maxLevel": config.levels}
        before = ((last.image_pixels + 0.5) / SHRUNK - 0.5).astype(np.float32)
        guess = ((start + 0.5) / SHRUNK - 0.5).astype(np.float32)
        flag = cv2.OPTFLOW_USE_INITIAL_FLOW
        after, found, _ = cv2.calcOpticalFlowPyrLK(
            last.gray, gray, before, guess.copy(), flags=flag, **options
        )
        back, again, _ = cv2.calcOpticalFlowPyrLK(
            gray, last.gray, after, before.copy(), flags=flag, **options
        )
        near = np.linalg.norm(back - before, axis=1) * SHRUNK < config.round_trip_px
        good = (found.ravel() > 0) & (again.ravel() > 0) & near
        pixels = (after.astype(float) + 0.5) * SHRUNK - 0.5
        limit = np.array([self.camera.width - 1, self.camera.height - 1])
        good &= ((pixels > 0) & (pixels < limit)).all(axis=1)
        rows = np.flatnonzero(good)
        return pixels[rows], rows
