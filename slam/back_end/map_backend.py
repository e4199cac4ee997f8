"""The protocol of the owner of the map, and what its implementations share.

There are two: `back_end.mapper.Mapper` in the same process, and `RemoteMapper` of `live.processes`,
whose map and graph are in a process of their own.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from bmask_slam.events import EventLog
from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.sensors.streams import Measurements
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_editor import MapEditor
from bmask_slam.world.world_map import WorldMap


class MapBackend(MapEditor, Protocol):
    """Takes keyframes in, and keeps map, graph and frame history consistent.

    Attributes:
        events: what happened in map and graph; the front end reports to it too.
    """

    events: EventLog

    def insert(self, frame: Frame, tracked: Tracked, segment: int, local_ids: Ints) -> Keyframe:
        """Make a tracked frame a keyframe of a map segment: landmarks are made, fused and culled.

        ``local_ids`` (N,) are the landmarks that it was tracked against.
        """

    def optimise(self, keyframe: Keyframe) -> None:
        """Put a keyframe into the graph and read all poses and points back."""

    def add_measurements(self, new: Measurements) -> None:
        """Keep the measurements of a sensor; they become factors with the next keyframe."""

    def close_loops(self, keyframe: Keyframe) -> list[LoopConstraint]:
        """Look for known places from a keyframe; loops that hold move the map.

        Returns the loops that were closed, as far as they are known at once.
        """


def add_keyframe(world: WorldMap, frame: Frame, tracked: Tracked, segment: int) -> Keyframe:
    """Put a tracked frame into a map; it observes nothing yet."""
    keyframe = Keyframe(
        id=world.next_keyframe_id,
        frame_index=frame.index,
        timestamp_s=frame.timestamp_s,
        segment=segment,
        T_world_camera=tracked.T_world_camera,
        features=tracked.features,
        landmark_ids=np.full(len(tracked.features), -1, np.int64),
    )
    world.add_keyframe(keyframe)
    return keyframe
