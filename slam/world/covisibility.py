"""Ways through a map over keyframes that see the same landmarks."""

from __future__ import annotations

from functools import cached_property

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
_BASE = 1 << 32
"""A pair of keyframes is one number: the id of the older times this, plus that of the newer."""


class Neighbours:
    """Which keyframes of a map are neighbours, and what a step from one to the other costs.

    From one question to the next it counts and measures again only what changed since: keyframes
    whose observations changed, and those that moved. It answers as a new one would.
    """

    def __init__(self) -> None:
        """Nothing is known before the first question."""
        self._revisions: dict[int, int] = {}
        self._in_map = np.zeros(0, bool)
        self._strong = np.zeros(0, np.int64)  # pairs that share enough landmarks
        self._ids, self._poses = np.zeros(0, np.int64), np.zeros((0, 4, 4))
        self._pairs, self._costs = np.zeros(0, np.int64), np.zeros(0)

    def steps(self, world: WorldMap) -> tuple[Ints, Array, csr_array]:
        """Ids (K,), T_world_camera (K, 4, 4), and costs (K, K), of each pair one way alone."""
        ids = np.fromiter(world.keyframes, np.int64)
        poses = np.array([k.T_world_camera for k in world.keyframes.values()])
        self._count(world)
        pairs = np.union1d(self._strong, _consecutive(world, ids))
        first, second = np.searchsorted(ids, np.divmod(pairs, _BASE))
        known, before = _found(pairs, self._pairs)
        stays, there = _found(ids, self._ids)
        stays[stays] = (poses[stays] == self._poses[there[stays]]).all(axis=(1, 2))
        known &= stays[first] & stays[second]
        costs = np.empty(len(pairs))
        costs[known] = self._costs[before[known]]
        lengths = step_lengths(poses[first[~known]], poses[second[~known]])
        costs[~known] = lengths @ [METRES_PER_RAD, 1.0] + 1e-9  # a cost of 0 would be no step
        self._ids, self._poses, self._pairs, self._costs = ids, poses, pairs, costs
        return ids, poses, csr_array((costs, (first, second)), (len(ids), len(ids)))

    def _count(self, world: WorldMap) -> None:
        """Find the pairs that share MIN_SHARED landmarks."""
        revisions = {k.id: k.revision for k in world.keyframes.values()}
        changed = {k for k, revision in revisions.items() if self._revisions.get(k) != revision}
        in_map = world.landmarks.in_map
        removed = np.flatnonzero(self._in_map & ~in_map[: len(self._in_map)])
        changed |= {k.id for k in world.observing(removed)}
        if len(changed) > FEW * len(revisions):
            self._strong = _all_pairs(world)
        else:
            stale = np.zeros(world.next_keyframe_id, bool)
            stale[[*changed, *(self._revisions.keys() - revisions.keys())]] = True
            kept = self._strong[~stale[np.stack(np.divmod(self._strong, _BASE))].any(axis=0)]
            self._strong = np.union1d(kept, _pairs_of(sorted(changed), world))
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

    def way(self, a: int, b: int) -> Array:
        """T_world_camera (N, 4, 4) of keyframes on the shortest way from a to b; N = 0: none."""
        ids, poses, costs = self._graph
        here, source = np.searchsorted(ids, [a, b]).tolist()
        if source not in self._before:
            found = dijkstra(costs, directed=False, indices=source, return_predecessors=True)
            self._before[source] = found[1]
        before = self._before[source]
        if here != source and before[here] < 0:
            return poses[:0]
        way = [here]
        while way[-1] != source:
            way.append(int(before[way[-1]]))
        return poses[way]

    def length_m(self, a: int, b: int) -> float:
        """Metres of the shortest way between keyframes; inf if there is none."""
        way = self.way(a, b)
        steps = np.diff(way[:, :3, 3], axis=0)
        return float(np.linalg.norm(steps, axis=1).sum()) if len(way) else np.inf

    @cached_property
    def _graph(self) -> tuple[Ints, Array, csr_array]:
        return self._neighbours.steps(self._world)


def _consecutive(world: WorldMap, ids: Ints) -> Ints:
    """The pairs of keyframes that follow each other in a segment."""
    segments = np.array([k.segment for k in world.keyframes.values()])
    order = np.argsort(segments, kind="stable")
    same = segments[order[1:]] == segments[order[:-1]]
    return ids[order[:-1][same]] * _BASE + ids[order[1:][same]]


def _all_pairs(world: WorldMap) -> Ints:
    """All pairs that share MIN_SHARED landmarks, by a product of sparse matrices."""
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
    return np.sort(ids[shared.row[strong]] * _BASE + ids[shared.col[strong]])


def _pairs_of(keyframe_ids: list[int], world: WorldMap) -> Ints:
    """The pairs of these keyframes with others that share MIN_SHARED landmarks with them."""
    found = []
    for k in keyframe_ids:
        _, landmarks = world.observed(world.keyframes[k])
        others = [other.id for _, other in world.covisible(landmarks, MIN_SHARED)]
        found += [min(k, other) * _BASE + max(k, other) for other in others if other != k]
    return np.array(found, np.int64)


def _found(values: Ints, among: Ints) -> tuple[Mask, Ints]:
    """Which of the values (N,) are among others, which ascend, and where."""
    places = np.searchsorted(among, values)
    known = places < len(among)
    known[known] = among[places[known]] == values[known]
    return known, places
