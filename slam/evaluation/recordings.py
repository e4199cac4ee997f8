"""The recordings of a merged run, and its stamps in their own clocks.

``recordings.json`` lists them, each with the part of its stamps that counts and with what is added
to them, so that no two overlap. A reference has the stamps of a recording.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from bmask_slam.events import Event
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import MAX_NUMBER, InputError
from bmask_slam.graph.files.json_file import STRICT, read_json
from bmask_slam.graph.trajectory import Trajectory

JOINED = "recordings.json"
COLOUR_MARGIN_S = 1e-4
"""Colour images so much before the first one of a part and after its last one belong to it."""
CURE = "merge the runs again"
OVERLAPPING = (
    "%s: merging moved its stamps, and its recordings overlap without that, so that the reference "
    "may meet another recording's poses; evaluate the trajectory_run_N.txt beside it instead"
)


class Part(BaseModel):
    """A recording, and which of it counts.

    Attributes:
        sequence: its folder or file.
        begin_s, end_s: stamps of the first and the last colour image, in its own clock.
        shift_s: added to its stamps.
    """

    model_config = STRICT
    sequence: str
    begin_s: float
    end_s: float
    shift_s: float


class _File(BaseModel):
    """What recordings.json holds."""

    model_config = STRICT
    recordings: list[Part]


def is_joined(path: Path) -> bool:
    """Whether a path is named as a list of recordings."""
    return path.name == JOINED


def write_parts(path: Path, parts: Sequence[Part]) -> None:
    """Write recordings.json."""
    content = {"recordings": [part.model_dump() for part in parts]}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_parts(path: Path) -> list[Part]:
    """Read recordings.json. Raises InputError for a broken one."""
    listed = read_json(path, _File, CURE).recordings
    if not listed:
        raise InputError(f"{path}: lists no recording; {CURE}")
    for part in listed:
        if is_joined(Path(part.sequence)):
            raise InputError(f"{path}: lists another list, {part.sequence}; {CURE}")
        if not max(map(abs, (part.begin_s, part.end_s, part.shift_s))) <= MAX_NUMBER:
            raise InputError(f"{path}: stamps from {part.begin_s} s are no seconds; {CURE}")
    return listed


@dataclass(frozen=True)
class MergedClock:
    """The clock of a run: that of its recording, or of several, to whose stamps merging has added.

    Attributes:
        parts: the recordings whose stamps were moved; empty if none was, or if the moved stamps
            stay since ``overlapping``.
        overlapping: some were moved, and in their own clocks recordings overlap, so that a stamp
            would not tell which one is meant.
    """

    parts: tuple[Part, ...] = ()
    overlapping: bool = False

    def own_s(self, stamps_s: Array) -> Array:
        """Stamps (N,) of the run in the clocks of its recordings."""
        own_s = stamps_s.copy()
        for part in self.parts:
            begin_s, end_s = part.begin_s + part.shift_s, part.end_s + part.shift_s
            inside = stamps_s >= begin_s - COLOUR_MARGIN_S
            inside &= stamps_s <= end_s + COLOUR_MARGIN_S
            own_s[inside] -= part.shift_s
        return own_s

    def own_trajectory(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory of the run by the stamps of its recordings."""
        if not self.parts:
            return trajectory
        return Trajectory(self.own_s(trajectory.timestamps_s), trajectory.poses_world_camera)

    def own_events(self, events: Sequence[Event]) -> list[Event]:
        """Events of the run by the stamps of its recordings."""
        if not self.parts:
            return list(events)
        stamps_s = self.own_s(np.array([event.timestamp_s for event in events])).tolist()
        return [replace(e, timestamp_s=s) for e, s in zip(events, stamps_s, strict=True)]


def merged_clock(run: Path) -> MergedClock:
    """The clock of the run in a folder. Raises InputError for a broken recordings.json."""
    parts = read_parts(run / JOINED) if (run / JOINED).is_file() else []
    moved = tuple(part for part in parts if part.shift_s)
    spans_s = sorted((part.begin_s, part.end_s) for part in parts)
    overlapping = any(b[0] <= a[1] + 2 * COLOUR_MARGIN_S for a, b in pairwise(spans_s))
    return MergedClock(overlapping=True) if moved and overlapping else MergedClock(moved)
