"""Keypoints in moving boxes, and carried objects."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.moving.depth_segments import DepthSegmentConfig
from bmask_slam.moving.depth_view_buffer import PosedView
from bmask_slam.moving.feature_motion import FeatureMotion
from bmask_slam.moving.free_space_check import (
    DepthView,
    FreeSpaceCheck,
    FreeSpaceCheckConfig,
    depth_view,
)
from bmask_slam.sequences.frame import Frame

CAMERA = Camera(640, 480, fx=525.0, fy=480.0, cx=319.5, cy=239.5, fps=30.0, stereo_bf_px_m=40.0)


def check() -> FeatureMotion:
    return FeatureMotion(
        CAMERA,
        FreeSpaceCheck(CAMERA, CAMERA.noise_of_depth(), FreeSpaceCheckConfig()),
        DepthSegmentConfig(),
    )


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
    in_columns = abs(pixel[0] - u) < CAMERA.fx * half_m[0] / centre[2]
    in_rows = abs(pixel[1] - v) < CAMERA.fy * half_m[1] / centre[2]
    return bool(in_columns and in_rows and not abs(depth_m - centre[2]) > half_m[2])


@pytest.mark.parametrize("count", [0, 1, 7])
def test_keypoints_in_boxes_one_by_one(count: int) -> None:
    rng = np.random.default_rng(count)
    T_world_camera = se3_exp(np.array([0.1, -0.4, 0.2, 1.0, 0.3, -0.5]))
    pixels, depth_m = rng.uniform([0, 0], [640, 480], (300, 2)), rng.uniform(0.5, 4, 300)
    depth_m[::5] = np.nan
    centres = transform(T_world_camera, rng.uniform([-1, -0.6, -1], [1, 0.6, 4], (count, 3)))
    sizes = rng.uniform(0.2, 1.0, (count, 3))
    found = check().in_boxes(pixels, depth_m, (centres, sizes), T_world_camera)
    slow = [
        any(inside_one(p, z, (c, s), T_world_camera) for c, s in zip(centres, sizes, strict=True))
        for p, z in zip(pixels, depth_m, strict=True)
    ]
    np.testing.assert_array_equal(found, slow)
    assert found.any() == (count > 1)


def person_with_box() -> np.ndarray:
    """Depth in m: a person at 1.5, a carried object beside, and a wall at 3."""
    depth_m = np.full((480, 640), 3.0, np.float32)
    depth_m[96:384, 200:360] = 1.5
    depth_m[192:304, 360:456] = 1.45
    return depth_m


def point_motions(view: DepthView, T_world_camera: Array) -> list[int]:
    """Motions of keypoints on the person, the carried object and the wall; the box moves."""
    depth_m = person_with_box()
    frame = Frame(1, 1.0, np.zeros((480, 640, 3), np.uint8), depth_m, "1")
    pixels = np.array([[280.0, 240.0], [410.0, 250.0], [560.0, 250.0]])
    features = keypoints(pixels, np.array([1.5, 1.45, 3.0]))
    centre = CAMERA.backproject(np.array([[280.0, 240.0]]), np.array([1.5]))
    size = np.array([[80 * 1.5 / CAMERA.fx, 144 * 1.5 / CAMERA.fy, 0.1]])
    box = transform(T_world_camera, centre), size
    views = [PosedView(0, 0.0, view, view, T_world_camera)]
    found = check().judge(frame, features, T_world_camera, views, box)
    assert found.space is not None
    on_space = found.space.on(pixels, features.depth_m)
    np.testing.assert_array_equal(on_space, found.point_motions == -1)
    return found.point_motions.tolist()  # type: ignore[no-any-return]


def test_a_carried_object_moves_unless_a_view_shows_it_static() -> None:
    T_world_camera = se3_exp(np.array([0.1, -0.4, 0.2, 1.0, 0.3, -0.5]))
    empty = depth_view(np.full((480, 640), np.nan, np.float32), 5)
    assert point_motions(empty, T_world_camera) == [-1, -1, 0]
    view_m = person_with_box()
    view_m[:, :360] = np.nan
    assert point_motions(depth_view(view_m, 5), T_world_camera) == [-1, 1, 1]
