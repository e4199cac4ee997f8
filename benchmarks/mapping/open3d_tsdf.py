"""Open3D's truncated signed distance volume of depth images."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Floats
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.open3d_loader import load_open3d

BLOCK_VOXELS, BLOCKS = 8, 10_000
MAX_DEPTH_M = 6.0


@dataclass(frozen=True, eq=False)
class DepthView:
    """Depth (H, W) in metres, NaN where missing, colours (H, W, 3) and T_world_camera (4, 4)."""

    depth_m: Floats
    rgb: Bytes
    T_world_camera: Array


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
