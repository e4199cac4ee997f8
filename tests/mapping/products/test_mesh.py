"""The mesh of integrated depth: its surface, and no warnings of Open3D."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from surface_scene import CAMERA, plane_rho, poses

from bmask_slam.graph.errors import InputError
from bmask_slam.mapping.products.mesh import (
    DepthView,
    sampled,
    truncation_voxels,
    tsdf_mesh,
    write_mesh,
)

NORMAL, OFFSET_M, VOXEL_M = np.array([0.2, -0.1, 1.0]), 2.0, 0.05


def view(T_world_camera: np.ndarray, colour: int = 200) -> DepthView:
    """A plane of one colour."""
    depth_m = (1 / plane_rho(T_world_camera, NORMAL, OFFSET_M)).astype(np.float32)
    return DepthView(depth_m, np.full((30, 40, 3), colour, np.uint8), T_world_camera)


VIEWS = [view(T) for T in poses(np.random.default_rng(1), 3)]
EMPTY = replace(VIEWS[0], depth_m=np.full((30, 40), np.nan, np.float32))


def test_the_surface_agrees_with_the_views_and_normals_face_the_camera() -> None:
    points, normals = sampled(tsdf_mesh(VIEWS, CAMERA, VOXEL_M), 1000)
    length = np.linalg.norm(NORMAL)
    assert len(points) == 1000
    assert np.abs(points @ NORMAL - OFFSET_M).max() / length < 0.2 * VOXEL_M
    np.testing.assert_allclose(normals @ NORMAL / length, -1, atol=0.02)


def test_a_view_without_depth_is_skipped() -> None:
    """A keyframe without matching neighbours has no depth from motion."""
    alone = np.asarray(tsdf_mesh(VIEWS, CAMERA, VOXEL_M).vertices)
    with_empty = np.asarray(tsdf_mesh([EMPTY, *VIEWS], CAMERA, VOXEL_M).vertices)
    assert len(with_empty) == len(alone) > 100
    with pytest.raises(InputError, match="no keyframe has depth"):
        tsdf_mesh([EMPTY], CAMERA, VOXEL_M)


def test_no_warning_of_the_library_is_printed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bright = [view(v.T_world_camera, 255) for v in VIEWS]  # weighted means of 1 may exceed 1
    write_mesh(tmp_path / "mesh.ply", tsdf_mesh(bright, CAMERA, VOXEL_M))
    assert capfd.readouterr() == ("", "")
    assert (tmp_path / "mesh.ply").stat().st_size > 1000


def test_the_truncation_covers_the_noise() -> None:
    sigmas_m = np.full(100, 0.1)
    sigmas_m[:5] = np.nan
    assert truncation_voxels(sigmas_m, VOXEL_M) == pytest.approx(6.0)
    assert truncation_voxels(sigmas_m / 100, VOXEL_M) == 3.0
    assert truncation_voxels(10 * sigmas_m, VOXEL_M) == 8.0
    assert truncation_voxels(np.full(9, np.nan), VOXEL_M) == 3.0
