"""Submaps: points on the surface, moved with their anchor, read back as written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from surface_scene import CAMERA, as_map, plane_rho, poses

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose, se3_exp, transform
from bmask_slam.mapping.inverse_depth.backprojection import back_project, surface_normals
from bmask_slam.mapping.inverse_depth.dense_mapper import DenseKeyframe, FusedKeyframe
from bmask_slam.mapping.products.submaps import (
    make_submap,
    read_submap,
    surest_per_voxel,
    write_submap,
)

T = poses(np.random.default_rng(2), 1, 0.2, 0.3)[0]
NORMAL, OFFSET_M = np.array([0.2, -0.1, 1.0]), 2.0


def fused_plane(sigma: float = 0.004) -> FusedKeyframe:
    given = as_map(plane_rho(T, NORMAL, OFFSET_M), sigma)
    rgb = np.arange(30 * 40 * 3, dtype=np.uint8).reshape(30, 40, 3)
    numbers = np.tile(np.arange(40, dtype=np.uint16) // 20, (30, 1))
    none = np.zeros(0, np.int64)
    depth = given.depth_m()
    keyframe = DenseKeyframe(7, T, rgb, depth, none, none.astype(float), numbers)
    return FusedKeyframe(keyframe, given, np.ones((30, 40), np.uint8))


def test_points_agree_with_the_camera_model() -> None:
    given = as_map(plane_rho(T), 0.01)
    v, u = np.mgrid[:30, :40].astype(float)
    expected = CAMERA.backproject(np.stack([u, v], -1), 1 / plane_rho(T))
    np.testing.assert_allclose(back_project(given, CAMERA).numpy(), expected, rtol=1e-5)


def test_normals_of_a_plane_face_the_camera() -> None:
    normals = surface_normals(as_map(plane_rho(T), 0.01), CAMERA).numpy()
    expected = -(T[:3, :3].T @ NORMAL) / np.linalg.norm(NORMAL)
    np.testing.assert_allclose(
        normals[1:-1, 1:-1], np.broadcast_to(expected, (28, 38, 3)), atol=1e-3
    )
    assert np.isnan(normals[0]).all()


def test_noise_does_not_bias_normals_towards_the_camera() -> None:
    camera = replace(CAMERA, width=160, height=120)
    floor = np.array([0.05, 1.0, 0.1])
    pose = make_pose(np.eye(3), np.array([0.0, -1.2, 0.0]))
    exact = plane_rho(pose, floor, 0.0, camera)
    exact[exact < 0.2] = np.nan
    noisy = exact + np.random.default_rng(0).normal(0, 0.003, exact.shape)
    normals = surface_normals(as_map(noisy, 0.003), camera).numpy()
    known = np.isfinite(normals).all(axis=-1)
    assert known.sum() > 2000
    mean = normals[known].mean(axis=0)
    expected = -floor / np.linalg.norm(floor)
    assert np.degrees(np.arccos(mean @ expected / np.linalg.norm(mean))) < 0.5
    off_deg = np.degrees(np.arccos(np.clip(normals[known] @ expected, -1, 1)))
    assert np.median(off_deg) < 5


def test_normals_do_not_cross_an_edge() -> None:
    rho = np.full((30, 40), 0.5)
    rho[:, 20:] = np.linspace(0.8, 1.0, 30)[:, None]
    normals = surface_normals(as_map(rho, 0.01), CAMERA).numpy()
    alone = surface_normals(as_map(np.where(np.arange(40) < 20, rho, np.nan), 0.01), CAMERA)
    np.testing.assert_allclose(normals[1:-1, 1:19], alone.numpy()[1:-1, 1:19], atol=1e-6)
    assert np.isnan(normals[:, 19:21]).all()


def test_placed_points_lie_on_the_plane_and_follow_the_anchor() -> None:
    submap = make_submap(fused_plane(), CAMERA, 0.01)
    points, normals = submap.placed(T)
    np.testing.assert_allclose(points @ NORMAL, OFFSET_M, atol=1e-4)
    np.testing.assert_allclose(normals @ NORMAL, -np.linalg.norm(NORMAL), atol=1e-3)
    moved = se3_exp(np.array([0.1, 0.2, -0.1, 1.0, 2.0, 3.0]))
    again, turned = submap.placed(moved @ T)
    np.testing.assert_allclose(again, transform(moved, points.astype(float)), atol=1e-5)
    np.testing.assert_allclose(turned, normals @ moved[:3, :3].T, atol=1e-5)


def test_points_have_colour_and_instance_of_their_pixels() -> None:
    result = fused_plane()
    submap = make_submap(result, CAMERA, 1e-4)
    pixels = np.rint(CAMERA.project(submap.points.astype(float))).astype(int)
    np.testing.assert_array_equal(submap.colours, result.keyframe.rgb[pixels[:, 1], pixels[:, 0]])
    np.testing.assert_array_equal(submap.instances, pixels[:, 0] // 20)
    assert len(submap) == 28 * 38


def test_the_variance_equals_that_of_the_depth() -> None:
    submap = make_submap(fused_plane(0.004), CAMERA, 1e-4)
    np.testing.assert_allclose(
        np.sqrt(submap.variances), 0.004 * submap.points[:, 2] ** 2, rtol=1e-3
    )


def test_the_point_with_least_variance_of_a_voxel_is_kept() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [-0.1, 0.1, 0.1], [0.3, 0.3, 0.3]])
    kept = surest_per_voxel(points.astype(np.float32), np.array([3, 1, 2, 4], np.float32), 1.0)
    np.testing.assert_array_equal(kept, [1, 2])


def test_one_point_is_kept_of_many_in_a_voxel() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-1, 1, (4000, 3)).astype(np.float32)
    variances = rng.integers(1, 4, 4000).astype(np.float32)
    best: dict[tuple[int, ...], int] = {}
    for k, cell in enumerate(map(tuple, np.floor(points / 0.25).astype(int).tolist())):
        if cell not in best or variances[k] < variances[best[cell]]:
            best[cell] = k
    kept = surest_per_voxel(points, variances, 0.25)
    np.testing.assert_array_equal(kept, sorted(best.values()))


def test_a_submap_is_read_back(tmp_path: Path) -> None:
    submap = make_submap(fused_plane(), CAMERA, 0.05)
    write_submap(tmp_path / "7", submap)
    again = read_submap(tmp_path / "7")
    assert again.anchor == 7
    for name in ("points", "normals", "colours", "variances", "instances"):
        np.testing.assert_array_equal(getattr(again, name), getattr(submap, name))


def test_a_broken_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "7").write_bytes(b"PK nothing")
    with pytest.raises(InputError, match="7"):
        read_submap(tmp_path / "7")


def test_no_depth_gives_no_points() -> None:
    result = fused_plane()
    nothing = result.map.where(torch.zeros(30, 40, dtype=torch.bool))
    assert len(make_submap(FusedKeyframe(result.keyframe, nothing, result.views), CAMERA)) == 0
