"""Sensors beside the camera: which of their measurements become factors of which keyframes.

What has become a factor is remembered by its keyframes; everything else follows from the map and
the measurements. A keyframe that is culled leaves a gap that the next update closes.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Protocol

import numpy as np

from bmask_slam.events import EventLog
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.factors.checks import chi2_quantile
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import (
    FIRST_FRAME,
    GRAVITY,
    MARKER,
    ODOMETRY,
    PLANAR,
    POSITION,
    SITE,
    RelativePose,
    RelativePoseName,
)
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.inertial.tables import InertialState
from bmask_slam.graph.sensors.accelerometer import Plumb
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.markers import MarkerMap
from bmask_slam.graph.sensors.odometry import Motion, kernel_of, motion_between
from bmask_slam.graph.sensors.streams import Measurements, SensorStreams
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.loops.closing import LoopCloser
from bmask_slam.sensing.carried_frames import (
    carried_frames,
    carried_verdicts,
    example_state,
    is_known,
)
from bmask_slam.sensing.imu_estimation import MountingEstimator, with_mounting
from bmask_slam.sensing.inertial_fusion import carried, inertial_update, motion_by_imu, newest_state
from bmask_slam.sensing.marker_fusion import MarkerFusion
from bmask_slam.sensing.marker_sightings import WORDS, MarkerSight, Sighting, Verdict
from bmask_slam.sensing.planar_motion import planar_changes
from bmask_slam.sensing.reference_frame import Made, ReferenceFrame, SensorChanges
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

DEGREES = {ODOMETRY: 6, GRAVITY: 2, POSITION: 3, PLANAR: 3, MARKER: 6, SITE: 6}
"""The kinds of factors, and the degrees of freedom of their errors."""
KINDS = tuple(DEGREES)
FIT_PROBABILITY = 0.9999


class GraphOwner(Protocol):
    """Has a map, the frames, the graph, and its loops."""

    world: WorldMap
    history: FrameHistory
    smoother: Smoother
    loops: LoopCloser


class SensorFusion:
    """Makes the factors of the sensors.

    Attributes:
        config: of all sensors.
        streams: their measurements.
        refused: by sensor, how many measurements came too late.
        newest: how the camera moved at the newest keyframe, with an IMU.
        markers: makes the factors of markers.
        imu: finds how the IMU is mounted.
    """

    def __init__(self, config: SensorsConfig, events: EventLog) -> None:
        self.config = config
        self.streams = SensorStreams()
        self.refused: dict[str, int] = {}
        self._events = events
        self._made: Made = {}
        self._plumbs: dict[int, Plumb] = {}
        self.newest: InertialState | None = None
        self.markers = MarkerFusion(config.markers, events)
        self.imu = MountingEstimator(config.imu, events)
        self._first_keyframe = 0  # of this session

    def add(self, new: Measurements, world: WorldMap) -> None:
        """Add measurements; those that are too late for the newest keyframe are refused.

        Raises InputError for those of a sensor that is not enabled.
        """
        self.config.check_enabled(new.sensor)
        present = (k for k in world.keyframes.values() if k.id >= self._first_keyframe)
        newest_s = max((k.timestamp_s for k in present), default=-np.inf)
        late = new.rows[:, 0] < newest_s - self.config.late_s
        if late.any():
            count, until_s = int(late.sum()), new.rows[late, 0][-1]
            if new.sensor not in self.refused:  # one event, however many calls there are
                self._events.sensor(
                    f"{new.sensor}: {count} measurements up to {until_s:.3f} s refused: more than "
                    f"{self.config.late_s:g} s before the newest keyframe (sensors.late_s)",
                    logging.WARNING,
                )
            self.refused[new.sensor] = self.refused.get(new.sensor, 0) + count
        if not late.all():
            self.streams.add(Measurements(new.sensor, new.rows[~late]))

    def motion(self, begin_s: float, end_s: float) -> Motion | None:
        """The camera's motion from one time to a later one, which may be now.

        By odometry, or, after keyframes and for a short time, by an IMU.
        """
        config, moved = self.config.odometry, None
        if end_s - begin_s <= config.max_blackout_s:
            moved = motion_between(self.streams, begin_s, end_s, config, config.max_gap_s)
        if moved is None and self.newest is not None:
            imu, mounting = self.config.imu, self.newest.mounting
            imu = with_mounting(imu, mounting) if len(mounting) else imu
            moved = motion_by_imu(self.streams, self.newest, begin_s, end_s, imu)
        return moved

    def carry_over(self, old: FactorTables, new: FactorTables, world: WorldMap) -> SensorChanges:
        """What the graph that replaces another one keeps of it, after segments were moved.

        Inertial factors are put into the new tables. Factors of earlier recordings, whose
        measurements are gone, are returned with their reference frames; all others are made anew.
        """
        new.inertial.add(carried(old, world))
        kept = [
            factor
            for kind in KINDS
            if kind != SITE  # the configuration has them
            for factor in old.relative_poses(kind)
            if all(k >= FIRST_FRAME or k < self._first_keyframe for k in factor.keyframe_ids)
            and is_known(factor.name, world)
        ]
        found = carried_frames(kept, old, world)
        refused = carried_verdicts(self._made, self._first_keyframe, world)
        self._made = {factor.name: np.nan for factor in found.relative_poses} | refused
        return found

    def begin_session(self, first_keyframe: int) -> None:
        """Another recording, whose keyframes have ids from ``first_keyframe`` on.

        Its measurements replace the present ones and are of its keyframes only; factors stay.
        """
        self.streams, self.refused, self.newest = SensorStreams(), {}, None
        self.imu.begin_session()
        self._first_keyframe = first_keyframe
        # stamps of positions are of the other recording
        self._made = {n: np.nan if n[2] == POSITION else v for n, v in self._made.items()}

    def changes(self, owner: GraphOwner, last: bool = False) -> SensorChanges:
        """The factors that can be made now; ``last``: no further keyframe will come."""
        if not (self.streams or self.config.planar.enabled or self.config.markers.has_site):
            return SensorChanges()
        world, history, tables = owner.world, owner.history, owner.smoother.tables
        self._forget_culled(world)
        self._update_mounting(world)
        found, sight = SensorChanges(), MarkerSight(world, tables, owner.loops.noise, self._made)
        for segment in sorted({k.segment for k in world.keyframes.values()}):
            given = self.streams, self.config, self._made, self._plumbs, self._first_keyframe
            frame = ReferenceFrame(segment, world, history, tables, *given, last)
            present = [k for k in world.in_segment(segment) if k.id >= self._first_keyframe]
            moved = SensorChanges(relative_poses=tuple(self._odometry(present)))
            found = found.with_more(moved).with_more(frame.changes())
            found = found.with_more(self._inertial(present, tables))
            found = found.with_more(self.markers.changes(segment, present, sight, self.streams))
            found = found.with_more(planar_changes(present, tables, self._made, self.config.planar))
        return found

    def _update_mounting(self, world: WorldMap) -> None:
        """Estimate how the IMU is mounted, by the segment that grows, if that is due."""
        present = [k for k in world.keyframes.values() if k.id >= self._first_keyframe]
        if present:
            growing = max(present, key=lambda k: k.id).segment
            self.imu.update([k for k in present if k.segment == growing], self.streams)

    def _inertial(self, keyframes: list[Keyframe], tables: FactorTables) -> SensorChanges:
        """Factors of an IMU."""
        if (config := self.imu.config) is None:
            return SensorChanges()
        return SensorChanges(
            inertial=inertial_update(keyframes, tables.inertial, self.streams, config)
        )

    def follow(self, owner: GraphOwner) -> None:
        """The graph was optimised: keep how the camera moves, for a blackout."""
        if self.streams or owner.smoother.tables.inertial:
            own = [k for k in owner.world.keyframes.values() if k.id >= self._first_keyframe]
            self.newest = newest_state(own, owner.smoother.tables, self.imu.found)

    def _odometry(self, keyframes: list[Keyframe]) -> Iterator[RelativePose]:
        """Motion between keyframes in a row."""
        config = self.config.odometry
        robust = kernel_of(config.robust)
        for a, b in pairwise(keyframes):
            if (name := (a.id, b.id, ODOMETRY)) in self._made:
                continue
            motion = motion_between(self.streams, a.timestamp_s, b.timestamp_s, config)
            if motion is not None:
                self._made[name] = np.nan
                yield RelativePose(a.id, b.id, motion.T_a_b, motion.covariance, robust, ODOMETRY)

    def _forget_culled(self, world: WorldMap) -> None:
        for name in [name for name in self._made if not is_known(name, world)]:
            del self._made[name]
        for keyframe_id in [i for i in self._plumbs if i not in world.keyframes]:
            del self._plumbs[keyframe_id]

    def keep_verdict(self, found: Sighting, moved: bool) -> None:
        """Keep what became of a marker's sighting that waited: a factor, or refused."""
        if moved:
            self.markers.tell_moved(found, self._made)
        self._made[found.factor.name] = float(Verdict.MOVED) if moved else np.nan

    def forget(self, names: Iterable[RelativePoseName]) -> None:
        """Factors are not in the graph any more."""
        for name in names:
            self._made.pop(name, None)

    def marker_map(self, tables: FactorTables, segment: int) -> MarkerMap:
        """The markers of a map segment."""
        return self.markers.map(tables, segment, self.sightings())

    def sightings(self) -> dict[int, dict[str, int]]:
        """By marker's id in the graph: how many sightings were "used", and refused for a reason."""
        found: dict[int, dict[str, int]] = {}
        for (marker, _, kind), value in self._made.items():
            if kind == MARKER:
                what = "used" if np.isnan(value) else WORDS[Verdict(int(value))]
                counts = found.setdefault(marker, {})
                counts[what] = counts.get(what, 0) + 1
        return found

    def report(self, smoother: Smoother) -> None:
        """Tell how many factors of each kind do not fit the final estimate."""
        self.markers.report(self.sightings())
        self.imu.report(self.streams)
        for sensor, count in self.refused.items():
            self._events.sensor(f"{sensor}: {count} measurements came too late", logging.WARNING)
        for kind in KINDS if self._made else ():
            found = smoother.relative_pose_errors(kind)
            wrong = found.chi2 > chi2_quantile(FIT_PROBABILITY, DEGREES[kind])
            if wrong.any():
                worst = found.keyframe_b[int(np.argmax(found.chi2))]
                self._events.sensor(
                    f"{kind}: {wrong.sum()} of {len(wrong)} do not fit and count for little, the "
                    f"worst at keyframe {worst}"
                )

    def state(self) -> Arrays:
        """Measurements and what was made of them; nothing without either."""
        if not (self.streams or self._made):
            return {}
        ids = [(KINDS.index(kind), a, b) for a, b, kind in self._made]
        return {
            **nested(streams=self.streams.state()),
            **self.markers.state(),
            **self.imu.state(),
            "first_keyframe": np.array(self._first_keyframe),
            "made": np.array(ids, np.int64).reshape(-1, 3),
            "made_s": np.array(list(self._made.values()), float),
            "newest": np.zeros(0) if self.newest is None else self.newest.numbers,
            "plumb_ids": np.array(list(self._plumbs), np.int64),
            "plumbs": np.array(
                [[*p.mean, *p.turn.ravel(), p.sigma_rad] for p in self._plumbs.values()], float
            ).reshape(-1, 13),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state, which may be empty."""
        self.streams = SensorStreams()
        state = {**{n: a for n, a in example_state().items() if "." not in n}, **state}
        self.streams.restore(part(state, "streams"))
        self.markers.restore(state)
        self.imu.restore(state)
        self._first_keyframe = int(state["first_keyframe"])
        self.newest = InertialState.of(state["newest"]) if len(state["newest"]) else None
        made = zip(state["made"].tolist(), state["made_s"].tolist(), strict=True)
        self._made = {(a, b, KINDS[kind]): t for (kind, a, b), t in made}
        plumbs = zip(state["plumb_ids"].tolist(), state["plumbs"], strict=True)
        self._plumbs = {
            i: Plumb(row[:3], row[3:12].reshape(3, 3), float(row[12])) for i, row in plumbs
        }
