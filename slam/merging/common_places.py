"""The places that two maps have in common, by place recognition and loop verification.

Every keyframe of the newer map is looked up among those of the older one. Wrong loops show by
disagreement (pairwise consistency, Mangelson et al., ICRA 2018): both maps are rigid enough that
all true loops say the same about where one lies in the other. Two rooms that look alike in part
either have two such sets, or keyframes that should see the same place and do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bmask_slam.events import Ends, EventLog
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, so3_log, transform
from bmask_slam.loops.closing import LoopCloser, LoopClosingConfig
from bmask_slam.loops.verification import LoopConstraint, NoLoop, loop_view, verify_loop
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

Keyframes = Sequence[Keyframe]


@dataclass(frozen=True)
class MergeConfig:
    """When two maps have a place in common.

    ``min_loops`` loops from ``min_keyframes`` keyframes of the newer map must agree. Another set of
    loops that agree with each other and contradict these must be smaller than ``max_contradiction``
    of theirs. Of up to ``witnesses`` keyframes whose view the older map has from within
    ``max_turn_rad``, so that it shares ``min_view`` of their landmarks, ``min_confirmed`` must be
    recognised there.
    """

    min_loops: int = 6
    min_keyframes: int = 3
    max_contradiction: float = 0.3
    witnesses: int = 30
    max_turn_rad: float = 0.5
    min_view: float = 0.6
    min_confirmed: float = 0.6


class RefusalLog(EventLog):
    """Keeps why candidates were refused, and makes no events.

    Attributes:
        reasons: of each candidate.
    """

    def __init__(self) -> None:
        super().__init__()
        self.reasons: list[NoLoop] = []

    def loop_refused(self, ends: Ends, reason: object) -> None:
        """A candidate is not a loop."""
        if isinstance(reason, NoLoop):
            self.reasons.append(reason)


@dataclass(frozen=True, eq=False)
class CommonPlaces:
    """What two map segments of different runs have in common.

    Attributes:
        segments: of the older and the newer map.
        loops: that agree, from keyframes of the older to those of the newer one.
        wrong: that do not agree with them.
        contradicting: the largest set among ``wrong`` that agree with each other and contradict
            ``loops``.
        tested, confirmed: how many keyframes should be recognised in the older map, and how many
            of them are.
    """

    segments: tuple[int, int]
    loops: list[LoopConstraint]
    wrong: list[LoopConstraint]
    contradicting: int = 0
    tested: int = 0
    confirmed: int = 0

    @property
    def keyframes(self) -> int:
        """How many keyframes of the newer map the loops come from."""
        return len({loop.keyframe_b for loop in self.loops})

    def fault(self, config: MergeConfig) -> str:
        """Why the segments are not joined, in words; "" if they can be."""
        if len(self.loops) < config.min_loops or self.keyframes < config.min_keyframes:
            return (
                f"{len(self.loops)} recognised views of {self.keyframes} keyframes agree, "
                f"{config.min_loops} of {config.min_keyframes} are needed"
            )
        if self.contradicting > config.max_contradiction * len(self.loops):
            return (
                f"{len(self.loops)} recognised views put it at one place, {self.contradicting} at "
                "another; the places only look alike"
            )
        if self.confirmed < config.min_confirmed * self.tested:
            return (
                f"of {self.tested} views that both should have, {self.confirmed} are the same; the "
                "places only look alike"
            )
        return ""


@dataclass(eq=False)
class PlaceSearch:
    """Looks for common places of the maps in one world.

    Attributes:
        reasons: why candidates were refused.
    """

    world: WorldMap
    camera: Camera
    loops: LoopClosingConfig
    config: MergeConfig
    reasons: list[NoLoop] = field(default_factory=list)

    def between(self, older: Keyframes, newer: Keyframes) -> list[CommonPlaces]:
        """The common places of two maps, for each pair of their segments that has loops."""
        log = RefusalLog()
        places = replace(self.loops.places, recent=0)
        closer = LoopCloser(self.camera, replace(self.loops, places=places), log)
        for keyframe in older:
            closer.add(keyframe)
        found: dict[tuple[int, int], list[LoopConstraint]] = {}
        for keyframe in newer:
            for loop in closer.propose(keyframe, self.world):
                a, b = (self.world.keyframes[k].segment for k in loop.ends)
                found.setdefault((a, b), []).append(loop)
        self.reasons = log.reasons
        return [self._judged(ends, loops, closer) for ends, loops in sorted(found.items())]

    def _judged(
        self, segments: tuple[int, int], loops: list[LoopConstraint], closer: LoopCloser
    ) -> CommonPlaces:
        agreeing = closer.agreeing(loops, self.world)
        ends = {loop.ends for loop in agreeing}
        wrong = [loop for loop in loops if loop.ends not in ends]
        opposed = [loop for loop in wrong if closer.contradicts(loop, agreeing, self.world)]
        contradicting = len(closer.agreeing(opposed, self.world)) if opposed else 0
        found = CommonPlaces(segments, agreeing, wrong, contradicting)
        if found.fault(self.config):
            return found
        tested, confirmed = self._witnesses(found)
        return replace(found, tested=tested, confirmed=confirmed)

    def _witnesses(self, found: CommonPlaces) -> tuple[int, int]:
        """How many keyframes should be recognised in the older map, and how many are."""
        T_a_b = T_older_newer(self.world, found.loops)
        older, newer = (self.world.in_segment(segment) for segment in found.segments)
        pairs = [(a, b) for b in newer if (a := self._nearest_view(b, older, T_a_b)) is not None]
        rows = np.unique(np.linspace(0, len(pairs) - 1, self.config.witnesses).astype(int))
        known, confirmed = {loop.ends for loop in found.loops}, 0
        pairs = [pairs[k] for k in rows.tolist()] if pairs else []
        for a, b in pairs:
            confirmed += (a.id, b.id) in known or self._is_loop(a, b, T_a_b)
        return len(pairs), confirmed

    def _is_loop(self, a: Keyframe, b: Keyframe, T_a_b: Array) -> bool:
        """Whether b is recognised in a, about where it should be."""
        views = loop_view(a, self.world), loop_view(b, self.world)
        result = verify_loop(*views, self.camera, self.loops.verification)
        if isinstance(result, NoLoop):
            return False
        expected = inverse(a.T_world_camera) @ T_a_b @ b.T_world_camera
        apart = inverse(expected) @ result.T_a_b
        return bool(np.linalg.norm(so3_log(apart[:3, :3])) < self.config.max_turn_rad / 2)

    def _nearest_view(self, b: Keyframe, older: Keyframes, T_a_b: Array) -> Keyframe | None:
        """The keyframe that sees most of what b sees, from within the largest turn."""
        _, ids = self.world.observed(b)
        points = transform(T_a_b, self.world.landmarks.points_world[ids])
        pose, best, nearest = T_a_b @ b.T_world_camera, self.config.min_view, None
        size = np.array([self.camera.width, self.camera.height])
        for a in older if len(ids) else ():
            T_camera_world = inverse(a.T_world_camera)
            turn = T_camera_world[:3, :3] @ pose[:3, :3]
            if np.linalg.norm(so3_log(turn)) > self.config.max_turn_rad:
                continue
            seen = transform(T_camera_world, points)
            seen = seen[seen[:, 2] > 0.1]
            pixels = self.camera.project(seen)
            share = float(((pixels > 0) & (pixels < size)).all(axis=1).sum() / len(ids))
            if share > best:
                best, nearest = share, a
        return nearest


def T_older_newer(world: WorldMap, loops: Sequence[LoopConstraint]) -> Array:
    """The pose (4, 4) of the newer map's world in the older one's, by the surest of some loops."""
    loop = min(loops, key=lambda loop: (float(np.trace(loop.covariance)), loop.ends))
    a, b = (world.keyframes[k].T_world_camera for k in loop.ends)
    return np.asarray(a @ loop.T_a_b @ inverse(b))
