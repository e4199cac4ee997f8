"""Sightings of fiducial markers: what they say of a marker's pose, how far the map can differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import (
    MARKER,
    RelativePose,
    marker_id,
    marker_of,
    site_id,
)
from bmask_slam.graph.geometry import adjoint, inverse, so3_log
from bmask_slam.graph.sensors.markers import MarkerPose
from bmask_slam.sensing.reference_frame import Made
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

DIFFERENCE = 10.0
"""Of chi-square, between the two poses that a square may have, before one is believed."""
TURN_RAD = 0.2
"""By so much the rotation of a marker may differ from that in the map, where one of two is chosen.
"""
MIN_SHARED = 15
"""Keyframes that share so many landmarks cannot have drifted apart but by the way between them."""


class Verdict(IntEnum):
    """Why a sighting is no factor; the number is kept with its name among what was made."""

    AMBIGUOUS = 1
    NO_SQUARE = 2
    MOVED = 3


WORDS = {
    Verdict.AMBIGUOUS: "may have two poses",
    Verdict.NO_SQUARE: "do not fit a square of this size",
    Verdict.MOVED: "are not at the marker's place",
}


class Drifting(Protocol):
    """Says how uncertain the map is over a path."""

    def map_covariances(self, paths: Array) -> Array:
        """Covariances (..., 6, 6) over paths (..., 2) in rad and metres."""


@dataclass(frozen=True)
class Sighting:
    """A marker in a keyframe: the factor that it may become, and what it says."""

    factor: RelativePose
    log_size: float
    log_size_sigma: float
    error: Array
    """(6,) of the marker's pose in the map, at the camera; zeros where it is new."""

    @property
    def marker(self) -> int:
        """The marker's number."""
        found = marker_of(self.factor.keyframe_a)
        assert found is not None
        return found[1]


@dataclass(frozen=True)
class MarkerSight:
    """What the fusion looks at: the map, the graph, how the map drifts, and what was made."""

    world: WorldMap
    tables: FactorTables
    drift: Drifting
    made: Made


def sightings_of(tables: FactorTables, key: int) -> list[RelativePose]:
    """The factors of a marker's sightings, the oldest first."""
    factors = (tables.pose_factors[n].factor for n in tables.numbers_of_keyframes([key]))
    found = [f for f in factors if isinstance(f, RelativePose) and f.kind == MARKER]
    return sorted(found, key=lambda f: f.keyframe_b)


def only_witnesses(tables: FactorTables) -> set[int]:
    """Keyframes that are the only ones to see a marker: without them it would be lost."""
    seen = [sightings_of(tables, key) for key in markers_in(tables)]
    return {found[0].keyframe_b for found in seen if len(found) == 1}


def markers_in(tables: FactorTables) -> list[int]:
    """Ids of the markers in the graph, of all map segments."""
    ids = tables.keyframes.ids
    begin, end = np.searchsorted(ids, [marker_id(0, 0), site_id(0)])
    return ids[begin:end].tolist()


def has(tables: FactorTables, key: int) -> bool:
    """Whether the graph has a pose."""
    return bool(tables.keyframes.contains(np.array([key])).all())


def place_of(tables: FactorTables, key: int) -> Array | None:
    """The estimate (4, 4) of a pose, None where the graph has none."""
    return tables.keyframes.get(np.array([key]))[0] if has(tables, key) else None


def of_keyframes(keyframes: Sequence[Keyframe], rows: Array) -> Iterator[tuple[Keyframe, Array]]:
    """The rows of each keyframe's stamp."""
    stamps_s = np.array([k.timestamp_s for k in keyframes])
    first, end = (np.searchsorted(rows[:, 0], stamps_s, side) for side in ("left", "right"))
    for keyframe, i, j in zip(keyframes, first.tolist(), end.tolist(), strict=True):
        for row in rows[i:j]:
            yield keyframe, row


def chosen(poses: Sequence[MarkerPose], expected: Array | None) -> MarkerPose | None:
    """The pose that fits clearly better, with the map where that knows the marker."""
    scores = np.array([pose.chi2 for pose in poses])
    if expected is not None:
        off = np.array([inverse(p.T_marker_camera)[:3, :3] @ expected[:3, :3] for p in poses])
        turned_rad = np.linalg.norm(so3_log(off), axis=1)
        scores = scores + (turned_rad / TURN_RAD) ** 2
    order = np.argsort(scores)
    clear = len(order) == 1 or scores[order[1]] - scores[order[0]] > DIFFERENCE
    if not clear:
        first, second = (poses[k].T_marker_camera for k in order[:2])
        clear = bool(np.linalg.norm(so3_log(first[:3, :3].T @ second[:3, :3])) < 1e-3)
    return poses[order[0]] if clear else None


