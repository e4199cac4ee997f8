"""The cloud of all submaps: one point a voxel, colours averaged, labels fused in log space.

Points are sorted into cubes of space on disk, so that memory is bounded by one cube.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from bmask_slam.graph.arrays import Array, Bytes, Floats, Ints, Mask
from bmask_slam.mapping.products.submaps import Submap, voxel_keys
from bmask_slam.mapping.products.surface_labels import LabelTable

BLOCK_VOXELS = 256
CELL_VOXELS = 3
"""Edge of a cell: a submap without points in a voxel gives the voxel the labels of its cell."""
_POINT = np.dtype(
    [
        ("point", "<f4", 3),
        ("normal", "<f4", 3),
        ("colour", "u1", 3),
        ("weight", "<f4"),
        ("instance", "<i4"),
    ]
)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of the map.

    Attributes:
        points, normals: (N, 3) float32 in the world, metres.
        colours: (N, 3) uint8 red first.
        sigmas_m: (N,) float32, standard deviation.
        labels: (N,) uint16, most probable class; 0 is the background.
        probabilities: (N,) float32 of that class.
        views: (N,) uint16, number of points that were fused.
    """

    points: Floats
    normals: Floats
    colours: Bytes
    sigmas_m: Floats
    labels: NDArray[np.uint16]
    probabilities: Floats
    views: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: Mask | slice) -> Cloud:
        """Some of the points."""
        return Cloud(*(getattr(self, f.name)[rows] for f in fields(self)))

    @staticmethod
    def concatenate(clouds: Sequence[Cloud]) -> Cloud:
        """The points of several clouds."""
        return Cloud(*(np.concatenate([getattr(c, f.name) for c in clouds]) for f in fields(Cloud)))


@dataclass(frozen=True, eq=False)
class PlacedSubmap:
    """A submap in the world.

    Attributes:
        submap: its points.
        T_world_anchor: (4, 4), pose of its anchor.
        first_instance: row of its instance 0, which stands for no instance, in the `LabelTable`.
    """

    submap: Submap
    T_world_anchor: Array
    first_instance: int


def sort_into_blocks(submaps: Iterable[PlacedSubmap], voxel_m: float, folder: Path) -> list[Path]:
    """Write the points of all submaps, one file a block of space; the files in a fixed order."""
    files: dict[int, Path] = {}
    for placed in submaps:
        submap = placed.submap
        rows = np.empty(len(submap), _POINT)
        rows["point"], rows["normal"] = submap.placed(placed.T_world_anchor)
        rows["colour"], rows["weight"] = submap.colours, 1 / submap.variances
        rows["instance"] = submap.instances.astype(np.int64) + placed.first_instance
        keys = voxel_keys(rows["point"], BLOCK_VOXELS * voxel_m)
        order = np.argsort(keys, kind="stable")
        keys, rows = keys[order], rows[order]
        starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]][: len(keys)])
        for start, end in pairwise([*starts.tolist(), len(rows)]):
            path = files.setdefault(int(keys[start]), folder / f"{keys[start]}.points")
            with path.open("ab") as file:
                file.write(rows[start:end].tobytes())
    return [files[key] for key in sorted(files)]


def merge_blocks(files: Iterable[Path], voxel_m: float, table: LabelTable) -> Iterator[Cloud]:
    """The cloud of each block that ``sort_into_blocks`` wrote."""
    for path in files:
        yield merge_points(np.fromfile(path, _POINT), voxel_m, table)


def merge_points(rows: NDArray, voxel_m: float, table: LabelTable) -> Cloud:
    """One point a voxel from rows of type _POINT.

    Positions and normals are means weighted by 1 / sigma^2, colours plain means. The variance is
    the least of the voxel's points: their submaps were fused with each other and are no
    independent views. Labels are fused from the submaps' instances, each submap once.
    """
    _, voxel, views = np.unique(
        voxel_keys(rows["point"], voxel_m), return_inverse=True, return_counts=True
    )
    count = len(views)
    weight: Array = rows["weight"].astype(float)
    total: Array = np.bincount(voxel, weight, count).astype(float)
    points = _mean(voxel, rows["point"], weight, total)
    normals = _mean(voxel, rows["normal"], weight, total)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    colours = _mean(voxel, rows["colour"], np.ones(len(rows)), views.astype(float))
    best = np.zeros(count, np.float32)
    np.maximum.at(best, voxel, rows["weight"])
    cell = np.unique(voxel_keys(points, CELL_VOXELS * voxel_m), return_inverse=True)[1]
    labels, probabilities = _fused_labels(voxel, cell, rows["instance"], table, points, normals)
    return Cloud(
        points.astype(np.float32),
        normals.astype(np.float32),
        np.rint(colours).astype(np.uint8),
        (1 / np.sqrt(best)).astype(np.float32),
        labels,
        probabilities,
        np.minimum(views, 65535).astype(np.uint16),
    )


def _mean(voxel: NDArray, values: NDArray, weight: Array, total: Array) -> Array:
    """Weighted means (M, 3) of values (N, 3) by voxel."""
    columns = [np.bincount(voxel, weight * values[:, k], len(total)) for k in range(3)]
    return np.stack(columns, axis=1) / total[:, None]


def _fused_labels(
    voxel: NDArray,
    cell: NDArray,
    instance: NDArray,
    table: LabelTable,
    points_world: Array,
    normals_world: Array,
) -> tuple[NDArray[np.uint16], Floats]:
    """Class (M,) and its probability (M,) of voxels at points (M, 3) with normals (M, 3).

    ``voxel`` (N,) and ``instance`` (N,) are those of the points, ``cell`` (M,) those of the voxels.
    """
    if table.log_likelihoods.shape[1] == 1:
        return np.zeros(len(cell), np.uint16), np.ones(len(cell), np.float32)
    views = _views(voxel, cell, instance, table.submaps)
    return table.labels(views, points_world, normals_world)


def _views(voxel: NDArray, cell: NDArray, instance: NDArray, submap_of: Ints) -> csr_matrix:
    """Weights (M, I) of instances in each voxel; those of a submap sum to one or are all zero.

    A submap's weights are the shares of its points in the voxel. Where it has points in the voxel's
    cell but none in the voxel, since its own grid is another, they are its shares in the cell.
    """
    submap, instances = submap_of[instance], len(submap_of)
    count = int(submap_of[-1]) + 1
    pairs, own = _shares(voxel * count + submap, instance, instances)
    near_pairs, near = _shares(cell[voxel] * count + submap, instance, instances)
    voxels, near_cells = pairs // count, near_pairs // count
    neighbours = np.searchsorted(near_pairs, cell[voxels] * count + pairs % count)
    missing = _sums(near_cells, near, int(cell.max()) + 1)[cell]
    return missing + _sums(voxels, own - near[neighbours], len(cell))


def _shares(pair: NDArray, instance: NDArray, instances: int) -> tuple[NDArray, csr_matrix]:
    """The pairs (P,) that occur among points (N,), sorted, and the shares (P, I) of instances."""
    pairs, row, points = np.unique(pair, return_inverse=True, return_counts=True)
    share = (1 / points[row]).astype(np.float32)
    return pairs, csr_matrix((share, (row, instance)), (len(pairs), instances))


def _sums(group: NDArray, rows: csr_matrix, count: int) -> csr_matrix:
    """Sums (count, I) of rows (P, I) by group (P,)."""
    ones = np.ones(len(group), np.float32)
    return csr_matrix((ones, (group, np.arange(len(group)))), (count, len(group))) @ rows
