"""A map to drive on and a cloud that grow with a live dense map: submaps follow their keyframes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Floats
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import make_pose, transform
from bmask_slam.mapping.products.occupancy import (
    OccupancyGrid,
    VoxelCarver,
    VoxelMap,
    agreed,
    grid_of,
)

POINTS = 6000
"""Of each submap."""
MOVED_M, TURNED = 0.02, 0.01
"""Smallest shift, and change of the rotation matrix, for which a submap is carved anew."""
MAX_POINTS = 200_000
"""In a message; of more, every second, third, ... is left in."""
_BITS = 21
"""Of a voxel's number along one axis."""
BELOW_M = 0.3
"""What is known so far below the floor counts, so that the floor itself does."""


@dataclass(frozen=True)
class GridOptions:
    """Of a grid.

    Attributes:
        resolution_m: edge of a cell.
        low_m, high_m: what is lower above the floor is driven over, what is higher under.
        floor_m: height of the floor in the map's frame; None: the lowest level with many points.
    """

    resolution_m: float = 0.05
    low_m: float = 0.1
    high_m: float = 1.5
    floor_m: float | None = None


@dataclass(eq=False)
class _Submap:
    """Points in the keyframe's frame, where they were placed last, and their voxels there."""

    points: Floats
    T_world_camera: Array | None = None
    floor_m: float = 0.0
    voxels: VoxelMap | None = None


class LiveGrid:
    """Keeps what each submap says is free and occupied; for one thread but for ``add``."""

    def __init__(self, T_map_world: Array, options: GridOptions) -> None:
        self.options = options
        self._T_map_world = T_map_world
        self._submaps: dict[int, _Submap] = {}
        self._new: dict[int, Floats] = {}

    def add(self, number: int, points: Floats) -> None:
        """A submap's points (N, 3) in its keyframe's frame; from any thread."""
        self._new[number] = points

    def grid(self, poses: dict[int, Array]) -> tuple[OccupancyGrid, float] | None:
        """The grid by T_world_camera (4, 4) of the keyframes in the map, and the floor's height.

        Seen from above in the map's frame; None while nothing is known. Submaps of other keyframes
        are kept: those of another map segment are in the map once the two are joined.
        """
        for number in list(self._new):
            self._submaps[number] = _Submap(self._new.pop(number))
        known = {n: s for n, s in self._submaps.items() if n in poses and len(s.points)}
        if not known:
            return None
        floor_m = self._floor_m(known, poses)
        for number, submap in known.items():
            T = poses[number]
            if self._has_moved(submap, T) or abs(submap.floor_m - floor_m) > MOVED_M:
                submap.voxels = self._carved(submap.points, T, floor_m)
                submap.T_world_camera, submap.floor_m = T.copy(), floor_m
        maps = [s.voxels for s in known.values() if s.voxels is not None]
        if not maps:
            return None
        return grid_of(agreed(maps), self.options.low_m, self.options.high_m), floor_m

    def _floor_m(self, submaps: dict[int, _Submap], poses: dict[int, Array]) -> float:
        if self.options.floor_m is not None:
            return self.options.floor_m
        T = self._T_map_world
        heights = [
            transform(T @ poses[n], s.points[::10].astype(float))[:, 2] for n, s in submaps.items()
        ]
        from bmask_slam.mapping.products.floor_plan import floor_height  # noqa: PLC0415 - numba

        return floor_height(np.concatenate(heights))

    def _has_moved(self, submap: _Submap, T: Array) -> bool:
        if submap.T_world_camera is None:
            return True
        off = np.abs(submap.T_world_camera - T)
        return bool(off[:3, 3].max() > MOVED_M or off[:3, :3].max() > TURNED)

    def _carved(self, points: Floats, T_world_camera: Array, floor_m: float) -> VoxelMap | None:
        """The voxels about the floor and up to ``high_m``; None where there are none."""
        lowered = make_pose(np.eye(3), np.array([0.0, 0.0, -floor_m])) @ self._T_map_world
        carver = VoxelCarver(self.options.resolution_m, lowered)
        points_world = transform(T_world_camera, points.astype(float))
        carver.add_surface(points_world, least=1)
        carver.carve_to(points_world, T_world_camera[:3, 3])
        try:
            voxels = carver.voxels()
        except InputError:  # of nothing, or kilometres away
            return None
        height_m = voxels.keys[:, 2] * self.options.resolution_m
        near = (height_m > -BELOW_M) & (height_m < self.options.high_m)
        if not near.any():
            return None
        return replace(voxels, keys=voxels.keys[near], occupied=voxels.occupied[near])


@dataclass(frozen=True, eq=False)
class _Points:
    """Points (N, 3) in the frame of their keyframe, and colours (N, 3)."""

    points: Floats
    colours: Bytes


class LiveCloud:
    """Keeps each submap's points; for one thread but for ``add``."""

    def __init__(self, T_map_world: Array, voxel_m: float) -> None:
        self._T_map_world, self._voxel_m = T_map_world, voxel_m
        self._submaps: dict[int, _Points] = {}

    def add(self, number: int, points: Floats, colours: Bytes) -> None:
        """A submap's points (N, 3) in its keyframe's frame, and colours; from any thread."""
        self._submaps[number] = _Points(points, colours)

    def cloud(self, poses: dict[int, Array]) -> tuple[Array, Bytes] | None:
        """Points (N, 3) in the map's frame, one a voxel, and colours (N, 3); None while empty.

        ``poses``: T_world_camera (4, 4) of the keyframes in the map. The newest submap that has a
        voxel gives its point.
        """
        known = {n: s for n, s in self._submaps.copy().items() if n in poses and len(s.points)}
        if not known:
            return None
        newest = sorted(known, reverse=True)
        points = np.concatenate(
            [transform(self._T_map_world @ poses[n], known[n].points.astype(float)) for n in newest]
        )
        colours = np.concatenate([known[n].colours for n in newest])
        cells = np.floor(points / self._voxel_m).astype(np.int64) + (1 << (_BITS - 1))
        cells = np.clip(cells, 0, (1 << _BITS) - 1)
        codes = (cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2]
        first = np.unique(codes, return_index=True)[1]
        chosen = first[:: len(first) // (MAX_POINTS + 1) + 1]
        return points[chosen], colours[chosen]
