"""The order in which ISAM2 eliminates variables, and points that keep long maps solvable.

GTSAM calls a clique indeterminate if elimination leaves less than 2^-24 of a diagonal element of
its matrix (measured, GTSAM 4.3.0): if a variable is known 4096 times better beside its neighbours
than without them. In a long map without loops the last pose is: to 0.1 mm relative to its
neighbours, to decimetres in the world, where drift adds up. Double precision can solve that, GTSAM
refuses it, as it puts the last pose into one clique with the neighbours, which see each other. So
free points, seen by the last pose alone, are eliminated after it. They change no estimate, but pose
and points are then the root: the neighbours are eliminated given the pose, relative to which they
are well known, and only what remains of the pose enters the root's matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.factors.factor_tables import ValueTable
from bmask_slam.graph.factors.keys import (
    LANDMARK_BASE,
    ROOT_BASE,
    VELOCITY_BASE,
    key_of_keyframe,
)
from bmask_slam.graph.geometry import transform

MANY_KEYFRAMES = 400
"""From so many on there are root points; drift of fewer is small."""
POINTS = 3
"""With the pose at least four variables: numbers of groups must be below their count (CCOLAMD)."""
AHEAD_M = 1.0


def poses_last(
    graph: gtsam.NonlinearFactorGraph, after: tuple[list[int], ...] = ()
) -> gtsam.KeyGroupMap:
    """The elimination order constraint for ISAM2: poses (and inertial states) come last.

    After them come the keys ``after``, group by group.

    By default all variables of a change come last, and a removed keyframe concerns hundreds of
    landmarks. A pose that is eliminated before them connects all that it observes to each other,
    which takes four times the time and the memory where a place is visited again.
    """
    groups = gtsam.KeyGroupMap()
    for place, keys in enumerate(after, start=2):
        for key in keys:
            groups.insert2(key, place)
    for key in graph.keyVector():  # but those that are there already
        if key >= VELOCITY_BASE or key < LANDMARK_BASE:
            groups.insert2(key, 1)
    return groups


@dataclass(frozen=True)
class RootChange:
    """What to add to ISAM2 and to remove from it.

    Attributes:
        factors: none, or those of the root points, a metre before the newest keyframe.
        points_world: their values by their keys.
        removed_slots: of the factors that they replace.
    """

    factors: list[gtsam.NonlinearFactor] = field(default_factory=list)
    points_world: dict[int, Array] = field(default_factory=dict)
    removed_slots: list[int] = field(default_factory=list)

    def insert_points(self, values: gtsam.Values) -> None:
        """Add the points to values."""
        for key, point_world in self.points_world.items():
            values.insert(key, point_world)


class RootPoints:
    """The points after the newest keyframe of an ISAM2, once that has many."""

    def __init__(self) -> None:
        self.slots: list[int] = []
        """Of their factors in ISAM2."""
        self._keyframe: int | None = None

    @property
    def keys(self) -> list[int]:
        """Of the points in ISAM2."""
        if self._keyframe is None:
            return []
        return [ROOT_BASE + self._keyframe * POINTS + i for i in range(POINTS)]

    def follow(self, keyframes: ValueTable, new_ids: Ints) -> RootChange:
        """Let them be the newest keyframe's; what ISAM2 is to be given for that.

        ``new_ids``: of keyframes that it does not have yet, or that are removed and come again.
        """
        many = len(keyframes.ids) >= MANY_KEYFRAMES
        newest = int(keyframes.ids.max()) if many else None
        if newest == self._keyframe and newest not in new_ids:
            return RootChange()
        removed, self.slots, self._keyframe = self.slots, [], newest
        if newest is None:
            return RootChange(removed_slots=removed)
        T_world_camera = keyframes.get(np.array([newest]))[0]
        point_world = transform(T_world_camera, np.array([[0.0, 0.0, AHEAD_M]]))[0]
        pose, noise = key_of_keyframe(newest), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
        ahead = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
        factors: list[gtsam.NonlinearFactor] = [
            gtsam.BearingRangeFactor3D(pose, key, ahead, AHEAD_M, noise) for key in self.keys
        ]
        return RootChange(factors, dict.fromkeys(self.keys, point_world), removed)

    @property
    def last(self) -> tuple[list[int], ...]:
        """Groups of keys that are eliminated after all others: the newest pose, then its points."""
        if self._keyframe is None:
            return ()
        return [key_of_keyframe(self._keyframe)], self.keys


def add_root(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keyframes: ValueTable
) -> gtsam.Ordering | None:
    """Add root points to a whole graph of many keyframes, and its values.

    Returns the order in which it is to be eliminated; None for a graph of few, which stays.
    """
    root = RootPoints()
    change = root.follow(keyframes, keyframes.ids)
    if not change.factors:
        return None
    for factor in change.factors:
        graph.add(factor)
    change.insert_points(values)
    last = [key for group in root.last for key in group]
    return gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, last, True)
