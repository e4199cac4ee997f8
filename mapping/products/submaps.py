"""Submaps: the surfaces that a keyframe observes, as points in its own frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Arrays, Bytes, Floats, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import FileKind, check_like, read_arrays, write_arrays
from bmask_slam.graph.files.json_file import check_json
from bmask_slam.mapping.inverse_depth.backprojection import back_project, surface_normals
from bmask_slam.mapping.inverse_depth.dense_mapper import FusedKeyframe

SUBMAP_FILE = FileKind("submap", 1, compressed=False)
UNLABELLED = 0
MAX_GRAZING_COSINE = 0.1


@dataclass(frozen=True, eq=False)
class Submap:
    """Points in the frame of an anchor keyframe; with the anchor's pose they move rigidly.

    Attributes:
        anchor: the keyframe's id.
        points: (N, 3) float32 metres, anchor frame.
        normals: (N, 3) float32 unit vectors towards the camera, anchor frame.
        colours: (N, 3) uint8 red first.
        variances: (N,) float32 m^2 of the depth.
        instances: (N,) uint16, number of the keyframe's instance at the point, from 1; 0 for none.
    """

    anchor: int
    points: Floats
    normals: Floats
    colours: Bytes
    variances: Floats
    instances: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.points)

    def placed(self, T_world_anchor: Array) -> tuple[Floats, Floats]:
        """Points and normals (N, 3) in the world for a pose of the anchor (4, 4)."""
        T = T_world_anchor.astype(np.float32)
        return self.points @ T[:3, :3].T + T[:3, 3], self.normals @ T[:3, :3].T


def make_submap(result: FusedKeyframe, camera: Camera, voxel_m: float = 0.01) -> Submap:
    """The submap of a fused keyframe, with at most one point in a voxel of ``voxel_m``.

    Points without a normal and those observed at less than 6 degrees are dropped: they are rims.
    """
    grid = back_project(result.map, camera).reshape(-1, 3)
    normals = surface_normals(result.map, camera).reshape(-1, 3)
    facing = -(normals * grid).sum(-1) > MAX_GRAZING_COSINE * torch.linalg.norm(grid, dim=-1)
    pixels = torch.nonzero(facing)[:, 0]
    points = grid.index_select(0, pixels).cpu().numpy()
    squared_depth = result.map.rho.square().reciprocal_()
    depth_variance = (result.map.variance * squared_depth.square_()).reshape(-1)
    variances = depth_variance.index_select(0, pixels).cpu().numpy()
    keep = surest_per_voxel(points, variances, voxel_m)
    kept = pixels.cpu().numpy()[keep]
    instances = result.keyframe.instances
    if instances is None:
        instances = np.zeros(result.keyframe.depth_m.shape, np.uint16)
    return Submap(
        result.keyframe.id,
        points[keep],
        normals.cpu().numpy()[kept],
        result.keyframe.rgb.reshape(-1, 3)[kept],
        variances[keep],
        instances.reshape(-1)[kept],
    )


def surest_per_voxel(points: Floats, variances: Floats, voxel_m: float) -> Ints:
    """Sorted indices of the point (N, 3) with the least variance (N,) in each voxel."""
    if len(points) == 0:
        return np.zeros(0, np.int64)
    keys = voxel_keys(points, voxel_m)
    order = np.argsort(keys)
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    counts = np.diff(starts, append=len(keys))
    sorted_variances = variances[order]
    least = np.repeat(np.minimum.reduceat(sorted_variances, starts), counts)
    surest = np.where(sorted_variances == least, order, len(keys))
    return np.sort(np.minimum.reduceat(surest, starts))


def voxel_keys(points: NDArray[np.floating], voxel_m: float) -> Ints:
    """Keys (N,) of the voxels of points (N, 3), with 21 bits for each axis."""
    index = np.floor(points / voxel_m).astype(np.int64) + (1 << 20)
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]


def write_submap(path: Path, submap: Submap) -> None:
    """Save a submap; it appears whole or not at all. Raises InputError if it cannot."""
    write_arrays(path, SUBMAP_FILE, {"anchor": submap.anchor}, _arrays(submap))


def read_submap(path: Path) -> Submap:
    """Read a submap. Raises InputError for a missing, foreign or broken file."""
    header, arrays = read_arrays(path, SUBMAP_FILE)
    check_like(arrays, _arrays(_empty()), path)
    anchor = check_json(header.get("anchor"), int, f"{path}: its anchor", "make it again")
    if len({len(array) for array in arrays.values()}) > 1:
        raise InputError(f"{path}: its arrays have different lengths; make it again")
    return Submap(anchor, **arrays)


def _arrays(submap: Submap) -> Arrays:
    names: Sequence[str] = ("points", "normals", "colours", "variances", "instances")
    return {name: getattr(submap, name) for name in names}


def _empty() -> Submap:
    rows = np.zeros((0, 3), np.float32)
    one = np.zeros(0, np.float32)
    return Submap(0, rows, rows, rows.astype(np.uint8), one, one.astype(np.uint16))
