"""Which of a frame's keypoints lie on what moves: by earlier views, and by boxes in space."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graph.camera import Camera
from graph.geometry import Array, inverse, transform
from semantics.objects import pixel_rays
from slam.depth_regions import DepthRegionConfig, depth_regions
from slam.features import Features
from slam.frame import Frame
from slam.landmarks import Mask
from slam.static_check import StaticCheck, Verdict, Verdicts, distorted
from slam.view_memory import PosedView

NEAREST_M = 0.2
"""A box whose middle is nearer to the camera is not looked for in the image."""


class FeatureCheck:
    """Judges keypoints and the depth regions that they lie on: pure functions of a camera."""

    def __init__(self, camera: Camera, check: StaticCheck, config: DepthRegionConfig) -> None:
        self.camera = camera
        self.config = config
        self._check = check
        self._rays = pixel_rays(camera, config.step_px)

    def judge(
        self, frame: Frame, features: Features, T_world_camera: Array, views: Sequence[PosedView]
    ) -> Verdicts:
        """What earlier keyframes say about features (N,), at a predicted pose."""
        if not views:
            return np.zeros(len(features), np.int8)
        regions = depth_regions(frame.depth_m, self.config)
        samples = (self._rays * regions.depth_m[..., None]).reshape(-1, 3)
        points = self.camera.backproject(features.pixels, features.depth_m)
        points_world = transform(T_world_camera, np.concatenate([points, samples]))
        told = self._check.judge_all(points_world, [(v.view, v.T_world_camera) for v in views])
        verdicts = self._check.agree(told)
        moving = regions.moving(verdicts[len(features) :].reshape(regions.labels.shape))
        verdicts = self._check.spread(features.pixels, features.depth_m, verdicts[: len(features)])
        on_moving = regions.on(moving, features.image_pixels, features.depth_m)
        return np.where(on_moving, Verdict.MOVING, verdicts).astype(np.int8)

    def in_boxes(
        self, features: Features, boxes_world: tuple[Array, Array], T_world_camera: Array
    ) -> Mask:
        """Features (N,) in any of some boxes, in the image and in depth.

        Args:
            features: those of a frame; without depth only the image counts.
            boxes_world: centres (T, 3) m, and half sizes (T, 3) m along the image's columns, its
                rows and the depth.
            T_world_camera: (4, 4).
        """
        centres_world, half_sizes_m = boxes_world
        centres = transform(inverse(T_world_camera), centres_world)
        ahead = centres[:, 2] >= NEAREST_M
        centres, half_sizes_m = centres[ahead], half_sizes_m[ahead]
        z = centres[:, 2:]
        middle = distorted(self.camera, centres)
        half_px = np.array([self.camera.fx, self.camera.fy]) * half_sizes_m[:, :2] / z
        inside = ~(np.abs(features.depth_m - z) > half_sizes_m[:, 2:])
        for k in (0, 1):
            inside &= np.abs(features.image_pixels[:, k] - middle[:, k, None]) < half_px[:, k, None]
        return np.asarray(inside.any(axis=0))
