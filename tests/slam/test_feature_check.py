"""Keypoints in boxes in space, against one keypoint and one box at a time."""

from __future__ import annotations

import numpy as np
import pytest

from graph.camera import Camera
from graph.geometry import Array, inverse, se3_exp, transform
from slam.depth_regions import DepthRegionConfig
from slam.feature_check import FeatureCheck
from slam.features import Features
from slam.static_check import StaticCheck, StaticCheckConfig

CAMERA = Camera(640, 480, fx=525.0, fy=480.0, cx=319.5, cy=239.5, fps=30.0, stereo_bf_px_m=40.0)


def check() -> FeatureCheck:
    return FeatureCheck(CAMERA, StaticCheck(CAMERA, 0.08, StaticCheckConfig()), DepthRegionConfig())


def keypoints(pixels: Array, depth_m: Array) -> Features:
    n, columns = len(pixels), np.zeros(len(pixels))
    return Features(
        pixels=pixels, image_pixels=pixels, descriptors=np.zeros((n, 8), np.uint64),
        scales=columns, angles_rad=columns, depth_m=depth_m, disparity_px=columns,
        sigmas_px=np.zeros((n, 3)), colours=np.zeros((n, 3), np.uint8),
        gray=np.zeros((480, 640), np.uint8),
    )  # fmt: skip


def inside_one(pixel: Array, depth_m: float, box: tuple[Array, Array], T: Array) -> bool:
    centre, half_m = transform(inverse(T), box[0][None])[0], box[1]
    if centre[2] < 0.2:
        return False
    u, v = CAMERA.project(centre[None])[0]
    beside = abs(pixel[0] - u) < CAMERA.fx * half_m[0] / centre[2]
    above = abs(pixel[1] - v) < CAMERA.fy * half_m[1] / centre[2]
    return bool(beside and above and not abs(depth_m - centre[2]) > half_m[2])


@pytest.mark.parametrize("count", [0, 1, 7])
def test_keypoints_in_boxes_one_by_one(count: int) -> None:
    rng = np.random.default_rng(count)
    T_world_camera = se3_exp(np.array([0.1, -0.4, 0.2, 1.0, 0.3, -0.5]))
    pixels, depth_m = rng.uniform([0, 0], [640, 480], (300, 2)), rng.uniform(0.5, 4, 300)
    depth_m[::5] = np.nan
    centres = transform(T_world_camera, rng.uniform([-1, -0.6, -1], [1, 0.6, 4], (count, 3)))
    sizes = rng.uniform(0.2, 1.0, (count, 3))
    found = check().in_boxes(keypoints(pixels, depth_m), (centres, sizes), T_world_camera)
    slow = [
        any(inside_one(p, z, (c, s), T_world_camera) for c, s in zip(centres, sizes, strict=True))
        for p, z in zip(pixels, depth_m, strict=True)
    ]
    np.testing.assert_array_equal(found, slow)
    assert found.any() == (count > 1)
