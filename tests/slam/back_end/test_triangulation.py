"""Landmarks from two views, against exact points."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_view import CAMERA, T_NEW_OLD, add_keyframe, make_features, random_descriptors

from bmask_slam.back_end.triangulation import (
    TriangulationConfig,
    triangulate,
    triangulate_landmarks,
)
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.world.world_map import WorldMap

T_FIRST = np.eye(4)
T_SECOND = se3_exp(np.array([0.02, -0.05, 0.01, 0.3, 0.05, 0.02]))
CONFIG = TriangulationConfig()


def points(count: int, z_m: float) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.full(count, z_m)])


def project_points(points_world: np.ndarray, *poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first, second = (CAMERA.project(transform(inverse(T), points_world)) for T in poses)
    return first, second


def sigmas(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(count, 0.5), np.full(count, 0.5)


@pytest.mark.parametrize("T_world_old", [np.eye(4), T_NEW_OLD], ids=["here", "moved world"])
def test_exact_rays_give_the_exact_point(T_world_old: np.ndarray) -> None:
    poses = (T_world_old @ T_FIRST, T_world_old @ T_SECOND)
    expected = transform(T_world_old, points(20, 2.0))
    found, good = triangulate(project_points(expected, *poses), sigmas(20), poses, CAMERA, CONFIG)
    assert good.all()
    assert np.allclose(found, expected, atol=1e-9)


def test_far_points_have_no_parallax() -> None:
    poses = (T_FIRST, T_SECOND)
    pixels = project_points(points(20, 19.0), *poses)
    _, good = triangulate(pixels, sigmas(20), poses, CAMERA, CONFIG)
    assert not good.any()


def test_skew_rays_make_no_landmark() -> None:
    poses = (T_FIRST, T_SECOND)
    first, second = project_points(points(20, 2.0), *poses)
    second[::2, 1] += 6.0  # across the epipolar line, which is nearly horizontal
    _, good = triangulate((first, second), sigmas(20), poses, CAMERA, CONFIG)
    assert good[1::2].all()
    assert not good[::2].any()


def test_points_behind_the_cameras_are_refused() -> None:
    poses = (T_FIRST, T_SECOND)
    first, second = project_points(points(20, 2.0), *poses)
    _, good = triangulate((second, first), sigmas(20), poses, CAMERA, CONFIG)
    assert not good.any()


def two_views_without_depth() -> tuple[WorldMap, np.ndarray]:
    """Two keyframes with 20 common landmarks and 30 more points without depth."""
    rng = np.random.default_rng(5)
    known, without_depth = points(20, 1.5), points(30, 2.5)
    descriptors = random_descriptors(50, rng)
    world, keyframes = WorldMap(), []
    for T in (T_FIRST, T_SECOND):
        features = make_features(T, np.concatenate([known, without_depth]), descriptors)
        features.depth_m[20:] = np.nan
        features.disparity_px[20:] = np.nan
        keyframes.append(add_keyframe(world, T, features))
    ids = world.make_landmarks(keyframes[0], np.arange(20), known)
    world.attach(keyframes[1], np.arange(20), ids)
    return world, without_depth


def test_keyframes_without_depth_get_landmarks_that_both_observe() -> None:
    world, without_depth = two_views_without_depth()
    made = triangulate_landmarks(world, world.keyframes[1], CAMERA, CONFIG)
    assert len(made) == 30
    assert np.allclose(world.landmarks.points_world[made], without_depth, atol=1e-6)
    assert (world.landmarks.observations[made] == 2).all()
    for keyframe in world.keyframes.values():
        assert (keyframe.landmark_ids[20:] == made).all()


def test_masked_keypoints_are_not_triangulated() -> None:
    world, _ = two_views_without_depth()
    world.mask(world.keyframes[0], np.arange(25, 40))
    made = triangulate_landmarks(world, world.keyframes[1], CAMERA, CONFIG)
    assert len(made) == 15
    assert (world.keyframes[1].landmark_ids[25:40] == -1).all()
