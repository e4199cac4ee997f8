"""Pictures of a dense map as the camera saw it, upright, and from above and behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bmask_slam.dense.surface import FusedMap
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import SIDES, Camera
from bmask_slam.graph.geometry import make_pose
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.pictures import (
    nearest_points,
    painted,
    palette,
    with_legend,
    write_picture,
)

AMBIENT = 0.3
"""Light from everywhere in the picture of the mesh; the rest comes from the camera."""
OVERVIEW_OFFSET_M = np.array([0.0, -0.6, -1.0])
OVERVIEW_TILT_DEG = -20.0
"""The overview is taken from behind and above a keyframe, tilted down."""
VIEWS = ("first", "middle", "overview")


def write_views(fused: FusedMap, cloud: Cloud, names: tuple[str, ...]) -> list[Path]:
    """Write view_NAME.png, and view_NAME_semantic.png if there are several labels."""
    folder, written = fused.folder.path, []
    present, colours = np.unique(cloud.labels).tolist(), palette(names)
    camera, poses = _viewpoints(fused)
    for name, T_world_camera in zip(VIEWS, poses, strict=True):
        seen = nearest_points(cloud.points, camera, T_world_camera, fused.options.surface_voxel_m)
        image = painted(seen, cloud.colours)
        written.append(write_picture(folder / f"view_{name}.png", image))
        if len(present) > 1:
            image = with_legend(painted(seen, colours[cloud.labels]), names, present)
            written.append(write_picture(folder / f"view_{name}_semantic.png", image))
    return written


def write_mesh_view(fused: FusedMap, cloud: Cloud) -> Path:
    """Write a picture of the mesh in its colours, lit from the camera."""
    camera, (_, T_world_camera, _) = _viewpoints(fused)
    point_m = 1.6 * fused.options.surface_voxel_m  # no gaps in what is seen aslant
    seen = nearest_points(cloud.points, camera, T_world_camera, point_m)
    lit = np.abs(cloud.normals @ T_world_camera[:3, 2].astype(np.float32))[:, None]
    shaded = cloud.colours * (AMBIENT + (1 - AMBIENT) * lit)
    return write_picture(
        fused.folder.path / "view_mesh.png", painted(seen, shaded.astype(np.uint8))
    )


def _viewpoints(fused: FusedMap) -> tuple[Camera, tuple[Array, Array, Array]]:
    """An upright camera, and T_world_camera (4, 4) of two keyframes and of an overview."""
    turns = SIDES.index(fused.run.side or SIDES[0])
    camera, T_camera_upright = fused.run.camera.turned(turns)
    keyframes = fused.keyframes()
    first = keyframes[0].T_world_camera @ T_camera_upright
    middle = keyframes[len(keyframes) // 2].T_world_camera @ T_camera_upright
    tilt = np.deg2rad(OVERVIEW_TILT_DEG)
    T_middle_overview = make_pose(np.eye(3), OVERVIEW_OFFSET_M)
    T_middle_overview[1:3, 1:3] = [[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]
    return camera, (first, middle, middle @ T_middle_overview)
