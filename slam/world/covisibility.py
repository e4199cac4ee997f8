"""Ways through a map over keyframes that see the same landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.geometry import step_lengths
from bmask_slam.world.world_map import WorldMap

MIN_SHARED = 15
"""Keyframes are neighbours if they share so many landmarks, or follow each other in a segment."""
METRES_PER_RAD = 1.0
"""As much path counts a turn when ways are compared."""
FEW = 0.1
"""Share of the keyframes up to which those that changed are counted one by one, not all at once."""
NONE = np.zeros(0, np.int64)
_BASE = 1 << 32
"""A pair of keyframes is one number: the id of the older times this, plus that of the newer."""


class Way(NamedTuple):
    """A way through a map.

    Attributes:
        poses: T_world_camera (N, 4, 4) of the keyframes on it; N = 0: there is none.
        shared: landmarks (N - 1,) that the two keyframes of each step have in common.
    """

    poses: Array
    shared: Ints


@dataclass(frozen=True, eq=False)
class _Steps:
    """Pairs (P,) of neighbours, ascending, among K keyframes: landmarks shared, and costs.

    Those that only follow each other in a segment share 0 here.
    """

    ids: Ints
    poses: Array
    pairs: Ints
    shared: Ints
    costs: Array

    @property
    def cost_matrix(self) -> csr_array:
        """(K, K), of each pair one way alone."""
        ends = np.searchsorted(self.ids, np.divmod(self.pairs, _BASE))
        return csr_array((self.costs, tuple(ends)), (len(self.ids), len(self.ids)))


class Neighbours:
    """Which keyframes of a map are neighbours, and what a step from one to the other costs.

    From one question to the next it counts and measures again only what changed since: keyframes
    whose observations changed, and those that moved. It answers as a new one would.
    """

    def __init__(self) -> None:
        """Nothing is known before the first question."""
        self._revisions: dict[int, int] = {}
        self._in_map = np.zeros(0, bool)
        self._strong, self._shared = NONE, NONE  # pairs that share enough landmarks, and how many
        self._last = _Steps(NONE, np.zeros((0, 4, 4)), NONE, NONE, np.zeros(0))

    def steps(self, world: WorldMap) -> _Steps:
        """What a map's keyframes are to each other now."""
        ids = np.fromiter(world.keyframes, np.int64)
        poses = np.array([k.T_world_camera for k in world.keyframes.values()])
        self._count(world)
        pairs = np.union1d(self._strong, _consecutive(world, ids))
        first, second = np.searchsorted(ids, np.divmod(pairs, _BASE))
        last = self._last
        known, before = _found(pairs, last.pairs)
        stays, there = _found(ids, last.ids)
        stays[stays] = (poses[stays] == last.poses[there[stays]]).all(axis=(1, 2))
        known &= stays[first] & stays[second]
        costs = np.empty(len(pairs))
        costs[known] = last.costs[before[known]]
        lengths = step_lengths(poses[first[~known]], poses[second[~known]])
        costs[~known] = lengths @ [METRES_PER_RAD, 1.0] + 1e-9  # a cost of 0 would be no step
        shared = np.zeros(len(pairs), np.int64)
        shared[np.searchsorted(pairs, self._strong)] = self._shared
        self._last = _Steps(ids, poses, pairs, shared, costs)
        return self._last

    def _count(self, world: WorldMap) -> None:
        """Find the pairs that share MIN_SHARED landmarks, and how many."""
        revisions = {k.id: k.revision for k in world.keyframes.values()}
        changed = {k for k, revision in revisions.items() if self._revisions.get(k) != revision}
        in_map = world.landmarks.in_map
        removed = np.flatnonzero(self._in_map & ~in_map[: len(self._in_map)])
        changed |= {k.id for k in world.observing(removed)}
        if len(changed) > FEW * len(revisions):
            self._strong, self._shared = _all_pairs(world)
        else:
            stale = np.zeros(world.next_keyframe_id, bool)
            stale[[*changed, *(self._revisions.keys() - revisions.keys())]] = True
            kept = ~stale[np.stack(np.divmod(self._strong, _BASE))].any(axis=0)
            new = _pairs_of(sorted(changed), world)
            pairs = np.concatenate([self._strong[kept], new[0]])
            self._strong, rows = np.unique(pairs, return_index=True)
            self._shared = np.concatenate([self._shared[kept], new[1]])[rows]
        self._revisions, self._in_map = revisions, in_map.copy()


