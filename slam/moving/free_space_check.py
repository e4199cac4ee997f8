"""Motion by free space: a static point cannot be where an earlier view saw through.

Keypoints are compared with the depth of earlier keyframes, landmarks with the present depth image;
neither needs a match or a class. Points behind a surface are hidden, and their motion is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.graph.camera import Camera, DepthNoise
from bmask_slam.graph.geometry import inverse

PointMotions = NDArray[np.int8]


class PointMotion(IntEnum):
    """The motion of a point, by depth views."""

    MOVING = -1
    """It lies in space that a view saw to be free."""
    UNKNOWN = 0
    """It is hidden, out of view or without depth."""
    STATIC = 1
    """A view saw a surface there."""


@dataclass(frozen=True)
class FreeSpaceCheckConfig:
    """When a point lies in free space, and how many views are kept.

    A point lies in free space of a view if every depth within ``window_px`` of it is farther by
    ``margin_m`` plus ``depth_sigmas`` standard deviations of the difference; the window allows for
    pose errors and for ragged edges in the depth image. It lies on a surface if the nearest or the
    farthest depth in the window is within that distance. Points beyond ``max_depth_m`` are not
    judged. ``views`` keyframes are kept, at least ``interval_s`` apart. The motion of a keypoint
    that is unknown is taken from its ``neighbours`` within ``neighbour_px``, if their depths differ
    by less than ``same_depth`` times the depth. Most of a thing that moves is in its own place for
    a while: only views at least ``static_s`` before or after find one static. It stands still if
    each of two or more views that are at least ``still_s`` apart in time found ``still_share`` of
    it where it is.
    """

    margin_m: float = 0.1
    depth_sigmas: float = 4.0
    window_px: int = 5
    max_depth_m: float = 6.0
    views: int = 6
    interval_s: float = 0.25
    neighbours: int = 5
    neighbour_px: float = 30.0
    same_depth: float = 0.05
    static_s: float = 0.4
    still_s: float = 1.0
    still_share: float = 0.9

    def __post_init__(self) -> None:
        if self.margin_m <= 0 or self.depth_sigmas < 0 or self.window_px < 0:
            raise ValueError("margin_m must be positive, depth_sigmas and window_px not negative")
        if not 1 <= self.views <= 127 or self.neighbours < 1:
            raise ValueError("views must be 1 to 127, neighbours at least 1")


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth image as free space and surfaces, at every ``step``-th pixel in both directions.

    Attributes:
        nearest_m: (H / step, W / step) nearest depth in a window; 0 where one is missing.
        farthest_m: the farthest depth in it, 0 where all are missing.
    """

    nearest_m: Floats
    farthest_m: Floats
    step: int

    def thinned(self, factor: int) -> DepthView:
        """A copy of every ``factor``-th pixel in each direction."""
        near, far = (a[::factor, ::factor].copy() for a in (self.nearest_m, self.farthest_m))
        return DepthView(near, far, factor * self.step)


def depth_view(depth_m: Floats, window_px: int) -> DepthView:
    """The view of a depth image (H, W), NaN where missing, at every second pixel."""
    return thinned_view(depth_m[::2, ::2].copy(), 2, window_px)


