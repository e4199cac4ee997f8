"""The cloud of all submaps: one point a voxel, colours averaged, labels fused in log space.

Memory is bounded by the largest block of space, not by the map: points go through files on disk.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from graph.geometry import Array
from mapping.submaps import Submap, voxel_keys

BLOCK_VOXELS = 256
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
        views: (N,) uint16, submaps that were fused.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    colours: NDArray[np.uint8]
    sigmas_m: NDArray[np.float32]
    labels: NDArray[np.uint16]
    probabilities: NDArray[np.float32]
    views: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.points)


def spill(submaps: Iterable[tuple[Submap, Array, int]], voxel_m: float, folder: Path) -> list[Path]:
    """Sort the points of all submaps into one file a block of space; the files, in a fixed order.

    Each submap comes with the pose of its anchor (4, 4) in the world and the number of its first
    instance (its row 0) in a table of all submaps' instances.
    """
    files: dict[int, Path] = {}
    for submap, T_world_anchor, first_instance in submaps:
        rows = np.empty(len(submap), _POINT)
        rows["point"], rows["normal"] = submap.placed(T_world_anchor)
        rows["colour"], rows["weight"] = submap.colours, 1 / submap.variances
        rows["instance"] = submap.instances.astype(np.int64) + first_instance
        keys = voxel_keys(rows["point"], BLOCK_VOXELS * voxel_m)
        order = np.argsort(keys, kind="stable")
        keys, rows = keys[order], rows[order]
        starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]][: len(keys)])
        for start, part in zip(starts, np.split(rows, starts[1:]), strict=False):
            path = files.setdefault(int(keys[start]), folder / f"{keys[start]}.points")
            with path.open("ab") as file:
                file.write(part.tobytes())
    return [files[key] for key in sorted(files)]


def merged(
    files: Iterable[Path], voxel_m: float, log_likelihoods: NDArray[np.float32]
) -> Iterator[Cloud]:
    """The cloud of each block that ``spill`` wrote.

    ``log_likelihoods`` (I, C) is the table of all submaps' instances.
    """
    for path in files:
        yield merge(np.fromfile(path, _POINT), voxel_m, log_likelihoods)


def merge(rows: NDArray, voxel_m: float, log_likelihoods: NDArray[np.float32]) -> Cloud:
    """One point a voxel of rows of type _POINT.

    Positions and normals are means weighted by 1 / sigma^2, colours plain means. The variance is
    the least of the voxel's points: their submaps were fused with each other and are no
    independent views. Labels are those of the largest sum of log likelihoods.
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
    labels, probabilities = _fused_labels(voxel, rows["instance"], log_likelihoods, count)
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
    voxel: NDArray, instance: NDArray, log_likelihoods: NDArray[np.float32], count: int
) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """Class (M,) and its probability (M,) by the sum of the log likelihoods of each voxel."""
    ones = np.ones(len(voxel), np.float32)
    seen = csr_matrix((ones, (voxel, instance)), (count, len(log_likelihoods)))
    evidence = np.asarray(seen @ log_likelihoods)
    evidence -= evidence.max(axis=1, keepdims=True)
    probability = np.exp(evidence)
    probability /= probability.sum(axis=1, keepdims=True)
    label = evidence.argmax(axis=1)
    return label.astype(np.uint16), probability[np.arange(count), label].astype(np.float32)
