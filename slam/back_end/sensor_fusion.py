"""Sensors beside the camera: which of their measurements become factors of which keyframes.

What has become a factor is remembered by its keyframes; everything else follows from the map and
the measurements. A keyframe that is culled leaves a gap that the next update closes.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from itertools import pairwise
from typing import Protocol

import numpy as np

from bmask_slam.back_end.reference_frame import Made, ReferenceFrame, SensorChanges
from bmask_slam.events import EventLog
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.factors.checks import chi2_quantile
from bmask_slam.graph.factors.graph_update import (
    FIRST_FRAME,
    GRAVITY,
    ODOMETRY,
    POSITION,
    RelativePose,
    RelativePoseName,
)
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.sensors.accelerometer import Plumb
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.odometry import Motion, motion_between
from bmask_slam.graph.sensors.streams import COLUMNS, Measurements, SensorStreams
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.world_map import Keyframe, WorldMap

DEGREES = {ODOMETRY: 6, GRAVITY: 2, POSITION: 3}
"""The kinds of factors, and the degrees of freedom of their errors."""
KINDS = tuple(DEGREES)
FIT_PROBABILITY = 0.9999


class GraphOwner(Protocol):
    """Has a map, the frames, and the graph."""

    world: WorldMap
    history: FrameHistory
    smoother: Smoother


class SensorFusion:
    """Makes the factors of the sensors.

    Attributes:
        config: of all sensors.
        streams: their measurements.
        refused: by sensor, how many measurements came too late.
    """

    def __init__(self, config: SensorsConfig, events: EventLog) -> None:
        self.config = config
        self.streams = SensorStreams()
        self.refused: dict[str, int] = {}
        self._events = events
        self._made: Made = {}
        self._plumbs: dict[int, Plumb] = {}
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
            self.refused[new.sensor] = self.refused.get(new.sensor, 0) + count
            self._events.sensor(
                f"{new.sensor}: {count} measurements up to {until_s:.3f} s refused: more than "
                f"{self.config.late_s:g} s before the newest keyframe (sensors.late_s)",
                logging.WARNING,
            )
        if not late.all():
            self.streams.add(Measurements(new.sensor, new.rows[~late]))

    def motion(self, begin_s: float, end_s: float) -> Motion | None:
        """The camera's motion by odometry from one time to a later one, which may be now."""
        config = self.config.odometry
        if end_s - begin_s > config.max_blackout_s:
            return None
        return motion_between(self.streams, begin_s, end_s, config, config.max_gap_s)

    def forget_factors(self) -> None:
        """The graph was emptied: all factors are to be made anew."""
        self._made = {}

    def begin_session(self, first_keyframe: int) -> None:
        """Another recording, whose keyframes have ids from ``first_keyframe`` on.

        Its measurements replace the present ones and are of its keyframes only; factors stay.
        """
        self.streams, self.refused = SensorStreams(), {}
        self._first_keyframe = first_keyframe
        self._made = dict.fromkeys(self._made, np.nan)  # stamps are of the other recording

    def changes(self, owner: GraphOwner, last: bool = False) -> SensorChanges:
        """The factors that can be made now; ``last``: no further keyframe will come."""
        if not self.streams:
            return SensorChanges()
        world, history, tables = owner.world, owner.history, owner.smoother.tables
        self._forget_culled(world)
        found = SensorChanges()
        for segment in sorted({k.segment for k in world.keyframes.values()}):
            given = self.streams, self.config, self._made, self._plumbs, self._first_keyframe
            frame = ReferenceFrame(segment, world, history, tables, *given, last)
            present = [k for k in world.in_segment(segment) if k.id >= self._first_keyframe]
            moved = SensorChanges(relative_poses=tuple(self._odometry(present)))
            found = found.with_more(moved).with_more(frame.changes())
        return found

    def _odometry(self, keyframes: list[Keyframe]) -> Iterator[RelativePose]:
        """Motion between keyframes in a row."""
        config = self.config.odometry
        robust = None if config.robust == "none" else config.robust
        for a, b in pairwise(keyframes):
            name = (a.id, b.id, ODOMETRY)
            if name in self._made:
                continue
            motion = motion_between(self.streams, a.timestamp_s, b.timestamp_s, config)
            if motion is not None:
                self._made[name] = np.nan
                yield RelativePose(a.id, b.id, motion.T_a_b, motion.covariance, robust, ODOMETRY)

    def _forget_culled(self, world: WorldMap) -> None:
        for name in [name for name in self._made if not _is_known(name, world)]:
            del self._made[name]
        for keyframe_id in [i for i in self._plumbs if i not in world.keyframes]:
            del self._plumbs[keyframe_id]

    def report(self, smoother: Smoother) -> None:
        """Tell how many factors of each kind do not fit the final estimate."""
        for kind in KINDS if self._made else ():
            found = smoother.relative_pose_errors(kind)
            wrong = found.chi2 > chi2_quantile(FIT_PROBABILITY, DEGREES[kind])
            if wrong.any():
                worst = found.keyframe_b[int(np.argmax(found.chi2))]
                self._events.sensor(
                    f"{kind}: {wrong.sum()} of {len(wrong)} do not fit and count for little, the "
                    f"worst at keyframe {worst}",
                    logging.INFO,
                )

    def state(self) -> Arrays:
        """Measurements and what was made of them; nothing without either."""
        if not (self.streams or self._made):
            return {}
        ids = [(KINDS.index(kind), a, b) for a, b, kind in self._made]
        return {
            **nested(streams=self.streams.state()),
            "first_keyframe": np.array(self._first_keyframe),
            "made": np.array(ids, np.int64).reshape(-1, 3),
            "made_s": np.array(list(self._made.values()), float),
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
        self._first_keyframe = int(state["first_keyframe"])
        made = zip(state["made"].tolist(), state["made_s"].tolist(), strict=True)
        self._made = {(a, b, KINDS[kind]): t for (kind, a, b), t in made}
        plumbs = zip(state["plumb_ids"].tolist(), state["plumbs"], strict=True)
        self._plumbs = {
            i: Plumb(row[:3], row[3:12].reshape(3, 3), float(row[12])) for i, row in plumbs
        }


def example_state() -> Arrays:
    """The arrays that a state has when there are measurements of all sensors, without rows."""
    rows = {sensor: np.zeros((0, len(names))) for sensor, names in COLUMNS.items()}
    made: Arrays = {"made": np.zeros((0, 3), np.int64), "made_s": np.zeros(0)}
    plumbs: Arrays = {"plumb_ids": np.zeros(0, np.int64), "plumbs": np.zeros((0, 13))}
    return {**nested(streams=rows), "first_keyframe": np.array(0), **made, **plumbs}


def _is_known(name: RelativePoseName, world: WorldMap) -> bool:
    """Whether the keyframes of a factor are in the map."""
    return all(k >= FIRST_FRAME or k in world.keyframes for k in name[:2])
