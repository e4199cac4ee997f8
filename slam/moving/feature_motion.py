"""Finds keypoints on moving objects, by earlier views and by moving boxes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.moving.depth_segments import DepthSegmentConfig, MovingSpace, depth_segments
from bmask_slam.moving.depth_view_buffer import PosedView
from bmask_slam.moving.free_space_check import FreeSpaceCheck, PointMotion, PointMotions
from bmask_slam.semantics.objects.object_map import pixel_rays
from bmask_slam.sequences.frame import Frame

NEAREST_M = 0.2
"""Boxes whose centre is nearer to the camera are not projected into the image."""

Boxes = tuple[Array, Array]
"""Centres in the world (T, 3) m, and half sizes (T, 3) m along an image's columns, its rows and
the depth."""


class FeatureMotions(NamedTuple):
    """The motion of features (N,), and the moving part of the frame; None without views."""

    point_motions: PointMotions
    space: MovingSpace | None


class FeatureMotion:
    """Finds moving keypoints and depth segments: pure functions of a camera."""

    def __init__(self, camera: Camera, check: FreeSpaceCheck, config: DepthSegmentConfig) -> None:
        self.camera = camera
        self.config = config
        self._check = check
        self._rays = pixel_rays(camera, config.step_px)
        places = np.indices(self._rays.shape[:2])[::-1]
        self._samples = config.step_px * places.reshape(2, -1).T.astype(float)

    def judge(
        self,
        frame: Frame,
        features: Features,
        T_world_camera: Array,
        views: Sequence[PosedView],
        moving: Boxes,
    ) -> FeatureMotions:
        """The motion of features at a predicted pose, by earlier views and by moving boxes.

        Features that are static by a view stay static inside a box.
        """
        judged = FeatureMotions(np.zeros(len(features), np.int8), None)
        if views:
            judged = self._by_views(frame, features, T_world_camera, views, moving)
        in_boxes = self.in_boxes(features.image_pixels, features.depth_m, moving, T_world_camera)
        judged.point_motions[in_boxes & (judged.point_motions != PointMotion.STATIC)] = (
            PointMotion.MOVING
        )
        return judged

    def _by_views(
        self,
        frame: Frame,
        features: Features,
        T_world_camera: Array,
        views: Sequence[PosedView],
        boxes_world: Boxes,
    ) -> FeatureMotions:
        """The motion of features by views; ``boxes_world`` move, with what is carried.

        All features on a moving segment move.
        """
        segments = depth_segments(frame.depth_m, self.config)
        samples = (self._rays * segments.depth_m[..., None]).reshape(-1, 3)
        points = self.camera.backproject(features.pixels, features.depth_m)
        points_world = transform(T_world_camera, np.concatenate([points, samples]))
        by_view = self._check.judge_all(points_world, [(v.view, v.T_world_camera) for v in views])
        point_motions = self._check.agree(by_view)
        by_sample = point_motions[len(features) :].reshape(segments.labels.shape)
        depth_m = segments.depth_m.ravel().astype(float)
        moving = segments.moving(by_sample)
        carried = self.in_boxes(self._samples, depth_m, boxes_world, T_world_camera)
        carried = carried.reshape(by_sample.shape)
        carried &= (by_sample != PointMotion.STATIC) & (segments.labels > 0)
        carried |= segments.carried(moving | carried, by_sample)
        observed, space = segments.space(moving), segments.space(moving | carried)
        point_motions = self._check.spread(
            features.pixels, features.depth_m, point_motions[: len(features)]
        )
        on_space = space.on(features.image_pixels, features.depth_m)
        point_motions[on_space & (point_motions != PointMotion.STATIC)] = PointMotion.MOVING
        point_motions[observed.on(features.image_pixels, features.depth_m)] = PointMotion.MOVING
        return FeatureMotions(point_motions, space)

    def in_boxes(
        self, pixels: Array, depth_m: Array, boxes_world: Boxes, T_world_camera: Array
    ) -> Mask:
        """Mask (N,) of pixels (N, 2) with depths (N,) that lie in any of the boxes.

        Of a pixel without depth (NaN) only the position in the image counts.
        """
        centres_world, half_sizes_m = boxes_world
        centres = transform(inverse(T_world_camera), centres_world)
        ahead = centres[:, 2] >= NEAREST_M
        centres, half_sizes_m = centres[ahead], half_sizes_m[ahead]
        z = centres[:, 2:]
        middle = self.camera.project_distorted(centres)
        half_px = np.array([self.camera.fx, self.camera.fy]) * half_sizes_m[:, :2] / z
        inside = ~(np.abs(depth_m - z) > half_sizes_m[:, 2:])
        for k in (0, 1):
            inside &= np.abs(pixels[:, k] - middle[:, k, None]) < half_px[:, k, None]
        return np.asarray(inside.any(axis=0))
