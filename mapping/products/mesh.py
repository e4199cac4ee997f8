"""A triangle mesh from fused depth by Open3D's truncated signed distance volume."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Floats
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.whole_file import whole_file
from bmask_slam.mapping.open3d_loader import load_open3d

BLOCK_VOXELS, BLOCKS = 8, 10_000
MAX_DEPTH_M = 6.0


@dataclass(frozen=True, eq=False)
class DepthView:
    """Depth (H, W) in metres, NaN where missing, colours (H, W, 3) and T_world_camera (4, 4)."""

    depth_m: Floats
    rgb: Bytes
    T_world_camera: Array


def truncation_voxels(sigmas_m: NDArray[np.floating], voxel_m: float) -> float:
    """Truncation distance in voxels: three sigmas of 90 % of the depths (H, W), from 3 to 8."""
    known = sigmas_m[np.isfinite(sigmas_m)]
    sigma_m = float(np.quantile(known, 0.9)) if len(known) else 0.0
    return float(np.clip(3 * sigma_m / voxel_m, 3.0, 8.0))


def tsdf_mesh(
    views: Iterable[DepthView], camera: Camera, voxel_m: float, truncation: float = 4.0
) -> Any:
    """The surface of the views, an Open3D triangle mesh in the world frame.

    Raises:
        InputError: no view has depth below MAX_DEPTH_M.
    """
    volume = integrated(views, camera, voxel_m, truncation)
    if not volume.hashmap().size():
        raise InputError(f"no mesh: no keyframe has depth below {MAX_DEPTH_M:g} m")
    mesh = volume.extract_triangle_mesh(weight_threshold=1.0).to_legacy()
    mesh.compute_vertex_normals()
    return mesh


def integrated(
    views: Iterable[DepthView], camera: Camera, voxel_m: float, truncation: float = 4.0
) -> Any:
    """Open3D's TSDF volume of the views; ``truncation`` is in voxels.

    Views without depth below MAX_DEPTH_M are skipped: Open3D raises an error for them.
    """
    o3d = load_open3d()
    core = o3d.core
    volume = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(core.float32, core.float32, core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=voxel_m,
        block_resolution=BLOCK_VOXELS,
        block_count=BLOCKS,
    )
    intrinsic = core.Tensor(camera.K)
    for view in views:
        depth_m = np.nan_to_num(view.depth_m, nan=0.0)
        if not ((depth_m > 0) & (depth_m < MAX_DEPTH_M)).any():
            continue
        depth = o3d.t.geometry.Image(core.Tensor(depth_m))
        colour = o3d.t.geometry.Image(core.Tensor(view.rgb.astype(np.float32) / 255))
        extrinsic = core.Tensor(inverse(view.T_world_camera))
        blocks = volume.compute_unique_block_coordinates(
            depth, intrinsic, extrinsic, 1.0, MAX_DEPTH_M, truncation
        )
        volume.integrate(
            blocks, depth, colour, intrinsic, intrinsic, extrinsic, 1.0, MAX_DEPTH_M, truncation
        )
    return volume


def sampled(mesh: Any, count: int = 1_000_000) -> tuple[Array, Array]:
    """Points and normals (N, 3) spread evenly over a mesh; none if it is empty."""
    if not len(mesh.triangles):
        return np.zeros((0, 3)), np.zeros((0, 3))
    load_open3d().utility.random.seed(0)
    cloud = mesh.sample_points_uniformly(count)
    return np.asarray(cloud.points), np.asarray(cloud.normals)


def write_mesh(path: Path, mesh: Any) -> None:
    """Write a mesh as PLY. Raises InputError where Open3D cannot."""
    colours = np.asarray(mesh.vertex_colors)
    np.clip(colours, 0, 1, out=colours)  # Open3D would clip them with a warning on stdout
    with whole_file(path) as temporary:
        if not load_open3d().io.write_triangle_mesh(str(temporary), mesh):
            raise InputError(f"{path}: the mesh cannot be written; free some space")
