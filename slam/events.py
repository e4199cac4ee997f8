"""What happened in a run, a line each: losses, segments, loops, what the graph refused.

The parts of the system report to one `EventLog`, which makes the events, logs them, and counts what
the graph was given in vain. The events of a frame leave the system with its result.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_estimate import GraphEstimate
from bmask_slam.graph.files.reading import read_table

logger = logging.getLogger(__name__)

EVENTS = "events.csv"
EVENT_COLUMNS = ("index", "timestamp", "kind", "text")
TOTALS = (
    *("observations refused", "keyframes refused", "factors refused"),
    *("landmarks dropped", "keyframes dropped", "keyframes anchored", "rebuilds"),
    *("landmarks pruned", "observations pruned", "loops pruned"),
)
"""What is counted, as `EventLog.count` names it before the reason."""
Ends = tuple[int, int]


class EventKind(Enum):
    """What an event is about; the value is its name in events.csv, log.txt and pictures."""

    CALIBRATION = "calibration"
    LOST = "lost"
    FOUND = "found again"
    SEGMENT = "new segment"
    JOINED = "segments joined"
    LOOP_FOUND = "loop found"
    """It was verified, and waits until others agree with it."""
    LOOP_CLOSED = "loop closed"
    LOOP_REFUSED = "loop refused"
    LOOP_REMOVED = "loop removed"
    """It was closed earlier, and no longer fits the graph."""
    SENSOR = "sensor"
    """Measurements came too late, or do not fit the graph."""
    GRAPH = "graph"
    """Something was refused, dropped, anchored or repaired."""


@dataclass(frozen=True)
class Event:
    """Something that happened in a run.

    Attributes:
        frame: position in the sequence of the frame at which it happened.
        timestamp_s: stamp of that frame.
        kind: what it is about.
        text: one line that says more.
    """

    frame: int
    timestamp_s: float
    kind: EventKind
    text: str

    def __str__(self) -> str:
        """One line for the log."""
        return f"frame {self.frame}, {self.timestamp_s:.6f} s: {self.kind.value}: {self.text}"


class EventLog:
    """Makes the events of a run, at the frame that is being processed.

    Attributes:
        counts: how many observations, keyframes, ... were refused, dropped, anchored or pruned,
            by words such as "observations refused: reprojection".
        on_event: gets every event in place of ``take``, where another process writes them.
    """

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.on_event: Callable[[Event], object] | None = None
        self._events: list[Event] = []
        self._received: set[Event] = set()
        self._frame, self._timestamp_s, self._lost_frames = -1, np.nan, 0

    def state(self) -> Arrays:
        """The present frame, for how long tracking has been lost, and the counts."""
        return {
            "now": np.array([self._frame, self._timestamp_s, self._lost_frames], float),
            "counted": np.array(list(self.counts), str),
            "counts": np.array(list(self.counts.values()), np.int64),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state, in which no event waits to be taken."""
        frame, self._timestamp_s, lost_frames = state["now"].tolist()
        self._frame, self._lost_frames = int(frame), int(lost_frames)
        self.counts = dict(zip(state["counted"].tolist(), state["counts"].tolist(), strict=True))

    def begin_session(self) -> None:
        """Another recording: nothing has happened in it yet."""
        self.counts = {}
        self._frame, self._timestamp_s, self._lost_frames = -1, np.nan, 0

    def take(self) -> tuple[Event, ...]:
        """The events since the last call."""
        taken, self._events = tuple(self._events), []
        return taken

    def receive(self, event: Event) -> None:
        """Add an event of another process; one that it sends again, restarted, is ignored."""
        if event not in self._received:
            self._received.add(event)
            self._keep(event)

    def begin_frame(self, frame: int, timestamp_s: float) -> None:
        """What is reported from now on happens at this frame."""
        self._frame, self._timestamp_s = frame, timestamp_s

    def calibration(self, text: str) -> None:
        """What was found of the camera, before the run or live, and what became of it."""
        self._add(EventKind.CALIBRATION, text)

    def lost(self, matches: int, reckoned: bool = False) -> None:
        """The image of the present frame gives no pose; an event if it is the first one.

        ``reckoned``: odometry does.
        """
        if not self._lost_frames:
            more = "; odometry goes on" if reckoned else ""
            self._add(EventKind.LOST, f"{matches} matches give no pose, nor is it recognised{more}")
        self._lost_frames += 1

    def tracked(self, inliers: int) -> None:
        """The present frame has a pose in the map; an event if the last one had none."""
        if self._lost_frames:
            text = f"{inliers} inliers, after {_frames(self._lost_frames)} without a pose"
            self._add(EventKind.FOUND, text)
        self._lost_frames = 0

    def new_segment(self, segment: int) -> None:
        """The present frame begins a map segment."""
        after = f", after {_frames(self._lost_frames)} without a pose" if self._lost_frames else ""
        self._add(EventKind.SEGMENT, f"segment {segment} begins{after}")
        self._lost_frames = 0

    def joined(self, segment: int, target: int, inliers: int) -> None:
        """The present frame of a segment was recognised in another one, which that became."""
        text = f"segment {segment} becomes part of segment {target}, where {inliers} points agree"
        self._add(EventKind.JOINED, text)

    def loop_found(self, ends: Ends, inliers: int) -> None:
        """A loop was verified, and is not confirmed by others yet."""
        text = f"keyframes {_pair(ends)}, {inliers} inliers; waits for others that agree"
        self._add(EventKind.LOOP_FOUND, text)

    def loop_closed(self, ends: Ends, inliers: int) -> None:
        """A loop entered the graph, and fits it."""
        self._add(EventKind.LOOP_CLOSED, f"keyframes {_pair(ends)}, {inliers} inliers")

    def joined_by_marker(self, segment: int, other: int, marker: int) -> None:
        """A marker that both segments saw joined them."""
        text = f"segment {segment} into segment {other}, by marker {marker}"
        self._add(EventKind.JOINED, text)

    def marker_loop(self, ends: Ends, marker: int, off_m: float) -> None:
        """A marker that was seen before closed a loop: it was ``off_m`` from its place."""
        text = f"keyframes {_pair(ends)} by marker {marker}, which was {off_m:.3f} m off"
        self._add(EventKind.LOOP_CLOSED, text)
        self.count({"markers: loops": 1})

    def loop_refused(self, ends: Ends, reason: object) -> None:
        """A candidate, or a verified loop, is not closed."""
        self._add(EventKind.LOOP_REFUSED, f"keyframes {_pair(ends)}: {reason}")

    def loop_removed(self, ends: Ends) -> None:
        """A loop that was closed earlier left the graph."""
        self._add(EventKind.LOOP_REMOVED, f"keyframes {_pair(ends)}: it no longer fits the graph")

    def graph(self, estimate: GraphEstimate) -> None:
        """Count what an update of the graph refused, dropped, anchored or repaired; tell each."""
        self.count(estimate.counts())
        for note in estimate.notes():
            self._add(EventKind.GRAPH, note, logging.WARNING if estimate.rebuilt else logging.INFO)

    def sensor(self, text: str, level: int = logging.INFO) -> None:
        """Something about the measurements of a sensor beside the camera."""
        self._add(EventKind.SENSOR, text, level)

    def count(self, counts: Mapping[str, int]) -> None:
        """Add to the counts; a name is one of TOTALS, or one with ``: reason`` behind."""
        for name, number in counts.items():
            if number:
                self.counts[name] = self.counts.get(name, 0) + number

    def _add(self, kind: EventKind, text: str, level: int = logging.INFO) -> None:
        self._keep(Event(self._frame, self._timestamp_s, kind, text), level)

    def _keep(self, event: Event, level: int = logging.INFO) -> None:
        if self.on_event is not None:
            self.on_event(event)
            return
        logger.log(level, "%s", event)
        self._events.append(event)


