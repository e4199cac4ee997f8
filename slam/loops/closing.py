"""Finds loops of a keyframe: recognition, verification, confirmation.

A verified loop can still be wrong, since rooms repeat. It waits until others, found from other
keyframes, agree with it (pairwise consistency, Mangelson et al., ICRA 2018). What it does to the
graph is tested once more afterwards, see ``Mapper.close_loops``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bmask_slam.events import EventLog
from bmask_slam.features.descriptor_index import DescriptorIndex, IndexConfig
from bmask_slam.graph.arrays import Array, Arrays, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.checks import chi2_quantile, mahalanobis
from bmask_slam.graph.factors.graph_estimate import RelativePoseErrors
from bmask_slam.graph.factors.graph_update import LOOP, RelativePose
from bmask_slam.graph.files.array_file import nested, part, split_rows
from bmask_slam.graph.pose_graph.loop_consistency import largest_clique
from bmask_slam.loops.drift import MapDrift, implied_drift
from bmask_slam.loops.noise import Cycles, LoopNoise, NoiseConfig
from bmask_slam.loops.place_recognition import PlaceConfig, PlaceRecogniser
from bmask_slam.loops.verification import LoopConfig, LoopConstraint, NoLoop, loop_view, verify_loop
from bmask_slam.world.covisibility import CovisiblePaths, Neighbours
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

MEDIAN_CHI2_6DOF = 5.348


@dataclass(frozen=True)
class LoopClosingConfig:
    """When a loop enters the graph.

    A candidate's ``neighbours`` most covisible keyframes are verified with it. ``min_support``
    loops from two keyframes must agree with each other at ``probability``; the last ``waiting``
    ones are kept. A loop must not imply more drift than ``noise`` allows, and only loops whose ends
    are within ``comparable_m`` of path are compared. A loop stays while its chi-square in the graph
    is below that of ``probability``. A map with a systematic error (a wrong focal length) is
    overconfident and would refute every loop; therefore ``strong_support`` loops that agree, from
    three keyframes, enter without a robust kernel and untested. ``fuse_keyframes`` of the new side
    are searched for the old side's landmarks.
    """

    enabled: bool = True
    neighbours: int = 2
    min_support: int = 3
    strong_support: int = 6
    waiting: int = 30
    probability: float = 0.999
    comparable_m: float = 10.0
    robust: str = "cauchy"
    max_iterations: int = 10
    fuse_keyframes: int = 10
    index: IndexConfig = field(default_factory=IndexConfig)
    places: PlaceConfig = field(default_factory=PlaceConfig)
    verification: LoopConfig = field(default_factory=LoopConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)

    @property
    def gate(self) -> float:
        """Chi-square with 6 degrees of freedom at ``probability``."""
        return float(chi2_quantile(self.probability, 6))


class LoopCloser:
    """Finds loops by the descriptors of all keyframes; keeps those that wait or were closed."""

    def __init__(self, camera: Camera, config: LoopClosingConfig, events: EventLog):
        self.config = config
        self.index = DescriptorIndex(config.index)
        self.recogniser = PlaceRecogniser(self.index, config.places)
        self.noise, self.drift = LoopNoise(config.noise), MapDrift(config.noise)
        self.waiting: list[LoopConstraint] = []
        self.closed: dict[tuple[int, int], bool] = {}
        """Ends of the closed loops, and whether each is trusted more than the graph."""
        self._camera, self._events, self._neighbours = camera, events, Neighbours()

    def state(self) -> Arrays:
        """Closed loops, waiting loops, and the results of the last query."""
        waiting = self.waiting
        return {
            "closed": np.array(list(self.closed), np.int64).reshape(-1, 2),
            "believed": np.array(list(self.closed.values()), bool),
            "ends": np.array([loop.ends for loop in waiting], np.int64).reshape(-1, 2),
            "T_a_b": np.array([loop.T_a_b for loop in waiting]).reshape(-1, 4, 4),
            "covariances": np.array([loop.covariance for loop in waiting]).reshape(-1, 6, 6),
            "inliers": np.array([loop.inliers for loop in waiting], np.int64),
            "noise_scales": np.array([loop.noise_scale for loop in waiting], float),
            "landmark_pairs": np.concatenate(
                [np.zeros((0, 2), np.int64), *(loop.landmark_pairs for loop in waiting)]
            ),
            "pairs": np.array([len(loop.landmark_pairs) for loop in waiting], np.int64),
            **nested(
                recogniser=self.recogniser.state(),
                noise=self.noise.state(),
                drift=self.drift.state(),
            ),
        }

    def restore(self, state: Arrays, world: WorldMap) -> None:
        """Restore a state, with the keyframes of a map."""
        self._neighbours = Neighbours()
        self.index.restore({k.id: k.features.descriptors for k in world.keyframes.values()})
        self.recogniser.restore(part(state, "recogniser"))
        self.noise.restore(part(state, "noise"))
        self.drift.restore(part(state, "drift"))
        ends_closed = map(tuple, state["closed"].tolist())
        self.closed = dict(zip(ends_closed, state["believed"].tolist(), strict=True))
        columns = (
            state["T_a_b"],
            state["covariances"],
            state["inliers"].tolist(),
            state["noise_scales"].tolist(),
            split_rows(state["landmark_pairs"], state["pairs"]),
        )
        a, b = state["ends"].T.tolist()
        self.waiting = list(map(LoopConstraint, a, b, *columns))

    @property
    def ends(self) -> set[int]:
        """Ids of the keyframes at the ends of closed loops."""
        return {end for pair in self.closed for end in pair}

    def add(self, keyframe: Keyframe) -> None:
        """Add a keyframe to the index, and begin to search its place there."""
        descriptors = keyframe.features.descriptors
        self.index.add(keyframe.id, descriptors)
        if self.config.enabled:
            self.index.search_ahead(descriptors)

    def remove(self, keyframe_id: int) -> None:
        """Remove a keyframe that left the map, with the waiting loops that end in it."""
        self.index.remove(keyframe_id)
        self.waiting = [loop for loop in self.waiting if keyframe_id not in loop.ends]

    def loops_of(self, keyframe: Keyframe, world: WorldMap) -> list[LoopConstraint]:
        """Loops from a new keyframe that are confirmed now, and those that they confirm."""
        if not self.config.enabled:
            return []
        paths = CovisiblePaths(world, self._neighbours)
        return self.confirm(self.propose(keyframe, world, paths), world, paths)

    def propose(
        self, keyframe: Keyframe, world: WorldMap, paths: CovisiblePaths | None = None
    ) -> list[LoopConstraint]:
        """Verified loops between a keyframe and older ones that the drift on these paths allows.

        Without paths: those to other segments, to which there is none.
        """

        def covisible(keyframe_id: int) -> list[int]:
            _, ids = world.observed(world.keyframes[keyframe_id])
            return [k.id for _, k in world.covisible(ids, 1) if k.id != keyframe_id]

        descriptors = keyframe.features.descriptors
        candidates = self.recogniser.query(keyframe.id, descriptors, covisible)
        if not candidates:
            return []
        found: list[LoopConstraint] = []
        tried = self.recogniser.excluded(keyframe.id, covisible)
        view = loop_view(keyframe, world)
        for candidate in candidates:
            others = [k for k in covisible(candidate.keyframe_id) if k not in tried]
            for other in (candidate.keyframe_id, *others[: self.config.neighbours]):
                same_segment = world.keyframes[other].segment == keyframe.segment
                if other in tried or same_segment != (paths is not None):
                    break
                tried.add(other)
                ends = (other, keyframe.id)
                if paths and self.drift.out_of_reach(ends, paths, self.config.gate):
                    self.recogniser.dismiss(*ends)
                    break
                old = loop_view(world.keyframes[other], world)
                result = verify_loop(old, view, self._camera, self.config.verification)
                if isinstance(result, NoLoop):
                    self._events.loop_refused(ends, result)
                    break
                if paths and not self._drift_allows(result, world, paths):
                    self.recogniser.dismiss(*ends)
                    break
                found.append(result)
        return found

    def confirm(
        self, proposed: list[LoopConstraint], world: WorldMap, paths: CovisiblePaths | None = None
    ) -> list[LoopConstraint]:
        """The largest set of loops that agree, if it is large enough; the others wait.

        All members are returned: loops that waited, and those that confirm them.
        """
        paths = paths or CovisiblePaths(world)
        loops = [loop for loop in proposed if self._drift_allows(loop, world, paths)]
        if not loops:
            return []
        found, loops = loops, [*self.waiting, *loops][-self.config.waiting :]
        agreeing = self.agreeing(loops, world)
        keyframes = {loop.keyframe_b for loop in agreeing}
        is_enough = len(agreeing) >= self.config.min_support and len(keyframes) > 1
        confirmed = agreeing if is_enough else []
        self.noise.learn(confirmed, world)
        self._learn_drift(confirmed, world, paths)
        entering = {loop.ends for loop in confirmed}
        self.waiting = [loop for loop in loops if loop.ends not in entering]
        for loop in found:
            if loop.ends not in entering:
                self._events.loop_found(loop.ends, loop.inliers)
        return confirmed

    def agreeing(self, loops: list[LoopConstraint], world: WorldMap) -> list[LoopConstraint]:
        """The largest set of loops that agree with each other over the map's paths."""
        return [loops[k] for k in largest_clique(self._agreement(loops, world))]

    def contradicts(
        self, loop: LoopConstraint, others: list[LoopConstraint], world: WorldMap
    ) -> bool:
        """Whether a loop disagrees with most others by more than the map can have drifted."""
        cycles = Cycles.of([loop, *others], world)
        chi2 = cycles.chi2(self.noise.ratio, self.noise.map_covariances(cycles.paths))
        return bool(np.median(chi2[cycles.first == 0]) > self.config.gate)

    def relative_poses(
        self, loops: list[LoopConstraint], world: WorldMap
    ) -> tuple[RelativePose, ...]:
        """The relative poses that a confirmed set adds; of a strong set that agrees, no kernel."""
        strong = self.agreeing(loops, world)
        few = len(strong) < self.config.strong_support or len({k.keyframe_b for k in strong}) < 3
        believed = set() if few else {k.ends for k in strong}
        noise, robust = self.noise.covariance, self.config.robust
        return tuple(
            RelativePose(*k.ends, k.T_a_b, noise(k), None if k.ends in believed else robust, LOOP)
            for k in loops
        )

    def refuted(self, errors: RelativePoseErrors, world: WorldMap) -> set[tuple[int, int]]:
        """Ends of the closed loops that are not in the graph, or do not fit it.

        A strong set is trusted more than the path, but none of its loops more than the others:
        their bound is widened by the ratio of their median chi-square to its expectation.
        ``errors`` are those of all loops in the graph.
        """
        pairs = list(zip(errors.keyframe_a.tolist(), errors.keyframe_b.tolist(), strict=True))
        believed = np.array([self.closed.get(pair, False) for pair in pairs], bool)
        wider = np.ones(len(pairs))
        if believed.any():
            ratio = float(np.median(errors.chi2[believed])) / MEDIAN_CHI2_6DOF
            wider[believed] = max(ratio, 1.0)
        fits = (errors.chi2 <= wider * self.config.gate).tolist()
        inside = dict(zip(pairs, fits, strict=True))
        return {
            pair
            for pair in self.closed
            if world.keyframes.keys() >= set(pair)  # else it was removed with a culled keyframe
            and not inside.get(pair, False)
        }

    def _drift_allows(self, loop: LoopConstraint, world: WorldMap, paths: CovisiblePaths) -> bool:
        """Whether the shortest way between a loop's ends allows its drift; refused if it does not.

        Rooms that look alike give loops that agree with each other; only the way between them, over
        which the map cannot have drifted so far, tells them apart. Most imply so little drift that
        they would fit without any way.
        """
        implied, own = implied_drift(loop, world), self.noise.covariance(loop)

        def chi2_with(S: Array) -> float:
            return float(mahalanobis(implied[None], S[None])[0])

        gate = self.config.gate
        if chi2_with(own + self.drift.floor) < gate:
            return True
        way = paths.way(*loop.ends)
        if not len(way.poses):
            return True
        S = own + self.drift.covariance(way)
        if (chi2 := chi2_with(S)) < gate and not self.drift.alike_elsewhere(implied, S):
            return True
        reason = f"{loop.inliers} inliers, but it implies more drift than is possible"
        self._events.loop_refused(loop.ends, reason)
        self.drift.places_look_alike |= chi2 > self.config.noise.alike_excess * gate
        return False

    def _learn_drift(
        self, confirmed: list[LoopConstraint], world: WorldMap, paths: CovisiblePaths
    ) -> None:
        implied = [implied_drift(loop, world) for loop in confirmed]
        covariances = [self.noise.covariance(loop) for loop in confirmed]
        self.drift.learn(implied, covariances, [paths.way(*k.ends) for k in confirmed])

    def _agreement(self, loops: list[LoopConstraint], world: WorldMap) -> Mask:
        """(N, N) whether loops agree; False where their paths are too long to compare."""
        cycles = Cycles.of(loops, world)
        chi2 = cycles.chi2(self.noise.ratio, self.noise.map_covariances(cycles.paths))
        comparable = (cycles.paths[..., 1] < self.config.comparable_m).all(axis=0)
        agree = np.zeros((len(loops), len(loops)), bool)
        agree[cycles.first, cycles.second] = comparable & (chi2 < self.config.gate)
        return agree | agree.T
