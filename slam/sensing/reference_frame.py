"""The frame of a map segment in which up and absolute positions are measured: z is up.

It is a pose of the graph, ``T_world_reference``. It begins once up or enough positions are known,
begins anew when positions align it for the first time, and is optimised with everything else.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import (
    FIRST_FRAME,
    GRAVITY,
    POSITION,
    GraphUpdate,
    PosePrior,
    RelativePose,
    RelativePoseName,
    reference_frame_id,
)
from bmask_slam.graph.factors.observability import diagonal_covariance
from bmask_slam.graph.geometry import inverse, make_pose
from bmask_slam.graph.inertial.tables import InertialUpdate
from bmask_slam.graph.sensors.accelerometer import (
    UP,
    Plumb,
    Upright,
    estimate_up,
    gravity_factor,
    plumb,
    rotation_between,
)
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.position import align, position_factor
from bmask_slam.graph.sensors.streams import SensorStreams
from bmask_slam.graph.trajectory import associate_stamps
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

SIGMA_RAD, SIGMA_M = 1.0, 100.0
"""Of the prior on a reference frame, which holds what its measurements leave open."""
SLACK_S, MAX_GAP_S = 0.1, 0.3
"""The time around a keyframe may lack so much at its end; longer gaps between frames are left out.
"""
IMU_SIGMA_RAD = 0.005
"""Of up by an IMU."""
RETIRED_FRAME = FIRST_FRAME + (1 << 20)
"""Reference frames from here on are of segments that were joined to others."""
Made = dict[RelativePoseName, float]
"""The factors that were made of measurements, and of a position its time; else NaN."""


@dataclass(frozen=True)
class SensorChanges:
    """What sensors add to an update of the graph, and what they replace; as in `GraphUpdate`."""

    keyframe_ids: Ints = field(default_factory=no_ids)
    poses_world_camera: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    priors: tuple[PosePrior, ...] = ()
    relative_poses: tuple[RelativePose, ...] = ()
    remove_keyframes: Ints = field(default_factory=no_ids)
    remove_relative_poses: tuple[RelativePoseName, ...] = ()
    inertial: InertialUpdate = field(default_factory=InertialUpdate)

    def __bool__(self) -> bool:
        return any(len(getattr(self, f.name)) for f in fields(self))

    def with_more(self, more: SensorChanges) -> SensorChanges:
        """These changes and others."""
        return SensorChanges(**self._joined(self, more))

    def added_to(self, update: GraphUpdate) -> GraphUpdate:
        """An update with these changes; the same one if there are none."""
        return replace(update, **self._joined(update, self)) if self else update

    def _joined(self, first: Any, second: Any) -> dict[str, Any]:
        pairs = {f.name: (getattr(first, f.name), getattr(second, f.name)) for f in fields(self)}
        return {
            name: np.concatenate([a, b]) if isinstance(a, np.ndarray) else a + b
            for name, (a, b) in pairs.items()
        }


@dataclass(frozen=True)
class _Fixes:
    """Positions: places of their keyframes, levers (N, 3) in these, antennas, rows (N, 5)."""

    keyframes: Ints = field(default_factory=no_ids)
    levers: Array = field(default_factory=lambda: np.zeros((0, 3)))
    antennas_world: Array = field(default_factory=lambda: np.zeros((0, 3)))
    rows: Array = field(default_factory=lambda: np.zeros((0, 5)))


@dataclass(frozen=True)
class ReferenceFrame:
    """One segment, the measurements, and what was made of them so far.

    Attributes:
        made, plumbs: are extended; plumbs by keyframe.
        first_keyframe: those before are of another recording than the measurements.
        last: no further keyframe will come.
    """

    segment: int
    world: WorldMap
    history: FrameHistory
    tables: FactorTables
    streams: SensorStreams
    config: SensorsConfig
    made: Made
    plumbs: dict[int, Plumb]
    first_keyframe: int
    last: bool

    def changes(self) -> SensorChanges:
        """The factors of up and of positions that can be made now."""
        upright, fixes, T_now = self._upright, self._fixes(), self.T_world_reference
        if T_now is None or (len(fixes.rows) and not self._is_aligned):
            known = None if upright is None else upright.up_world
            measured = fixes.rows[:, 1:]
            aligned = align(fixes.antennas_world, measured, known, self.config.position)
            if aligned is not None:
                return self._begin(aligned, fixes)
            fixes = _Fixes()
        if T_now is None and upright is None:
            return SensorChanges()
        if T_now is None and upright is not None:
            R = rotation_between(UP, upright.up_world)
            return self._begin(make_pose(R, np.zeros(3)), fixes)
        assert T_now is not None
        removed: tuple[RelativePoseName, ...] = ()
        if self.last and upright is not None:  # anew, with the mounting as it is known now
            removed = tuple(n for n in self.made if n[0] == self.id and n[2] == GRAVITY)
            for name in removed:
                del self.made[name]
        factors = (*self._gravity(T_now), *self._positions(T_now, fixes))
        return SensorChanges(relative_poses=factors, remove_relative_poses=removed)

    @property
    def id(self) -> int:
        """Its id among the poses of the graph."""
        return reference_frame_id(self.segment)

    @property
    def T_world_reference(self) -> Array | None:
        """Its present estimate (4, 4), None where the graph has none."""
        known, ids = self.tables.keyframes, np.array([self.id])
        return known.get(ids)[0] if known.contains(ids).all() else None

    def _begin(self, T_world_reference: Array, fixes: _Fixes) -> SensorChanges:
        """The frame begins, or begins anew."""
        for name in [n for n in self.made if n[0] == self.id]:
            del self.made[name]
        covariance = diagonal_covariance(SIGMA_RAD, SIGMA_M)
        factors = self._gravity(T_world_reference), self._positions(T_world_reference, fixes)
        return SensorChanges(
            np.array([self.id]),
            T_world_reference[None],
            (PosePrior(self.id, T_world_reference, covariance),),
            tuple(factor for kind in factors for factor in kind),
            no_ids() if self.T_world_reference is None else np.array([self.id]),
        )

    @cached_property
    def _keyframes(self) -> list[Keyframe]:
        return self.world.in_segment(self.segment)

    @cached_property
    def _ids(self) -> list[int]:
        return [k.id for k in self._keyframes]

    @cached_property
    def _stamps_s(self) -> Array:
        return np.array([k.timestamp_s for k in self._keyframes])

    @cached_property
    def _poses(self) -> Array:
        return np.array([k.T_world_camera for k in self._keyframes])

    @property
    def _is_aligned(self) -> bool:
        return any(name[0] == self.id and name[2] == POSITION for name in self.made)

    @cached_property
    def _upright(self) -> Upright | None:
        config, down = self.config.accelerometer, self.tables.inertial.down.get(self.segment)
        if down is not None and self._keyframes:
            first = self._keyframes[0]  # one factor is enough: the IMU holds the others
            up = -first.T_world_camera[:3, :3].T @ down
            self.plumbs[first.id] = Plumb(up, np.zeros((3, 3)), IMU_SIGMA_RAD)
            return Upright(-down, np.zeros(3), np.zeros((3, 3)))
        if not config.enabled or not len(self.streams.of("accelerometer")):
            return None
        for keyframe in self._keyframes:
            if keyframe.id >= self.first_keyframe and keyframe.id not in self.plumbs:
                self._hang_plumb(keyframe)
        places = [k for k, i in enumerate(self._ids) if i in self.plumbs]
        measured = [self.plumbs[self._ids[k]] for k in places]
        return estimate_up(self._poses[places, :3, :3], measured, config)

    def _hang_plumb(self, keyframe: Keyframe) -> None:
        """Average the force around a keyframe once the frames around it are known, or the last."""
        config, t_s = self.config.accelerometer, keyframe.timestamp_s
        ends_s = t_s - config.average_s / 2, t_s + config.average_s / 2
        rows = self.streams.within("accelerometer", *ends_s)
        if not len(rows):
            return
        path = self.history.path(self.world, self.segment, *ends_s)
        known_s = min(path.timestamps_s[-1], rows[-1, 0]) if len(path) else -np.inf
        if not (known_s >= ends_s[1] - SLACK_S or self.last):
            return
        poses, inside = path.at(rows[:, 0], MAX_GAP_S)
        R = keyframe.T_world_camera[:3, :3].T @ poses[inside, :3, :3]
        gravity = np.median(np.linalg.norm(self.streams.of("accelerometer")[:, 1:4], axis=1))
        if inside.any():
            found = plumb(R, rows[inside, 1:4], float(gravity), config)
            if found is not None:
                self.plumbs[keyframe.id] = found

    def _without(self, kind: str) -> Ints:
        """Places of the keyframes that have no factor of a kind yet."""
        return np.flatnonzero([(self.id, i, kind) not in self.made for i in self._ids])

    def _gravity(self, T_world_reference: Array) -> Iterator[RelativePose]:
        upright = self._upright
        for k in self._without(GRAVITY).tolist() if upright is not None else ():
            measured, ids = self.plumbs.get(self._ids[k]), (self.id, self._ids[k])
            if measured is not None and upright is not None:
                T = inverse(T_world_reference) @ self._poses[k]
                self.made[(*ids, GRAVITY)] = np.nan
                yield gravity_factor(ids, T, measured, upright)

    def _fixes(self) -> _Fixes:
        """Positions that have no factor yet, each with the keyframe nearest in time.

        The newest keyframe waits for the next one, which may be nearer.
        """
        config, rows = self.config.position, self.streams.of("position")
        if not config.enabled or not len(rows):
            return _Fixes()
        used_s = [t for name, t in self.made.items() if name[2] == POSITION]
        rows, places = rows[~np.isin(rows[:, 0], used_s)], self._without(POSITION)
        places = places[np.array(self._ids, int)[places] >= self.first_keyframe]
        near, of = associate_stamps(self._stamps_s[places], rows[:, 0], config.max_apart_s)
        found: list[tuple[int, Array, Array, Array]] = []
        for k, row in zip(places[near].tolist(), rows[of], strict=True):
            path = self.history.path(self.world, self.segment, row[0], row[0])
            (T_world_camera,), (known,) = path.at(row[:1], MAX_GAP_S)
            if known and (self.last or k < len(self._ids) - 1):
                lever = np.array(config.antenna_in_camera)
                antenna = T_world_camera[:3, :3] @ lever + T_world_camera[:3, 3]
                T_keyframe_world = inverse(self._poses[k])
                at = T_keyframe_world[:3, :3] @ antenna + T_keyframe_world[:3, 3]
                found.append((k, at, antenna, row))
        if not found:
            return _Fixes()
        keyframes, *columns = zip(*found, strict=True)
        return _Fixes(np.array(keyframes), *map(np.array, columns))

    def _positions(self, T_world_reference: Array, fixes: _Fixes) -> Iterator[RelativePose]:
        for k, lever, row in zip(fixes.keyframes.tolist(), fixes.levers, fixes.rows, strict=True):
            ids = (self.id, self._ids[k])
            T = inverse(T_world_reference) @ self._poses[k]
            self.made[(*ids, POSITION)] = float(row[0])
            yield position_factor(ids, T, lever, row[1:], self.config.position)