def event_row(event: Event) -> dict[str, object]:
    """The values of an event's line by column."""
    stamp, kind = f"{event.timestamp_s:.6f}", event.kind.value
    return {"index": event.frame, "timestamp": stamp, "kind": kind, "text": event.text}


def read_events(run: Path) -> tuple[Event, ...]:
    """The events of a run folder so far; none if an older version wrote it, without events.csv.

    Raises:
        InputError: a column that is missing, a value that is no number, or an unknown kind.
    """
    path = run / EVENTS
    if not path.is_file():
        return ()
    columns = read_table(path, EVENT_COLUMNS, "run again", growing=True)
    try:
        return tuple(
            Event(int(index), float(stamp), EventKind(kind), text)
            for index, stamp, kind, text in zip(
                *(columns[name] for name in EVENT_COLUMNS), strict=True
            )
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}; run again") from error


def totals(counts: Mapping[str, int]) -> dict[str, int]:
    """Each of TOTALS over all its reasons, then the counts by reason."""
    by_reason = {name: number for name, number in sorted(counts.items()) if name not in TOTALS}
    whole = {
        total: sum(n for name, n in counts.items() if name.partition(":")[0] == total)
        for total in TOTALS
    }
    return whole | by_reason


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


def _pair(ends: Ends) -> str:
    return f"{ends[0]} and {ends[1]}"