def spread(earlier: Sequence[RelativePose], T_marker_camera: Array) -> Array:
    """Covariance (6, 6) that a marker's own pose adds at a camera, by earlier sightings."""
    information = np.zeros((6, 6))
    for factor in earlier:
        A = adjoint(factor.T_a_b)
        information += np.linalg.inv(A @ factor.covariance @ A.T)
    A = adjoint(inverse(T_marker_camera))
    S = A @ np.linalg.inv(information) @ A.T
    return np.asarray((S + S.T) / 2)


def drift_path(sight: MarkerSight, start: int, ends: Sequence[int]) -> Array:
    """Radians and metres (2,) over which the map can have drifted from a keyframe to the nearest.

    From keyframe to keyframe of the segment: those that share ``MIN_SHARED`` landmarks, and each
    to the next. Between keyframes that see the same marker there is no drift.
    """
    keyframes = sight.world.in_segment(sight.world.keyframes[start].segment)
    ids = np.array([k.id for k in keyframes])
    poses = np.array([k.T_world_camera for k in keyframes])
    held = _by_marker(sight.tables, ids)
    edges = np.concatenate([held, _covisible(keyframes)])
    edges = edges[np.sort(np.unique(edges, axis=0, return_index=True)[1])]
    steps = inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    turned_rad = np.linalg.norm(so3_log(steps[:, :3, :3]), axis=1)
    moved_m = np.linalg.norm(steps[:, :3, 3], axis=1)
    at_once = {(a, b) for a, b in held.tolist()}
    lengths = 1e-6 + turned_rad + moved_m
    lengths[[tuple(edge) in at_once for edge in edges.tolist()]] = 1e-6
    graph = csr_array((lengths, edges.T), (len(ids), len(ids)))
    begin = int(np.searchsorted(ids, start))
    reached, before = dijkstra(graph, directed=False, indices=begin, return_predecessors=True)
    targets = np.searchsorted(ids, np.intersect1d(ids, list(ends)))
    at, path = int(targets[np.argmin(reached[targets])]), np.zeros(2)
    while at != begin:
        last = int(before[at])
        if (min(last, at), max(last, at)) not in at_once:
            step = inverse(poses[last]) @ poses[at]
            path += np.linalg.norm(so3_log(step[:3, :3])), np.linalg.norm(step[:3, 3])
        at = last
    return path


def _by_marker(tables: FactorTables, ids: Ints) -> Ints:
    """Pairs (N, 2) of places in ids (K,), ascending: keyframes that see one marker in a row."""
    pairs = [np.zeros((0, 2), np.int64)]
    for key in markers_in(tables):
        seen = np.array([f.keyframe_b for f in sightings_of(tables, key)], np.int64)
        places = np.searchsorted(ids, np.intersect1d(seen, ids))
        pairs.append(np.stack([places[:-1], places[1:]], axis=1))
    return np.concatenate(pairs)


def _covisible(keyframes: Sequence[Keyframe]) -> Ints:
    """Pairs (N, 2) of places: keyframes in a row, and those with enough landmarks in common."""
    rows = np.repeat(np.arange(len(keyframes)), [len(k.landmark_ids) for k in keyframes])
    seen = np.concatenate([k.landmark_ids for k in keyframes])
    rows, seen = rows[seen >= 0], seen[seen >= 0]
    shape = len(keyframes), int(seen.max(initial=-1)) + 1
    sees = coo_array((np.ones(len(rows), np.int32), (rows, seen)), shape).tocsr()
    shared = (sees @ sees.T).tocoo()
    strong = (shared.data >= MIN_SHARED) & (shared.row < shared.col)
    following = np.arange(len(keyframes) - 1)
    row = np.stack([following, following + 1], axis=1)
    pairs = np.stack([shared.row[strong], shared.col[strong]], axis=1)
    return np.unique(np.concatenate([row, pairs]).astype(np.int64), axis=0)
