"""What is free and what is occupied: voxels by surface points and by the rays that passed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import transform

MIN_POINTS = 3
"""A voxel with fewer points of the surface is not occupied."""
MAX_RANGE_M = 5.0
"""Of rays that carve free space; farther depth is too uncertain."""
MARGIN_VOXELS = 2
"""A ray ends so many voxels before the surface."""
UNITED = 1 << 22
"""So many voxels of the last rays, and no more than of all before, are kept apart from these."""
MAX_STRIDE_PX = 8
FLOOR_M = 0.1
"""Surfaces so near to the height 0 are floor."""
LOWEST_M = 0.5
"""Without the floor, a cell is free where at least half of so much above the ``low`` is free."""
FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Of cells, as in nav_msgs/OccupancyGrid."""
HIT, MISS = np.log(0.7 / 0.3), np.log(0.4 / 0.6)
"""Log-odds that a voxel is occupied, by one map in which it is, or is free."""
_OFFSET, _BITS = 1 << 20, 21
LIMIT = 1 << 15
"""Voxels from the origin in each direction, as in OctoMap's trees of 16 levels."""


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """Voxels that are known, in a frame with z upward and the floor at 0.

    Attributes:
        resolution_m: edge of a voxel.
        T_map_world: (4, 4).
        keys: (N, 3), ``floor(point_map / resolution)``, each once.
        occupied: (N,), False: free.
    """

    resolution_m: float
    T_map_world: Array
    keys: Ints
    occupied: Mask


class VoxelCarver:
    """Collects surface points and free rays; what is both is occupied."""

    def __init__(self, resolution_m: float, T_map_world: Array) -> None:
        self._resolution_m, self._T = resolution_m, T_map_world
        self._occupied: list[Ints] = []
        self._free: list[Ints] = []

    def add_surface(self, points_world: Array, least: int = MIN_POINTS) -> None:
        """Points (N, 3) of what stands still; a voxel needs ``least`` of them."""
        cells = np.floor(transform(self._T, points_world) / self._resolution_m)
        codes, counts = np.unique(_packed(cells), return_counts=True)
        self._occupied.append(codes[counts >= least])

    def carve(self, depth_m: Floats, camera: Camera, T_world_camera: Array) -> None:
        """Free what lies before a depth image (H, W) of a camera without distortion.

        Pixels are taken so that their rays are a voxel apart at MAX_RANGE_M. The rays of moving
        things count too: what lies before them is free.
        """
        apart_px = self._resolution_m * camera.fx / MAX_RANGE_M
        stride = int(np.clip(apart_px, 1, MAX_STRIDE_PX))
        rows, columns = np.mgrid[0 : camera.height : stride, 0 : camera.width : stride]
        z_m = depth_m[::stride, ::stride].ravel().astype(float)
        seen = np.isfinite(z_m) & (z_m > 0)
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1)[seen].astype(float)
        ends = camera.backproject(pixels, np.ones(len(pixels)))
        lengths = np.linalg.norm(ends, axis=1)
        T_map_camera = self._T @ T_world_camera
        self._free_along(
            T_map_camera[:3, 3], (ends / lengths[:, None]) @ T_map_camera[:3, :3].T,
            z_m[seen] * lengths,
        )  # fmt: skip

    def carve_to(self, points_world: Array, begin_world: Array) -> None:
        """Free what lies before points (N, 3) that were seen from a place (3,)."""
        begin_map = transform(self._T, begin_world[None])[0]
        rays = transform(self._T, points_world) - begin_map
        lengths_m = np.linalg.norm(rays, axis=1)
        far = lengths_m > 0
        self._free_along(begin_map, rays[far] / lengths_m[far, None], lengths_m[far])

    def _free_along(self, begin_map: Array, directions: Array, lengths_m: Array) -> None:
        """Free the voxels along rays (N, 3), but for the last ones."""
        reach = np.minimum(lengths_m, MAX_RANGE_M) / self._resolution_m - MARGIN_VOXELS
        order = np.argsort(-reach)
        directions, reach = directions[order], reach[order]
        begin, found = begin_map / self._resolution_m, []
        for step in range(int(max(reach.max(initial=0), 0)) + 1):
            active = int(np.searchsorted(-reach, -step))
            found.append(np.unique(_packed(np.floor(begin + step * directions[:active]))))
        self._free.append(np.unique(np.concatenate(found)))
        if sum(map(len, self._free[1:])) > max(len(self._free[0]), UNITED):
            self._free = [np.unique(np.concatenate(self._free))]

    def voxels(self) -> VoxelMap:
        """Everything that is known.

        Raises:
            InputError: nothing is, or the map is larger than LIMIT voxels from its origin.
        """
        none = np.zeros(0, np.int64)
        occupied = np.unique(np.concatenate([none, *self._occupied]))
        free = np.setdiff1d(np.concatenate([none, *self._free]), occupied)
        codes = np.concatenate([occupied, free])
        keys = _unpacked(codes)
        reach_m, far = LIMIT * self._resolution_m, int(np.abs(keys).max(initial=0))
        if not len(keys):
            raise InputError(f"no surface within {reach_m:g} m; choose a larger --resolution")
        if far >= LIMIT:
            what = f"no surface may be beyond {reach_m:g} m, and a point is {far / LIMIT:.3g} times"
            raise InputError(f"{what} as far away; choose a larger --resolution, or remove it")
        is_occupied = np.arange(len(codes)) < len(occupied)
        return VoxelMap(self._resolution_m, self._T, keys, is_occupied)