def thinned_view(depth_m: Floats, step: int, window_px: int) -> DepthView:
    """The view from every ``step``-th pixel of a depth image, which is overwritten."""
    cv2.patchNaNs(depth_m, 0.0)
    side = 2 * (window_px // step) + 1
    window = np.ones((side, side), np.uint8)
    return DepthView(cv2.erode(depth_m, window), cv2.dilate(depth_m, window), step)


class FreeSpaceCheck:
    """Compares points with depth views: pure functions of a camera and its depth noise."""

    def __init__(self, camera: Camera, noise: DepthNoise, config: FreeSpaceCheckConfig):
        self.camera = camera
        self.config = config
        self._both = noise.times(math.sqrt(2) * config.depth_sigmas)

    def judge(self, points_world: Array, view: DepthView, T_world_camera: Array) -> PointMotions:
        """The motion (N,) of points (N, 3) by one view; unknown for points that are NaN."""
        return self.judge_all(points_world, [(view, T_world_camera)])[0]

    def judge_all(
        self, points_world: Array, views: Sequence[tuple[DepthView, Array]]
    ) -> PointMotions:
        """The motion (K, N) of points (N, 3) by K views, each with T_world_camera (4, 4).

        The views have one size and step.
        """
        z, ahead, nearest, farthest = self._observed(points_world, views)
        margin = self._margin_m(z)
        point_motions = ((np.abs(nearest - z) < margin) | (np.abs(farthest - z) < margin)).view(
            np.int8
        )
        point_motions[nearest - z > self._margin_m(nearest)] = PointMotion.MOVING
        point_motions *= ahead
        return point_motions

    def offsets(
        self, points_world: Array, views: Sequence[tuple[DepthView, Array]]
    ) -> tuple[Floats, Mask]:
        """Distances (K, N) in m of points (N, 3) from the surface in K views, and the visibility.

        Positive where the surface is behind the point, 0 within the depths of the window; NaN out
        of view, where a depth is missing, and where the point is not on the surface. Views come
        with T_world_camera (4, 4); the visibility (K, N) tells which points are in view.
        """
        z, ahead, nearest, farthest = self._observed(points_world, views)
        off_m = np.clip(z, nearest, farthest) - z
        off_m[~ahead | (nearest == 0) | (np.abs(off_m) > self._margin_m(z))] = np.nan
        return off_m, ahead

    def agree(self, point_motions: PointMotions) -> PointMotions:
        """The motion (N,) by several views (K, N): the majority of those that know it."""
        return np.asarray(np.sign(point_motions.sum(axis=0, dtype=np.int8)))

    def stood_still(self, point_motions: PointMotions, apart_s: Array, at_least: int) -> bool:
        """Whether a thing stands still, by views (K, N) of its points, ``apart_s`` (K,) in time.

        A view that knows the motion of fewer than ``at_least`` points does not count.
        """
        known = np.count_nonzero(point_motions, axis=1)
        checked = (np.abs(apart_s) >= self.config.still_s) & (known >= at_least)
        static_views = np.count_nonzero(point_motions == PointMotion.STATIC, axis=1)
        good = static_views[checked] >= self.config.still_share * known[checked]
        return bool(len(good) >= 2 and good.all())

    def spread(self, pixels: Array, depth_m: Array, point_motions: PointMotions) -> PointMotions:
        """The motion (N,) of keypoints, with unknown ones taken from their neighbours.

        Args:
            pixels: (N, 2) of the keypoints.
            depth_m: (N,) NaN where missing; such keypoints follow neighbours of any depth.
            point_motions: (N,).
        """
        is_known = point_motions != PointMotion.UNKNOWN
        open_, known = np.flatnonzero(~is_known), np.flatnonzero(is_known)
        if not len(open_) or not (point_motions[known] == PointMotion.MOVING).any():
            return point_motions
        tree, count = cKDTree(pixels[known]), min(self.config.neighbours, len(known))
        distance, near = tree.query(
            pixels[open_], count, distance_upper_bound=self.config.neighbour_px
        )
        distance, near = distance.reshape(len(open_), -1), near.reshape(len(open_), -1)
        nearest_known = known[np.minimum(near, len(known) - 1)]
        apart = np.abs(depth_m[nearest_known] - depth_m[open_, None])
        differs = apart > self.config.same_depth * depth_m[open_, None]
        speaks = np.isfinite(distance) & ~differs
        spread = point_motions.copy()
        spread[open_] = np.sign((point_motions[nearest_known] * speaks).sum(axis=1))
        return spread

    def _observed(
        self, points_world: Array, views: Sequence[tuple[DepthView, Array]]
    ) -> tuple[Floats, Mask, Floats, Floats]:
        """Depth, visibility, nearest and farthest depth (K, N) of points (N, 3) in views."""
        T_camera_world = inverse(np.array([T for _, T in views])).astype(np.float32)
        to_cameras = T_camera_world[:, :3, :3].transpose(1, 0, 2).reshape(-1, 3)
        x, y, z = (to_cameras @ points_world.T.astype(np.float32)).reshape(3, len(views), -1)
        x, y, z = (
            a + t[:, None] for a, t in zip((x, y, z), T_camera_world[:, :3, 3].T, strict=True)
        )
        ahead = (z > 0.1) & (z < self.config.max_depth_m)
        u, v = self._pixels(x, y, np.where(ahead, z, np.float32(1)))
        ahead &= (u > 0) & (u < self.camera.width - 1) & (v > 0) & (v < self.camera.height - 1)
        step = views[0][0].step
        height, width = views[0][0].nearest_m.shape
        rows, columns = (np.where(ahead, a, 0) / np.float32(step) for a in (v, u))
        place = np.minimum(np.rint(rows), height - 1) * np.float32(width)
        place += np.minimum(np.rint(columns), width - 1)
        nearest, farthest = _looked_up([view for view, _ in views], place.astype(np.int64))
        return z, ahead, nearest, farthest

    def _margin_m(self, depth_m: Floats) -> Floats:
        """Largest difference of two depths of this size on one surface."""
        return np.float32(self.config.margin_m) + self._both.depth_sigma_m(depth_m)

    def _pixels(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Columns and rows (K, N) in the image as recorded of points (K, N) before it."""
        if any(self.camera.distortion):
            points = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(float)
            u, v = self.camera.project_distorted(points).astype(np.float32).T.reshape(2, *z.shape)
            return u, v
        camera, per_z = self.camera, 1 / z
        u = camera.fx * x * per_z + camera.cx
        v = camera.fy * y * per_z + camera.cy
        return u.astype(np.float32, copy=False), v.astype(np.float32, copy=False)


def _looked_up(views: Sequence[DepthView], place: Ints) -> tuple[Floats, Floats]:
    """Nearest and farthest depths (K, N) of each view at flat pixel indices (K, N)."""
    nearest = np.empty(place.shape, np.float32)
    farthest = np.empty(place.shape, np.float32)
    for view, where, near, far in zip(views, place, nearest, farthest, strict=True):
        view.nearest_m.take(where, out=near, mode="clip")
        view.farthest_m.take(where, out=far, mode="clip")
    return nearest, farthest
