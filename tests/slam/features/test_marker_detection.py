"""Markers in images: where their corners are, and which of two poses a square has."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.features.marker_detection import (
    FREE,
    MarkerDetector,
    draw_marker,
    possible_poses,
)
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import make_pose, se3_exp, se3_log
from bmask_slam.graph.sensors.markers import CORNERS, MarkersConfig, SeenCorners
from bmask_slam.sequences.frame import Frame

CAMERA = Camera(320, 240, fx=260.0, fy=262.0, cx=158.0, cy=121.0)
CONFIG = MarkersConfig(enabled=True, dictionary="5X5_50", size_m=0.2)
FACING = make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.1, -0.05, 1.1]))
T_CAMERA_MARKER = FACING @ se3_exp(np.array([0.2, -0.6, 0.3, 0, 0, 0]))


def image_of(T_camera_marker: Array, number: int, into: Image | None = None) -> Image:
    """A grey image (H, W) with a marker of 0.2 m, each pixel the mean of 8 x 8."""
    modules, fine = 7, 8
    sheet = np.full((modules + 2, modules + 2), 255, np.uint8)
    sheet[1:-1, 1:-1] = draw_marker(CONFIG, number, modules)
    sheet = np.kron(sheet, np.ones((16, 16), np.uint8))
    whole = np.array(CORNERS) * 0.2 * (modules + 2) / modules
    points = whole @ T_camera_marker[:3, :3].T + T_camera_marker[:3, 3]
    pixels = (CAMERA.project(points) + 0.5) * fine - 0.5
    n = len(sheet) - 0.5
    source = np.array([[-0.5, -0.5], [n, -0.5], [n, n], [-0.5, n]], np.float32)
    H = cv2.getPerspectiveTransform(source, pixels.astype(np.float32))
    size = (CAMERA.width * fine, CAMERA.height * fine)
    grey = np.full((CAMERA.height, CAMERA.width), 90, np.uint8) if into is None else into
    large = np.repeat(np.repeat(grey, fine, axis=0), fine, axis=1)
    cv2.warpPerspective(
        sheet, H, size, dst=large, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_TRANSPARENT
    )
    return np.asarray(cv2.resize(large, grey.shape[::-1], interpolation=cv2.INTER_AREA))


def frame_of(grey: Image, T_camera_marker: Array) -> Frame:
    """With the depth of the marker's plane everywhere."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    rays = CAMERA.backproject(np.stack([u, v], -1), np.array(1.0))
    normal = T_camera_marker[:3, 2]
    z = (normal @ T_camera_marker[:3, 3] / (rays @ normal)).astype(np.float32)
    return Frame(0, 0.5, np.repeat(grey[..., None], 3, axis=2), np.where(z > 0, z, np.nan))


def test_a_marker_is_found_where_it_is() -> None:
    """To 0.05 px; its pose by a known size, and its size by depth; signs and units matter."""
    frame = frame_of(image_of(T_CAMERA_MARKER, 3), T_CAMERA_MARKER)
    (row,) = MarkerDetector(CONFIG, FeatureConfig()).detect(frame, CAMERA).rows
    assert row[:2].tolist() == [0.5, 3.0]
    seen = SeenCorners.of(row[2:])
    points = 0.2 * CORNERS @ T_CAMERA_MARKER[:3, :3].T + T_CAMERA_MARKER[:3, 3]
    off = seen.places - points[:, :2] / points[:, 2:]
    assert np.abs(off).max() * CAMERA.fx < 0.05
    np.testing.assert_allclose(seen.inverse_depths, 1 / points[:, 2], rtol=0.01)
    for size, sigma in ((np.log(0.2), 1e-3), (0.0, FREE)):
        best = possible_poses(seen, size, sigma)[0]
        error = se3_log(best.T_marker_camera @ T_CAMERA_MARKER)
        assert np.abs(error[:3]).max() < 0.02
        assert np.abs(error[3:]).max() < 0.01
        assert abs(np.exp(best.log_size) - 0.2) < 0.001


def test_the_two_poses_of_a_small_square_are_both_given() -> None:
    """Far away and without depth either may be right; the depth of the corners says which."""
    T = make_pose(T_CAMERA_MARKER[:3, :3], np.array([0.1, 0.1, 8.0]))
    points = 0.2 * CORNERS @ T[:3, :3].T + T[:3, 3]
    places, none = points[:, :2] / points[:, 2:], np.full(4, np.nan)
    blind = possible_poses(SeenCorners(places, 1e-3, none, none), np.log(0.2), 1e-3)
    assert len(blind) == 2
    assert abs(blind[0].chi2 - blind[1].chi2) < 1
    tilts = sorted(np.linalg.norm(se3_log(p.T_marker_camera @ T)[:3]) for p in blind)
    assert tilts[0] < 0.01
    assert tilts[1] > 0.5
    depth = SeenCorners(places, 1e-3, 1 / points[:, 2], np.full(4, 1e-4))
    for found in possible_poses(depth, np.log(0.2), 1e-3):
        assert np.abs(se3_log(found.T_marker_camera @ T)).max() < 1e-3


def test_a_marker_on_what_is_covered_is_not_in_the_room() -> None:
    """One of a robot's own, beside another of the same number on the wall."""
    other = FACING @ make_pose(np.eye(3), np.array([-0.45, 0.0, 0.0]))
    frame = frame_of(image_of(T_CAMERA_MARKER, 3, image_of(other, 3)), T_CAMERA_MARKER)
    where = CAMERA.project(other[None, :3, 3])[0]
    left = replace(CAMERA, covered=((0, 0, int(where[0]) + 20, CAMERA.height),))
    (row,) = MarkerDetector(CONFIG, FeatureConfig()).detect(frame, left).rows
    there = CAMERA.project(T_CAMERA_MARKER[None, :3, 3])[0]
    u, v = SeenCorners.of(row[2:]).places.mean(axis=0) * [CAMERA.fx, CAMERA.fy]
    assert np.abs([u + CAMERA.cx, v + CAMERA.cy] - there).max() < 3


def test_an_id_that_is_there_twice_and_small_markers_are_not_used() -> None:
    other = FACING @ make_pose(np.eye(3), np.array([-0.45, 0.0, 0.0]))
    twice = image_of(T_CAMERA_MARKER, 3, image_of(other, 3))
    frame = frame_of(twice, T_CAMERA_MARKER)
    assert len(MarkerDetector(CONFIG, FeatureConfig()).detect(frame, CAMERA).rows) == 0
    one = frame_of(image_of(T_CAMERA_MARKER, 3), T_CAMERA_MARKER)
    small = MarkersConfig(enabled=True, dictionary="5X5_50", min_side_px=60.0)
    assert len(MarkerDetector(small, FeatureConfig()).detect(one, CAMERA).rows) == 0
