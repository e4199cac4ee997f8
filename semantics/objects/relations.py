"""How objects are to each other in space: on, under, inside, beside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.semantics.objects.boxes3d import OrientedBox

ON, UNDER, INSIDE, BESIDE = "on", "under", "inside", "beside"
RELATIONS = (ON, UNDER, INSIDE, BESIDE)
TOUCHING_M, SUNK_M = 0.08, 0.15
"""A thing stands on another if its bottom is so little above, or so little below, the other's top:
a table's box reaches up to what lies on it."""
COVERED, CONTAINED, NEAR_M = 0.5, 0.8, 0.5
_SIDE = 12


@dataclass(frozen=True)
class Relation:
    """The thing of index ``subject`` is ``kind`` (one of RELATIONS) the one of index ``object``."""

    subject: int
    kind: str
    object: int


def relations(boxes: Sequence[OrientedBox], up_world: Array) -> list[Relation]:
    """All relations between upright boxes, by subject and object.

    A thing is on another (which it covers by half of its ground area, from above) or under it
    (below its bottom), inside it (with most of its volume), or else beside it, if their heights
    overlap and there are less than NEAR_M between them. Of a pair beside each other both are
    listed, of the others each way that holds.
    """
    spans = [_span(box, up_world) for box in boxes]
    found = []
    for a in range(len(boxes)):
        for b in range(len(boxes)):
            if a != b and (kind := _relation(boxes[a], boxes[b], spans[a], spans[b], up_world)):
                found.append(Relation(a, kind, b))
    return found


def _relation(
    a: OrientedBox, b: OrientedBox, span_a: Array, span_b: Array, up_world: Array
) -> str | None:
    points = _filled(a)
    if b.contains(points).mean() >= CONTAINED and span_a[0] < span_b[1] - SUNK_M:
        return INSIDE
    covered = _over(b, points, up_world).mean()
    if covered >= COVERED and -SUNK_M <= span_a[0] - span_b[1] <= TOUCHING_M:
        return ON
    if covered >= COVERED and span_a[1] <= span_b[0] + TOUCHING_M:
        return UNDER
    overlap_m = min(span_a[1], span_b[1]) - max(span_a[0], span_b[0])
    near = overlap_m > 0 and _gap_m(points, b) < NEAR_M
    back = _over(a, _filled(b), up_world).mean() >= COVERED
    within = a.contains(_filled(b)).mean() >= CONTAINED
    return BESIDE if near and not back and not within and covered < COVERED else None


def distance_m(box: OrientedBox, point_world: Array) -> float:
    """The distance of a point (3,) from a box, 0 inside."""
    return float(_outside_m(box, point_world[None])[0])


def _gap_m(points_world: Array, box: OrientedBox) -> float:
    return float(_outside_m(box, points_world).min())


def _outside_m(box: OrientedBox, points_world: Array) -> Array:
    """Distances (N,) of points (N, 3) from a box."""
    local = (points_world - box.T_world_box[:3, 3]) @ box.T_world_box[:3, :3]
    beyond = np.maximum(np.abs(local) - 0.5 * box.size_m, 0)
    return np.asarray(np.linalg.norm(beyond, axis=1))


def _over(box: OrientedBox, points_world: Array, up_world: Array) -> Mask:
    """Which points (N, 3) are over or under a box's ground area."""
    level = points_world - np.outer((points_world - box.T_world_box[:3, 3]) @ up_world, up_world)
    return box.contains(level)


def _span(box: OrientedBox, up_world: Array) -> Array:
    """The heights (2,) of a box's bottom and top."""
    heights = box.corners_world @ up_world
    return np.array([heights.min(), heights.max()])


def _filled(box: OrientedBox) -> Array:
    """A grid of points (N, 3) in a box, its faces included."""
    steps = np.linspace(-0.5, 0.5, _SIDE)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return box.in_world(grid * box.size_m)