class CovisiblePaths:
    """The shortest ways between the keyframes of a map as it is now.

    A place that was seen again by its own landmarks ends the drift that was gathered since: between
    two rooms the map can drift on the way from door to door, however long each was walked through.
    """

    def __init__(self, world: WorldMap, neighbours: Neighbours | None = None) -> None:
        """Nothing is computed before the first way is asked for."""
        self._world, self._neighbours = world, neighbours or Neighbours()
        self._before: dict[int, Ints] = {}  # of each b, the keyframe before each on the way from it

    def way(self, a: int, b: int) -> Way:
        """The shortest way from keyframe a to b."""
        ids = self._steps.ids
        here, source = np.searchsorted(ids, [a, b]).tolist()
        if source not in self._before:
            found = dijkstra(self._costs, directed=False, indices=source, return_predecessors=True)
            self._before[source] = found[1]
        before = self._before[source]
        if here != source and before[here] < 0:
            return Way(self._steps.poses[:0], NONE)
        way = [here]
        while way[-1] != source:
            way.append(int(before[way[-1]]))
        return Way(self._steps.poses[way], self._shared_by(ids[way]))

    def length_m(self, a: int, b: int) -> float:
        """Metres of the shortest way between keyframes; inf if there is none."""
        way = self.way(a, b).poses
        steps = np.diff(way[:, :3, 3], axis=0)
        return float(np.linalg.norm(steps, axis=1).sum()) if len(way) else np.inf

    def _shared_by(self, ids: Ints) -> Ints:
        """Landmarks (N - 1,) that each two of N keyframes in turn have in common."""
        pairs = np.minimum(ids[:-1], ids[1:]) * _BASE + np.maximum(ids[:-1], ids[1:])
        shared = self._steps.shared[np.searchsorted(self._steps.pairs, pairs)]
        for k in np.flatnonzero(shared == 0).tolist():  # not counted before
            ends = (self._world.keyframes[end] for end in ids[k : k + 2].tolist())
            seen, again = (self._world.observed(keyframe)[1] for keyframe in ends)
            shared[k] = len(np.intersect1d(seen, again))
        return shared

    @cached_property
    def _steps(self) -> _Steps:
        return self._neighbours.steps(self._world)

    @cached_property
    def _costs(self) -> csr_array:
        return self._steps.cost_matrix


def _consecutive(world: WorldMap, ids: Ints) -> Ints:
    """The pairs of keyframes that follow each other in a segment."""
    segments = np.array([k.segment for k in world.keyframes.values()])
    order = np.argsort(segments, kind="stable")
    same = segments[order[1:]] == segments[order[:-1]]
    return ids[order[:-1][same]] * _BASE + ids[order[1:][same]]


def _all_pairs(world: WorldMap) -> tuple[Ints, Ints]:
    """All pairs that share MIN_SHARED landmarks, and how many, by a product of sparse matrices."""
    ids = np.fromiter(world.keyframes, np.int64)
    keypoints = [k.landmark_ids for k in world.keyframes.values()]
    landmarks = np.concatenate(keypoints)
    used = landmarks >= 0
    used[used] = world.landmarks.in_map[landmarks[used]]
    ends = np.cumsum([0, *map(len, keypoints)])  # of each keyframe's, then of those in the map
    ends = np.concatenate([[0], np.cumsum(used)])[ends]
    ones = np.ones(ends[-1], np.int32)
    sees = csr_array((ones, landmarks[used], ends), (len(ids), len(world.landmarks) + 1))
    shared = (sees @ sees.T).tocoo()
    strong = (shared.data >= MIN_SHARED) & (shared.row < shared.col)
    pairs = ids[shared.row[strong]] * _BASE + ids[shared.col[strong]]
    order = np.argsort(pairs)
    return pairs[order], shared.data[strong][order].astype(np.int64)


def _pairs_of(keyframe_ids: list[int], world: WorldMap) -> tuple[Ints, Ints]:
    """The pairs of these keyframes with others that share MIN_SHARED landmarks, and how many."""
    found = []
    for k in keyframe_ids:
        _, landmarks = world.observed(world.keyframes[k])
        others = [(n, o.id) for n, o in world.covisible(landmarks, MIN_SHARED) if o.id != k]
        found += [(min(k, other) * _BASE + max(k, other), n) for n, other in others]
    pairs, shared = np.array(found, np.int64).reshape(-1, 2).T
    return pairs, shared


def _found(values: Ints, among: Ints) -> tuple[Mask, Ints]:
    """Which of the values (N,) are among others, which ascend, and where."""
    places = np.searchsorted(among, values)
    known = places < len(among)
    known[known] = among[places[known]] == values[known]
    return known, places
