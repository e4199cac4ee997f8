"""The surface where the distance is zero, as triangles: surface nets (Gibson 1998)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from bmask_slam.graph.arrays import Array, Bytes, Floats, Ints, Mask
from bmask_slam.mapping.surface.blocks import BRICK, EDGE, block_indices, block_keys
from bmask_slam.mapping.surface.volume import COLOUR_VOXELS, SurfaceVolume

CORNERS = np.array(list(product((0, 1), repeat=3)))
EDGES = [(a, b) for a, b in combinations(range(8), 2) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]
AT_ONCE = 1000
MIN_WITNESSES, MAX_FREE_SHARE = 1.0, 0.5
"""A surface needs so many frames that saw it, and at most this share of them saw through it."""
MAX_STEP_VOXELS, MAX_CORNER_VOXELS = 8.0, 0.55
"""Distances in a cell differ by less, and a corner is as near: a plane through a cube passes within
half an edge of a corner, and noise adds a little. Else it is not a surface that a frame saw, but
the limit between what is behind one and what another frame saw as free beside it."""
SMOOTHING, SAME_SIDE_COSINE = 3, np.float32(np.cos(np.radians(30.0)))
"""Normals of neighbours are averaged so often, but not across an edge of more than 30 degrees."""
MIN_COMPONENT_M2, MIN_JUDGE_M2 = 0.005, 0.02
"""Smaller pieces are left out of a surface, and of that of the keyframes alone, by which frames are
judged: what one of them saw of a person, such as a hand, is no surface there."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A surface: at most one vertex in a cell between eight voxels.

    Attributes:
        vertices: (N, 3) float32 in the world, metres, in a fixed order.
        normals: (N, 3) float32 unit vectors out of the surface.
        colours: (N, 3) uint8, red first.
        weights: (N,) float32, sum of 1 / sigma^2 of the frames' distances in 1/cm^2.
        views: (N,) float32, frames that saw it.
        triangles: (M, 3) rows of vertices, counter-clockwise seen from outside.
    """

    vertices: Floats
    normals: Floats
    colours: Bytes
    weights: Floats
    views: Floats
    triangles: Ints

    def select(self, keep: Mask) -> Surface:
        """Some of the vertices (N,), and the triangles between them."""
        number = np.cumsum(keep) - 1
        triangles = number[self.triangles[keep[self.triangles].all(axis=1)]]
        return Surface(
            self.vertices[keep],
            self.normals[keep],
            self.colours[keep],
            self.weights[keep],
            self.views[keep],
            triangles,
        )


_ROWS = np.zeros((0, 3), np.float32)
_NONE = _ROWS[:, 0]
NOTHING = Surface(_ROWS, _ROWS, _ROWS.astype(np.uint8), _NONE, _NONE, _ROWS.astype(np.int64))


def extract(volume: SurfaceVolume, min_witnesses: float = MIN_WITNESSES) -> Surface:
    """The surface of a volume, with all its components; every vertex is in a triangle."""
    return extract_blocks(volume, SortedBlocks.of(volume), min_witnesses)


def extract_blocks(
    volume: SurfaceVolume,
    blocks: SortedBlocks,
    min_witnesses: float,
    chosen: Ints | None = None,
    bounds: tuple[Ints, Ints] | None = None,
) -> Surface:
    """The surface in the ``chosen`` blocks (N,), rows of ``blocks``; None: in all.

    Of these only the triangles that begin in cells from an index (3,) up to another; None: all.
    """
    chosen = np.arange(len(blocks.places)) if chosen is None else chosen
    if not len(chosen):
        return NOTHING
    parts = [
        _vertices(cells, volume.voxel_m)
        for cells in _blocks_with_halo(volume, blocks, chosen, min_witnesses)
    ]
    rows = [np.concatenate(part) for part in zip(*parts, strict=True)]
    order = np.argsort(rows[4])
    points, colours, weights, views, keys, crossings = (row[order] for row in rows)
    if not len(keys):
        return NOTHING
    triangles = _triangles(keys, crossings)
    normals = _normals(points, triangles)
    if bounds is not None:
        cell = block_indices(torch.from_numpy(keys)).numpy()
        crossings[((cell < bounds[0]) | (cell >= bounds[1])).any(axis=1)] = 0
        triangles = _triangles(keys, crossings)
    found = Surface(points, normals, colours, weights, views, triangles)
    found = found.select(found.views >= min_witnesses)
    return found.select(_used(found))


def without_crumbs(surface: Surface, voxel_m: float, least_m2: float = MIN_COMPONENT_M2) -> Surface:
    """The surface without components smaller than ``least_m2``."""
    count, (a, b, c) = len(surface.vertices), surface.triangles.T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    joined = coo_matrix((np.ones(len(ends[0]), np.int8), ends), (count, count))
    component = connected_components(joined, directed=False)[1]
    size = np.bincount(component[a], minlength=int(component.max(initial=0)) + 1)
    kept = surface.select(size[component] * 0.5 * voxel_m**2 >= least_m2)
    return kept.select(_used(kept))


def _used(surface: Surface) -> Mask:
    """Which vertices (N,) are in a triangle."""
    used = np.zeros(len(surface.vertices), bool)
    used[surface.triangles] = True
    return used


@dataclass(frozen=True, eq=False)
class SortedBlocks:
    """Blocks of a volume by key: ``index`` (B, 3), and their ``places`` (B,) in the tables."""

    index: Ints
    places: Ints

    @classmethod
    def of(cls, volume: SurfaceVolume) -> SortedBlocks:
        keys = volume.keys
        places = np.argsort(keys)
        return cls(block_indices(torch.from_numpy(keys[places])).numpy(), places)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Values at the voxels of blocks and of the next ones beside them, (B, 9, 9, 9).

    Attributes:
        index: (B, 3) of the blocks.
        distance: NaN where it is not known well enough. The others are as in the volume.
    """

    index: Ints
    distance: Floats
    weight: Floats
    witnesses: Floats
    colour: Floats