def _packed(cells: NDArray) -> Ints:
    """A number (N,) for each voxel (N, 3)."""
    x, y, z = (np.clip(cells, -_OFFSET, _OFFSET - 1).astype(np.int64) + _OFFSET).T
    return x << 2 * _BITS | y << _BITS | z


def _unpacked(codes: Ints) -> Ints:
    """The voxels (N, 3) of their numbers (N,)."""
    shifts = np.array([2 * _BITS, _BITS, 0])
    return (codes[:, None] >> shifts & ((1 << _BITS) - 1)) - _OFFSET


def agreed(maps: Sequence[VoxelMap]) -> VoxelMap:
    """Maps of one frame as one: a voxel is occupied where that is likelier by all that saw it.

    Odds of independent observations multiply, with OctoMap's probabilities of a hit and of a miss
    (Hornung et al., OctoMap, Autonomous Robots 2013): what has gone, as a person, becomes free.
    """
    codes = np.concatenate([_packed(voxels.keys) for voxels in maps])
    occupied = np.concatenate([voxels.occupied for voxels in maps])
    known, places = np.unique(codes, return_inverse=True)
    odds = np.bincount(places, np.where(occupied, HIT, MISS), len(known))
    return VoxelMap(maps[0].resolution_m, maps[0].T_map_world, _unpacked(known), odds > 0)


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Cells seen from above.

    Attributes:
        resolution_m: edge of a cell.
        origin_m: (2,), x and y in the map frame of the outer corner of ``cells[0, 0]``.
        cells: (H, W) int8, FREE, OCCUPIED or UNKNOWN; the row is y, the column x, both increasing.
    """

    resolution_m: float
    origin_m: Array
    cells: NDArray[np.int8]


def grid_of(voxels: VoxelMap, low_m: float, high_m: float) -> OccupancyGrid:
    """What a robot that is ``high_m`` high, and climbs over what is lower than ``low_m``, can do.

    A cell is occupied if a voxel from ``low_m`` to ``high_m`` above the floor is. Else it is free
    if its floor was seen, or most of what is just above ``low_m``; else unknown.
    """
    r = voxels.resolution_m
    column, row, layer = voxels.keys.T
    low = np.array([column.min(), row.min()])
    width, height = np.array([column.max(), row.max()]) - low + 1
    cells = np.full((height, width), UNKNOWN, np.int8)
    place = row - low[1], column - low[0]
    top_m = min(low_m + LOWEST_M, high_m)
    height_m, heights_m = (layer + 0.5) * r, (np.arange(top_m / r) + 0.5) * r
    floor = voxels.occupied & (np.abs(height_m) <= max(FLOOR_M, r)) & (height_m < low_m)
    band = (height_m > low_m) & (height_m < high_m)
    lowest = band & (height_m < top_m) & ~voxels.occupied
    counts = np.zeros_like(cells, np.int32)
    np.add.at(counts, tuple(p[lowest] for p in place), 1)
    layers = np.count_nonzero((heights_m > low_m) & (heights_m < top_m))
    cells[counts >= max(layers / 2, 1)] = FREE
    cells[tuple(p[floor] for p in place)] = FREE
    cells[tuple(p[band & voxels.occupied] for p in place)] = OCCUPIED
    return OccupancyGrid(r, low * r, cells)
