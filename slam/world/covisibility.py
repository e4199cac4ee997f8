"""Ways through a map over keyframes that see the same landmarks."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.geometry import step_lengths
from bmask_slam.world.world_map import WorldMap

MIN_SHARED = 15
"""Keyframes are neighbours if they share so many landmarks, or follow each other in a segment."""
METRES_PER_RAD = 1.0
"""As much path counts a turn when ways are compared."""


class CovisiblePaths:
    """The shortest ways between the keyframes of a map as it is now.

    A place that was seen again by its own landmarks ends the drift that was gathered since: between
    two rooms the map can drift on the way from door to door, however long each was walked through.
    """

    def __init__(self, world: WorldMap) -> None:
        """Nothing is computed before the first way is asked for."""
        self._world = world
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
        """Ids (K,), T_world_camera (K, 4, 4), and what steps between neighbours (K, K) cost."""
        world = self._world
        ids = np.fromiter(world.keyframes, np.int64)
        poses = np.array([k.T_world_camera for k in world.keyframes.values()])
        keypoints = [k.landmark_ids for k in world.keyframes.values()]
        landmarks = np.concatenate(keypoints)
        used = landmarks >= 0
        used[used] = world.landmarks.in_map[landmarks[used]]
        ends = np.cumsum([0, *map(len, keypoints)])  # of each keyframe's, then of those in the map
        ends = np.concatenate([[0], np.cumsum(used)])[ends]
        shape = len(ids), len(world.landmarks) + 1
        ones = np.ones(ends[-1], np.int32)
        sees = csr_array((ones, landmarks[used], ends), shape)  # without a sort
        shared = (sees @ sees.T).tocoo()
        strong = (shared.data >= MIN_SHARED) & (shared.row < shared.col)
        segments = np.array([k.segment for k in world.keyframes.values()])
        order = np.argsort(segments, kind="stable")
        same = segments[order[1:]] == segments[order[:-1]]
        first = np.concatenate([shared.row[strong], order[:-1][same]])
        second = np.concatenate([shared.col[strong], order[1:][same]])
        pairs = np.stack(np.divmod(np.unique(first * len(ids) + second), len(ids)), axis=1)
        lengths = step_lengths(poses[pairs[:, 0]], poses[pairs[:, 1]])
        costs = lengths @ [METRES_PER_RAD, 1.0] + 1e-9  # a cost of 0 would be no step
        return ids, poses, csr_array((costs, pairs.T), (len(ids), len(ids)))