def _blocks_with_halo(
    volume: SurfaceVolume, blocks: SortedBlocks, chosen: Ints, min_witnesses: float
) -> Iterator[_Cells]:
    """The ``chosen`` blocks (N,), some at a time."""
    places, keys = blocks.places, block_keys(torch.from_numpy(blocks.index)).numpy()
    for start in range(0, len(chosen), AT_ONCE):
        some = blocks.index[chosen[start : start + AT_ONCE]]
        shape = (len(some), *(EDGE + 1,) * 3)
        unknown = np.full(shape, np.nan, np.float32)
        weight, witnesses = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        cells = _Cells(some, unknown, weight, witnesses, np.zeros((*shape, 4), np.float32))
        for corner in CORNERS:
            wanted = block_keys(torch.from_numpy(some + corner)).numpy()
            at = np.searchsorted(keys, wanted).clip(max=len(keys) - 1)
            found = np.flatnonzero(keys[at] == wanted)
            inside = tuple(slice(EDGE * c, EDGE + c) for c in corner)
            _copy(volume, places[at[found]], cells, (found, *inside), min_witnesses)
        yield cells
        volume.release()


def _copy(
    volume: SurfaceVolume, rows: Ints, cells: _Cells, to: tuple[Ints | slice, ...], least: float
) -> None:
    """Copy the voxels of the blocks ``rows`` to where ``to`` says."""
    edges = [s.stop - s.start for s in to[1:] if isinstance(s, slice)]
    distance, weight, witnesses, free = (
        _voxels(table, rows, edges)
        for table in (volume.distance, volume.weight, volume.witnesses, volume.free)
    )
    far = np.abs(distance) > (COLOUR_VOXELS - 0.5) * volume.voxel_m
    sure = (witnesses >= least) & (free <= MAX_FREE_SHARE * witnesses)
    known = (weight > 0) & (sure | far)
    cells.distance[to] = np.where(known, distance, np.nan)
    cells.weight[to], cells.witnesses[to] = weight, witnesses
    cells.colour[to] = _voxels(volume.colour, rows, edges)


def _voxels(table: Tensor, blocks: Ints, edges: list[int]) -> NDArray[np.float32]:
    """Values (M, *edges, ...) of blocks (M,) in the volume's order of bricks.

    ``edges`` are 8, for all voxels along an axis, or 1, for the first.
    """
    rest = table.shape[2:]
    half = EDGE // BRICK
    values = table.reshape(-1, half, half, half, BRICK, BRICK, BRICK, *rest)
    part = [slice(None if edge == EDGE else 1) for edge in edges]
    chosen = values[(slice(None), *part, *part)][torch.from_numpy(blocks)].to(torch.float32)
    order = (0, 1, 4, 2, 5, 3, 6, *range(7, chosen.ndim))
    return np.asarray(chosen.permute(order).reshape(-1, *edges, *rest).numpy())


