"""Pictures of a dense map as the camera saw it, upright, and from above and behind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bmask_slam.dense.surface import FusedMap
from bmask_slam.graph.arrays import Array, Floats
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
OVERVIEWS, OVERVIEW_STEP, OVERVIEW_POINTS, FAR_M = 24, 16, 100_000, 6.0
"""The overview is chosen among so many keyframes, by pictures of a sixteenth of the size with so
many points of the cloud; distances above FAR_M count as FAR_M."""
LEGEND_SHARE = 0.002
"""A legend has the labels on at least so much of what a picture shows."""
VIEWS = ("first", "middle", "overview")


def write_views(fused: FusedMap, cloud: Cloud, names: tuple[str, ...]) -> list[Path]:
    """Write view_NAME.png, and view_NAME_semantic.png if there are labels."""
    folder, written, colours = fused.folder.path, [], palette(names)
    camera, poses = _upright(fused)
    chosen = poses[0], poses[len(poses) // 2], overview(cloud, camera, poses)
    for name, T_world_camera in zip(VIEWS, chosen, strict=True):
        seen = nearest_points(cloud.points, camera, T_world_camera, fused.options.surface_voxel_m)
        image = painted(seen, cloud.colours)
        written.append(write_picture(folder / f"view_{name}.png", image))
        if cloud.labels.any():
            counts = np.bincount(cloud.labels[seen[seen >= 0]])
            present = np.flatnonzero(counts > LEGEND_SHARE * counts.sum()).tolist()
            image = with_legend(painted(seen, colours[cloud.labels]), names, present)
            written.append(write_picture(folder / f"view_{name}_semantic.png", image))
    return written


def write_mesh_view(fused: FusedMap, cloud: Cloud) -> Path:
    """Write a picture of the mesh in its colours, lit from the camera."""
    camera, poses = _upright(fused)
    T_world_camera = poses[len(poses) // 2]
    point_m = 1.6 * fused.options.surface_voxel_m  # no gaps in what is seen aslant
    seen = nearest_points(cloud.points, camera, T_world_camera, point_m)
    lit = np.abs(cloud.normals @ T_world_camera[:3, 2].astype(np.float32))[:, None]
    shaded = cloud.colours * (AMBIENT + (1 - AMBIENT) * lit)
    return write_picture(
        fused.folder.path / "view_mesh.png", painted(seen, shaded.astype(np.uint8))
    )


def _upright(fused: FusedMap) -> tuple[Camera, list[Array]]:
    """An upright camera, and its T_world_camera (4, 4) at each keyframe."""
    turns = SIDES.index(fused.run.side or SIDES[0])
    camera, T_camera_upright = fused.run.camera.turned(turns)
    return camera, [k.T_world_camera @ T_camera_upright for k in fused.keyframes()]


def overview(cloud: Cloud, camera: Camera, poses: Sequence[Array]) -> Array:
    """T_world_camera (4, 4) from behind and above the pose from which most is seen."""
    tilt = np.deg2rad(OVERVIEW_TILT_DEG)
    T_keyframe_overview = make_pose(np.eye(3), OVERVIEW_OFFSET_M)
    T_keyframe_overview[1:3, 1:3] = [[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]
    found = [T @ T_keyframe_overview for T in poses[:: -(-len(poses) // OVERVIEWS)]]
    small = camera.of_size(camera.width // OVERVIEW_STEP, camera.height // OVERVIEW_STEP)
    some = slice(None, None, max(len(cloud.points) // OVERVIEW_POINTS, 1))
    thinned = cloud.points[some], cloud.normals[some]
    return found[int(np.argmax([_shown(*thinned, small, T) for T in found]))]


def _shown(points: Floats, normals: Floats, camera: Camera, T_world_camera: Array) -> float:
    """How much of the surface, of points and normals (N, 3), a picture shows from its front.

    Areas, which grow with the square of the distance, less those that are seen from behind, times
    the share of the picture that is filled.
    """
    seen = nearest_points(points, camera, T_world_camera, 0.0)
    shown = seen[seen >= 0]
    rays = points[shown] - T_world_camera[:3, 3]
    front = np.where((rays * normals[shown]).sum(axis=1) < 0, 1.0, -1.0)
    areas = front * np.minimum((rays**2).sum(axis=1), FAR_M**2)
    return float(areas.sum() * len(shown) / seen.size)
