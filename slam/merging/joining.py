"""Map segments of several runs made one: moved, joined by loops, optimised, with their labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bmask_slam.back_end.mapper import Mapper
from bmask_slam.back_end.segment_joining import move_segment
from bmask_slam.events import Ends
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.loops.drift import implied_drift
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.merging.common_places import CommonPlaces, T_older_newer
from bmask_slam.refinement.carried_along import move_frames
from bmask_slam.system import SlamSystem
from bmask_slam.world.world_map import WorldMap

BATCH = 20
"""Loops that are tested at once against each other, beside those that waited."""


@dataclass(frozen=True, eq=False)
class Step:
    """One of two segments with common places, ``moving``, is moved to where the other is."""

    places: CommonPlaces
    moving: int


@dataclass(frozen=True, eq=False)
class Joined:
    """What joining came to.

    Attributes:
        closed: ends of the loops between runs that are in the graph.
        refused: how many more loops do not fit.
        landmarks_fused: how many landmarks are now one with another.
        residuals: (N, 6) of the closed loops after the optimisation: T_a_b measured against the
            map, [rotation rad, translation m].
    """

    closed: list[Ends]
    refused: int
    landmarks_fused: int
    residuals: Array


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of every map segment, and its keyframes, before they were moved.

    Attributes:
        paths: of each segment.
        keyframes: of each segment their ids, stamps (K,) and poses (K, 4, 4).
    """

    paths: dict[int, Trajectory]
    keyframes: dict[int, tuple[list[int], Array, Array]]

    @classmethod
    def of(cls, mapper: Mapper) -> Frames:
        """Those of a map."""
        keyframes = {}
        paths = mapper.history.trajectories(mapper.world)
        for segment in paths:
            present = mapper.world.in_segment(segment)
            stamps_s = np.array([k.timestamp_s for k in present])
            poses = np.array([k.T_world_camera for k in present])
            keyframes[segment] = [k.id for k in present], stamps_s, poses
        return cls(paths, keyframes)

    def follow(self, mapper: Mapper) -> None:
        """Move the frames with the keyframes around them, without steps between these."""
        for segment, path in self.paths.items():
            ids, stamps_s, poses = self.keyframes[segment]
            now = np.array([mapper.world.keyframes[k].T_world_camera for k in ids])
            mapper.history.place(mapper.world, move_frames(path, stamps_s, poses, now))


def join(system: SlamSystem, tree: Sequence[Step], others: Sequence[CommonPlaces]) -> Joined:
    """Move segments into the first run's, close the loops between them, and optimise once.

    ``others`` have common places too, and their loops are tested against the map.

    Raises:
        InputError: none of the loops of one of ``others`` fits the map.
    """
    mapper, world = system.mapper, system.mapper.world
    before, frames = int(world.landmarks.in_map.sum()), Frames.of(mapper)
    _move(world, tree)
    mapper.rebuild()
    closed: dict[Ends, LoopConstraint] = {}
    for step in tree:
        closed |= {loop.ends: loop for loop in mapper.close(step.places.loops)}
    for places in others:
        fitting = _fitting(mapper, places)
        if not fitting:
            a, b = places.segments
            raise InputError(
                f"merge: {len(places.loops)} recognised views between segments {a} and {b} "
                "contradict those of the other runs; the places only look alike"
            )
        closed |= fitting
    mapper.loops.waiting = []
    system.semantics.follow_map()
    system.moving_objects.landmarks.follow_map()
    fused = before - int(world.landmarks.in_map.sum())
    mapper.finish()
    frames.follow(mapper)
    kept = [loop for ends, loop in sorted(closed.items()) if ends in mapper.loops.closed]
    found = sum(len(p.loops) for p in (*(step.places for step in tree), *others))
    return Joined([k.ends for k in kept], found - len(kept), fused, _residuals(system, kept))


def join_objects(system: SlamSystem, begins: Sequence[int]) -> int:
    """Make the objects that several runs saw one each; the ids of run k begin at ``begins[k]``.

    Returns how many were there twice. Map segments have world frames of their own.
    """
    system.semantics.follow_map()
    objects, ends = system.semantics.objects, (*begins[2:], np.iinfo(np.int64).max)
    keyframes, twice = system.map.world.keyframes.values(), 0
    for segment in sorted({k.segment for k in keyframes}):
        poses = {k.id: k.T_world_camera for k in keyframes if k.segment == segment}
        twice += sum(objects.join(poses, a, b) for a, b in zip(begins[1:], ends, strict=True))
    return twice


def _move(world: WorldMap, tree: Sequence[Step]) -> None:
    """Move the segments of a tree, each into the world frame of what is joined already."""
    now = {k.segment: k.segment for k in world.keyframes.values()}
    for step in tree:
        older, newer = step.places.segments
        T, target = T_older_newer(world, step.places.loops), now[older]
        if step.moving == older:
            T, target = inverse(T), now[newer]
        move_segment(world, step.moving, T, target)
        now[step.moving] = target


def _fitting(mapper: Mapper, places: CommonPlaces) -> dict[Ends, LoopConstraint]:
    """The loops that fit the map, which are closed; a few at once, as in a run."""
    closed: dict[Ends, LoopConstraint] = {}
    for begin in range(0, len(places.loops), BATCH):
        confirmed = mapper.loops.confirm(places.loops[begin : begin + BATCH], mapper.world)
        closed |= {loop.ends: loop for loop in (mapper.close(confirmed) if confirmed else [])}
    return closed


def _residuals(system: SlamSystem, loops: Sequence[LoopConstraint]) -> Array:
    found = [implied_drift(loop, system.mapper.world) for loop in loops]
    return np.array(found).reshape(-1, 6)