def _vertices(cells: _Cells, voxel_m: float) -> tuple[NDArray, ...]:
    """Points, colours, weights and views of the cells in which the distance changes its sign
    without a step, their keys (N,), and along which axes (N, 3) it does: 1 from outside to inside,
    -1 back, 0 not at all.

    A vertex is the mean of the points where the edges of its cell are crossed.
    """
    window = [cells.distance[:, i : i + EDGE, j : j + EDGE, k : k + EDGE] for i, j, k in CORNERS]
    low, high, nearest = window[0].copy(), window[0].copy(), np.abs(window[0])
    for value in window[1:]:
        np.minimum(low, value, out=low)  # NaN stays NaN
        np.maximum(high, value, out=high)
        np.minimum(nearest, np.abs(value), out=nearest)
    crossed = (low < 0) & (high >= 0) & (high - low < MAX_STEP_VOXELS * voxel_m)
    crossed &= nearest <= MAX_CORNER_VOXELS * voxel_m
    block, *local = np.nonzero(crossed)
    at = [(block, *(a + c for a, c in zip(local, corner, strict=True))) for corner in CORNERS]
    d: Array = np.stack([cells.distance[a] for a in at], axis=1).astype(float)
    place = _mean_crossing(d)
    origin = cells.index[block] * EDGE + np.stack(local, axis=1)
    share = np.prod(np.where(CORNERS, place[:, None], 1 - place[:, None]), axis=2)
    weight, witnesses = (
        np.stack([table[a] for a in at], axis=1) for table in (cells.weight, cells.witnesses)
    )
    paint = np.stack([cells.colour[a] for a in at], axis=1)
    painted = share * paint[..., 3]
    painted /= np.maximum(painted.sum(axis=1, keepdims=True), 1e-12)
    colours = (painted[..., None] * paint[..., :3]).sum(axis=1)
    inside = d < 0
    crossings = inside[:, (4, 2, 1)].astype(np.int8) - inside[:, :1].astype(np.int8)
    return (
        ((origin + place) * voxel_m).astype(np.float32),
        np.rint(colours).clip(0, 255).astype(np.uint8),
        (share * weight).sum(axis=1).astype(np.float32),
        witnesses.max(axis=1).astype(np.float32),
        block_keys(torch.from_numpy(origin)).numpy(),
        crossings,
    )


def _mean_crossing(d: Array) -> Array:
    """The mean (N, 3) of the zeros on the edges of unit cubes with corner values (N, 8)."""
    total, count = np.zeros((len(d), 3)), np.zeros((len(d), 1))
    for a, b in EDGES:
        crossed = (d[:, a] < 0) != (d[:, b] < 0)
        t = d[crossed, a] / (d[crossed, a] - d[crossed, b])
        total[crossed] += CORNERS[a] + t[:, None] * (CORNERS[b] - CORNERS[a])
        count[crossed] += 1
    return total / count


def _normals(vertices: Floats, triangles: Ints) -> Floats:
    """Unit normals (N, 3): means of the triangles' around a vertex, weighted by their areas, then
    SMOOTHING times means with those of its neighbours that are on the same side of an edge."""
    a, b, c = (vertices[triangles[:, k]].astype(float) for k in range(3))
    areas, corners = np.tile(np.cross(b - a, c - a), (3, 1)), triangles.T.reshape(-1)
    found = np.stack([np.bincount(corners, area, len(vertices)) for area in areas.T], axis=1)
    length = np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)
    normals: Floats = (found / length).astype(np.float32)
    ends = corners, triangles[:, (1, 2, 0)].T.reshape(-1)
    for _ in range(SMOOTHING):
        cosines = np.einsum("ij,ij->i", normals[ends[0]], normals[ends[1]])
        weights = np.maximum(cosines - SAME_SIDE_COSINE, 0) / (1 - SAME_SIDE_COSINE)
        beside = coo_matrix((weights, ends), (len(vertices),) * 2).tocsr()
        normals = normals + beside @ normals + beside.T @ normals
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return normals


def _triangles(keys: Ints, crossings: NDArray[np.int8]) -> Ints:
    """Two triangles (M, 3) at each crossed edge, of the vertices of the four cells around it.

    ``keys`` (N,), sorted, and ``crossings`` (N, 3) as ``_vertices`` gives them.
    """
    steps, found = (1 << 42, 1 << 21, 1), []
    for axis in range(3):
        first, second = steps[(axis + 1) % 3], steps[(axis + 2) % 3]
        rows = np.flatnonzero(crossings[:, axis])
        quads = np.empty((len(rows), 4), np.int64)
        complete = np.ones(len(rows), bool)
        for column, step in enumerate((0, first, first + second, second)):
            quads[:, column] = np.searchsorted(keys, keys[rows] - step).clip(max=len(keys) - 1)
            complete &= keys[quads[:, column]] == keys[rows] - step
        quads, sign = quads[complete], crossings[rows[complete], axis]
        quads[sign > 0] = quads[sign > 0][:, ::-1]
        found += [quads[:, :3], quads[:, (0, 2, 3)]]
    return np.concatenate(found)
