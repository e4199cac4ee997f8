"""Small holes of a surface, closed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.mapping.surface.extraction import Surface

MAX_BORDER_M = 0.16
"""Longest border of a hole that is closed: of one 5 cm across. The outer border of the smallest
piece of a surface (`extraction.MIN_COMPONENT_M2`) is longer."""


def close_holes(surface: Surface, most_m: float = MAX_BORDER_M) -> Surface:
    """The surface with its holes closed whose borders are at most ``most_m`` metres long.

    Each gets a vertex in the middle of its border, with the normal of the new triangles: as
    uncertain as the border's least certain vertex, with ``views`` 0, since no frame saw it.
    """
    border, count = _border(surface), len(surface.vertices)
    ends = surface.vertices[border]
    joined = coo_matrix((np.ones(len(border), np.int8), tuple(border.T)), (count, count))
    hole = connected_components(joined, directed=False)[1][border[:, 0]]
    around_m = np.bincount(hole, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), minlength=1)
    begun, ended = (np.bincount(border[:, k], minlength=count) for k in (0, 1))
    no_ring = np.bincount(hole, (begun != ended)[border].any(axis=1), minlength=1) > 0
    border, hole = (rows[((around_m <= most_m) & ~no_ring)[hole]] for rows in (border, hole))
    if not len(border):
        return surface
    which, hole = np.unique(hole, return_inverse=True)

    def sums(rows: NDArray[Any]) -> Array:
        return np.stack([np.bincount(hole, column) for column in rows.T.astype(float)], axis=1)

    length = np.bincount(hole)[:, None]
    middle = sums(surface.vertices[border[:, 0]]) / length
    first, second = (surface.vertices[border[:, k]] - middle[hole] for k in (1, 0))
    normals = sums(np.cross(first, second))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)  # 0 of no area
    weights = np.full(len(which), np.inf, np.float32)
    np.minimum.at(weights, hole, surface.weights[border[:, 0]])
    return Surface(
        _extended(surface.vertices, middle),
        _extended(surface.normals, normals),
        _extended(surface.colours, np.rint(sums(surface.colours[border[:, 0]]) / length)),
        _extended(surface.weights, weights),
        _extended(surface.views, np.zeros(len(which))),
        _extended(surface.triangles, np.column_stack([border[:, ::-1], count + hole])),
    )


def _extended(column: NDArray[Any], more: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([column, more.astype(column.dtype)])


def _border(surface: Surface) -> Ints:
    """Edges (E, 2) of only one triangle, in its direction."""
    a, b, c = surface.triangles.T
    count = len(surface.vertices)
    ends = np.concatenate([a, b, c]), np.concatenate([b, c, a])
    uses = coo_matrix((np.ones(len(ends[0]), np.int8), ends), (count, count)).tocsr()
    left = (uses - uses.T).tocoo()
    alone = left.data > 0
    return np.column_stack([left.row[alone], left.col[alone]]).astype(np.int64)
