"""A growing surface part by part: what has changed is extracted anew, for a viewer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from bmask_slam.graph.arrays import Bytes, Floats, Ints
from bmask_slam.mapping.surface.blocks import EDGE, block_indices, block_keys
from bmask_slam.mapping.surface.extraction import (
    CORNERS,
    MIN_WITNESSES,
    SortedBlocks,
    Surface,
    extract_blocks,
)
from bmask_slam.mapping.surface.volume import SurfaceVolume

BLOCKS = 8
"""Edge of a region in blocks."""
Region = tuple[int, int, int]
"""A cube of BLOCKS^3 blocks, whose first block has BLOCKS times this index."""


@dataclass(frozen=True, eq=False)
class SurfacePart:
    """The surface in a region, in place of what was known of it before.

    Attributes:
        region: its index.
        vertices: (N, 3) float32 in the world, metres; none if there is no surface any more.
        normals: (N, 3) float32 unit vectors out of the surface.
        colours: (N, 3) uint8, red first.
        triangles: (M, 3) int32 rows of vertices, counter-clockwise seen from outside.
    """

    region: Region
    vertices: Floats
    normals: Floats
    colours: Bytes
    triangles: Ints


def regions_of(keys: Ints) -> set[Region]:
    """The regions whose parts change with blocks that have these keys (B,).

    A block at the border of a region also gives the next ones their vertices there: two at a face,
    four at an edge, eight at a corner.
    """
    around = block_indices(torch.from_numpy(keys))[:, None] + torch.from_numpy(2 * CORNERS - 1)
    regions = torch.div(around, BLOCKS, rounding_mode="floor").reshape(-1, 3)
    found = block_indices(torch.unique(block_keys(regions)))  # numbers are faster than rows
    return {(x, y, z) for x, y, z in found.tolist()}


def extract_region(
    volume: SurfaceVolume, region: Region, min_witnesses: float = MIN_WITNESSES
) -> Surface:
    """What `extraction.extract` finds in a region; the surfaces of all regions fit together.

    Vertices at the border of two regions are in both, with the same normals.
    """
    blocks, low = SortedBlocks.of(volume), BLOCKS * np.array(region)
    near = ((blocks.index >= low - 1) & (blocks.index <= low + BLOCKS)).all(axis=1)
    bounds = EDGE * low, EDGE * (low + BLOCKS)
    return extract_blocks(volume, blocks, min_witnesses, np.flatnonzero(near), bounds)


def as_part(region: Region, surface: Surface, cell_m: float) -> SurfacePart:
    """A surface with one vertex in a cell of this edge: the mean of those that are in it."""
    cell = np.floor(surface.vertices / cell_m).astype(np.int64)
    keys = block_keys(torch.from_numpy(cell)).numpy()
    which, counts = np.unique(keys, return_inverse=True, return_counts=True)[1:]
    columns = np.column_stack((surface.vertices, surface.normals, surface.colours)).astype(float)
    sums = np.column_stack([np.bincount(which, c, len(counts)) for c in columns.T])
    means = sums / np.maximum(counts, 1)[:, None]
    normals = means[:, 3:6] / np.maximum(np.linalg.norm(means[:, 3:6], axis=1), 1e-12)[:, None]
    corners = which[surface.triangles].reshape(-1, 3)
    a, b, c = corners.T
    return SurfacePart(
        region,
        means[:, :3].astype(np.float32),
        normals.astype(np.float32),
        np.rint(means[:, 6:]).astype(np.uint8),
        corners[(a != b) & (b != c) & (c != a)].astype(np.int32),
    )
