"""Files of maps to drive on: nav2's PGM and YAML, OctoMap's binary trees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.graph.files.yaml_file import format_yaml
from bmask_slam.mapping.products.occupancy import (
    FREE,
    LIMIT,
    OCCUPIED,
    OccupancyGrid,
    VoxelMap,
)

BLACK, WHITE, GREY = 0, 254, 205
"""Grey values of occupied, free and unknown cells, as map_server has them."""
OCCUPIED_SHARE, FREE_SHARE = 0.65, 0.196
"""A cell is occupied from (255 - value) / 255 of the first on, and free up to the second. The
grey of unknown is 0.19608: with 0.25, as map_saver writes, some loaders take it for free."""
LEVELS = 16
_FREE_LEAF, _OCCUPIED_LEAF, _INNER = 1, 2, 3
_ALL_FREE, _ALL_OCCUPIED = 0x5555, 0xAAAA
"""Bits of a child in OctoMap's binary format, the first bit of two being the lower; 0: unknown."""


def write_nav2(
    path: Path, grid: OccupancyGrid, T_map_world: Array, comment: str = ""
) -> tuple[Path, Path]:
    """Write NAME.yaml and NAME.pgm, which nav2's and ROS 1's map_server load.

    The image's upper row is the largest y. ``T_map_world`` is kept in the YAML under a key of its
    own, which map_server ignores, and a ``comment`` of one line at the top.
    """
    yaml, pgm = path.with_suffix(".yaml"), path.with_suffix(".pgm")
    values: NDArray[np.uint8] = np.full_like(grid.cells, GREY, np.uint8)
    values[grid.cells == FREE] = WHITE
    values[grid.cells == OCCUPIED] = BLACK
    height, width = values.shape
    with whole_file(pgm) as temporary:
        temporary.write_bytes(f"P5\n{width} {height}\n255\n".encode() + values[::-1].tobytes())
    content = {
        "image": pgm.name,
        "mode": "trinary",
        "resolution": float(grid.resolution_m),
        "origin": [round(float(grid.origin_m[0]), 6), round(float(grid.origin_m[1]), 6), 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_SHARE,
        "free_thresh": FREE_SHARE,
        "bmask_slam_T_map_world": np.round(T_map_world, 9).tolist(),
    }
    head = f"# {comment}\n" if comment else ""
    with whole_file(yaml) as temporary:
        temporary.write_text(head + format_yaml(content), encoding="utf-8")
    return yaml, pgm


def write_octomap(path: Path, voxels: VoxelMap) -> int:
    """Write a binary OctoMap (.bt); returns the number of nodes of the tree.

    Eight children that are all free or all occupied are one leaf. The format: a text header, then
    the inner nodes, parents first, each as two bits for each of its eight children; child number
    ``x + 2 y + 4 z`` (Hornung et al., OctoMap, Autonomous Robots 2013).
    """
    codes = _morton(voxels.keys + LIMIT)
    order = np.argsort(codes)
    codes = codes[order]
    kinds = np.where(voxels.occupied[order], _OCCUPIED_LEAF, _FREE_LEAF)
    nodes, begins, depths, words = 1, [], [], []
    for depth in range(LEVELS - 1, -1, -1):
        nodes += len(codes)
        parents, owner = np.unique(codes >> 3, return_inverse=True)
        word = np.zeros(len(parents), np.int64)
        np.add.at(word, owner, kinds << 2 * (codes & 7))
        alike = np.full(len(parents), _INNER)
        alike[word == _ALL_FREE], alike[word == _ALL_OCCUPIED] = _FREE_LEAF, _OCCUPIED_LEAF
        if depth == 0:
            alike[:] = _INNER  # the root has children
        inner = alike == _INNER
        nodes -= 8 * int((~inner).sum())
        begins.append(parents[inner] << 3 * (LEVELS - depth))
        depths.append(np.full(int(inner.sum()), depth))
        words.append(word[inner])
        codes, kinds = parents, alike
    order = np.lexsort((np.concatenate(depths), np.concatenate(begins)))
    data = np.concatenate(words)[order].astype("<u2").tobytes()
    head = (
        "# Octomap OcTree binary file\n# (feel free to add / change comments, but leave the first "
        f"line as it is!)\n#\nid OcTree\nsize {nodes}\nres {voxels.resolution_m:.9g}\ndata\n"
    )
    with whole_file(path) as temporary:
        temporary.write_bytes(head.encode() + data)
    return nodes


def _morton(keys: Ints) -> Ints:
    """Interleaved bits (N,) of whole numbers (N, 3) below 2^16: x is the lowest bit of three."""
    codes = np.zeros(len(keys), np.int64)
    for bit in range(LEVELS):
        for axis in range(3):
            codes |= (keys[:, axis].astype(np.int64) >> bit & 1) << (3 * bit + axis)
    return codes
