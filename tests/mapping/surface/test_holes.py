"""Small holes are closed, by what lies on the surface and says that nobody saw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.mapping.surface.extraction import NOTHING, Surface
from bmask_slam.mapping.surface.holes import close_holes

EDGE, STEP_M, RADIUS_M = 24, 0.01, 0.5


def sheet(gone: Mask | None = None) -> Surface:
    """A piece of a sphere around the origin, seen from outside, without the vertices ``gone``."""
    rows, columns = np.mgrid[:EDGE, :EDGE].reshape(2, -1)
    x, y = (STEP_M * (k - EDGE / 2) for k in (columns, rows))
    vertices = np.stack([x, y, np.sqrt(RADIUS_M**2 - x**2 - y**2)], axis=1)
    first = np.flatnonzero((rows < EDGE - 1) & (columns < EDGE - 1))
    quads = first[:, None] + [0, 1, EDGE + 1, EDGE]
    triangles = np.concatenate([quads[:, :3], quads[:, (0, 2, 3)]])
    count = len(vertices)
    whole = Surface(
        vertices.astype(np.float32),
        (vertices / RADIUS_M).astype(np.float32),
        np.full((count, 3), 90, np.uint8),
        np.arange(1, count + 1, dtype=np.float32),
        np.full(count, 7.0, np.float32),
        triangles,
    )
    return whole if gone is None else whole.select(~gone)


def square(row: int, column: int, edge: int) -> Mask:
    gone = np.zeros((EDGE, EDGE), bool)
    gone[row : row + edge, column : column + edge] = True
    return gone.reshape(-1)


def border(triangles: Ints) -> set[tuple[int, int]]:
    """Edges of one triangle only; an edge must not be used twice in the same direction."""
    edges = triangles[:, (0, 1, 1, 2, 2, 0)].reshape(-1, 2).tolist()
    directed = {(a, b) for a, b in edges}
    assert len(directed) == len(edges)
    return {(a, b) for a, b in directed if (b, a) not in directed}


def outward(surface: Surface, some: slice) -> Array:
    """Cosines between the normals of triangles and the direction from the origin."""
    a, b, c = (surface.vertices[surface.triangles[some, k]].astype(float) for k in range(3))
    normals = np.cross(b - a, c - a)
    directions = (a + b + c) / np.linalg.norm(a + b + c, axis=1, keepdims=True)
    return (normals * directions).sum(axis=1) / np.linalg.norm(normals, axis=1)


@pytest.mark.parametrize("edge", [1, 2, 3])
def test_a_small_hole_is_closed_on_the_surface(edge: int) -> None:
    open_sheet, outer = sheet(square(9, 12, edge)), len(border(sheet().triangles))
    closed = close_holes(open_sheet)
    count = len(open_sheet.vertices)
    assert len(border(open_sheet.triangles)) > outer
    assert len(border(closed.triangles)) == outer
    assert len(closed.vertices) == count + 1
    assert np.linalg.norm(closed.vertices[-1]) == pytest.approx(RADIUS_M, abs=0.002)
    assert closed.normals[-1] @ closed.vertices[-1] / RADIUS_M > 0.99
    assert outward(closed, slice(len(open_sheet.triangles), None)).min() > 0.95
    assert closed.colours[-1].tolist() == [90, 90, 90]
    for name in ("vertices", "normals", "colours", "weights", "views", "triangles"):
        before, after = getattr(open_sheet, name), getattr(closed, name)
        assert after.dtype == before.dtype
        np.testing.assert_array_equal(after[: len(before)], before)


def test_what_closes_a_hole_is_as_uncertain_as_its_border_and_unseen() -> None:
    gone = square(9, 12, 1)
    closed = close_holes(sheet(gone))
    around = square(8, 11, 3) & ~gone
    assert closed.weights[-1] == sheet().weights[around].min()
    assert closed.views[-1] == 0


def test_holes_that_touch_are_closed_together() -> None:
    gone = square(4, 4, 1) | square(6, 6, 1) | square(14, 14, 1)
    closed = close_holes(sheet(gone))
    assert len(closed.vertices) == EDGE**2 - 3 + 2
    edges = closed.triangles[:, (0, 1, 1, 2, 2, 0)].reshape(-1, 2)
    uses = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]
    assert (uses == 1).sum() == 4 * (EDGE - 1)


def test_large_holes_and_the_outer_border_stay() -> None:
    open_sheet = sheet(square(9, 12, 6))
    assert close_holes(open_sheet) is open_sheet
    assert close_holes(sheet(square(9, 12, 6)), most_m=0.4).views[-1] == 0
    assert close_holes(NOTHING) is NOTHING


def test_what_is_no_ring_stays() -> None:
    """Three triangles at an edge, two of them in its direction: no border leads around anything."""
    whole = sheet()
    fan = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    book = replace(whole, triangles=fan)
    assert close_holes(book) is book


def test_a_hole_without_an_area_gets_no_normal_of_nan() -> None:
    whole, gone = sheet(), square(5, 5, 1)
    ring = np.flatnonzero(square(4, 4, 3) & ~gone)
    vertices = whole.vertices.copy()
    vertices[ring] = vertices[ring[0]] + 0.001 * np.arange(len(ring))[:, None] * [1, 0, 0]
    found = close_holes(replace(whole, vertices=vertices).select(~gone))
    assert len(found.vertices) == len(vertices)  # one for that which is gone
    assert np.isfinite(found.normals).all()
