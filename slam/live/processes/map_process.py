"""The map's own process: graph, landmarks, loops, labels and objects, fed by keyframes.

It holds a whole ``SlamSystem`` and does to it what an offline run does at a keyframe. Tracking is
elsewhere and a little behind or ahead: keyframes come with poses relative to a reference keyframe
and with landmarks that may have been fused meanwhile, and are brought up to date here.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import FileKind, read_arrays, write_arrays
from bmask_slam.graph.geometry import carried_along
from bmask_slam.labelling.semantic_mapper import SemanticMapper
from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import (
    Began,
    Finish,
    LostKeyframe,
    MapChanged,
    Masks,
    NewKeyframe,
    PruneLandmarks,
    PruneMask,
    Ready,
    RestoreObservations,
    SaveState,
    Sightings,
    StateSaved,
)
from bmask_slam.live.replica import DeltaMaker
from bmask_slam.runtime.memory import give_back_memory
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.frame_history import NOBODY

logger = logging.getLogger(__name__)

STATE_FILE = FileKind("live state", 5)
NICENESS = 5
"""Tracking goes first where there is a processor too few."""


class LabelledNothing(NoSegmenter):
    """Finds nothing itself: masks come from another process, with these labels."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.labels = LabelSet(names)


def serve_map(
    channel: Channel,
    camera: Camera,
    config: SystemConfig,
    names: tuple[str, ...],
    state: Path | None,
) -> None:
    """Keep a map, from a saved state on if there is one, until the channel ends."""
    os.nice(NICENESS)
    segmenter = LabelledNothing(names)
    system = SlamSystem(camera, config, segmenter)
    system.semantics = SemanticMapper(
        camera,
        config.semantics,
        system.map,
        segmenter,
        on_masks=channel.send,  # to tracking's side, where it is known what moves
    )
    if state is not None:
        system.restore(read_arrays(state, STATE_FILE)[1], state)
    keeper = MapKeeper(system, channel.send)
    channel.send(Ready())
    if state is not None:
        keeper.tell(-1, done=False)
    for number, message in channel.messages():
        keeper.handle(number, message)


class MapKeeper:
    """Carries out what tracking and the segmenter say; ``send`` takes the answers."""

    def __init__(self, system: SlamSystem, send: Callable[[Any], None]) -> None:
        self.system = system
        self._send = send
        self._deltas = DeltaMaker()

    def handle(self, number: int, message: Any) -> None:
        """Carry out one message."""
        self._send(Began(number))
        match message:
            case NewKeyframe():
                self.add(message)
            case LostKeyframe():
                self.pass_over(message)
            case Masks():
                self.attach(message)
            case PruneLandmarks():
                ids = self.system.mapper.world.landmarks.living(message.ids)
                if len(ids):
                    self.system.map.prune_landmarks(ids)
            case PruneMask():
                mask = message.mask.unpacked()
                self.system.map.prune_mask(message.keyframe_id, mask, message.widen_px)
            case RestoreObservations():
                back = message.keypoints, message.patches
                self.system.map.restore_observations(message.keyframe_id, *back)
                self.tell(-1, done=False)
            case SaveState():
                self.save(number, message.path)
            case Finish():
                self.system.mapper.history.extend(message.history)
                self.system.finish()
                write_arrays(message.path, STATE_FILE, {}, self.system.state())
                self._send(StateSaved(number, message.path))
            case _:
                raise TypeError(f"no message for the map: {message!r}")

    def save(self, number: int, path: Path) -> None:
        """Save the state, so that messages up to this number need not be sent again."""
        try:
            write_arrays(path, STATE_FILE, {}, self.system.state())
        except OSError as error:  # a later one may find room
            logger.warning("%s: cannot be written (%s)", path, error.strerror)
        else:
            self._send(StateSaved(number, path))
        give_back_memory()  # of the state, and of what the graph has changed since

    def add(self, message: NewKeyframe) -> None:
        """Take in a keyframe as tracking made it; two deltas follow, the first at once."""
        started_s = time.perf_counter()
        system = self.system
        if not self._has_place(message):
            self.pass_over(LostKeyframe(message.id, NOBODY, np.eye(4), message.history))
            return
        self._count(message.sightings)
        system.mapper.history.extend(message.history)
        tracked, segment = self._brought_up_to_date(message)
        nothing = np.zeros((0, 0), np.float32)
        frame = Frame(
            message.frame_index, message.timestamp_s, np.zeros((0, 0, 3), np.uint8), nothing
        )
        self._deltas.has_features(message.id)
        system.camera_tracker.segment = segment
        _, keyframe = system.insert(frame, tracked, message.local_ids)
        assert keyframe.id == message.id, "tracking and map count keyframes differently"
        if system.semantics.enabled:
            system.semantics.await_masks(keyframe, message.depth_m)
        self.tell(message.id, done=False)
        system.mapper.optimise(keyframe)
        system.mapper.close_loops(keyframe)
        if system.semantics.enabled:
            system.semantics.follow_map()
        elapsed_ms = 1e3 * (time.perf_counter() - started_s)
        self.tell(message.id, done=True, update_ms=elapsed_ms)

    def pass_over(self, message: LostKeyframe) -> None:
        """Count a keyframe that could not be taken in; another has its frames."""
        mapper = self.system.mapper
        mapper.history.extend(message.history)
        mapper.history.hand_over(message.id, message.parent_id, message.T_parent_lost)
        mapper.world.next_keyframe_id = message.id + 1
        landmarks = mapper.world.landmarks
        landmarks.extend_to(max(message.landmarks, len(landmarks)))
        self.tell(message.id, done=True)

    def _has_place(self, message: NewKeyframe) -> bool:
        """Whether what its pose refers to is in the map; not if that was lost with its place."""
        reference, history = message.reference, self.system.mapper.history
        return reference is None or history.parent(reference[0])[0] != NOBODY

    def attach(self, message: Masks) -> None:
        """Use a keyframe's masks; those that cannot be used are passed over."""
        try:
            self.system.semantics.attach(message.keyframe_id, message.instances)
        except InputError as error:
            logger.warning("keyframe %d has no masks: %s", message.keyframe_id, error)

    def tell(self, keyframe_id: int, done: bool, update_ms: float = 0.0) -> None:
        """Send what changed."""
        mapper = self.system.mapper
        delta = self._deltas.delta(mapper.world, mapper.history)
        loops = len(mapper.loops.closed)
        self._send(MapChanged(keyframe_id, delta, done, update_ms, loops))

    def _count(self, sightings: Sightings) -> None:
        landmarks = self.system.mapper.world.landmarks
        ids = landmarks.current(sightings.ids)
        np.add.at(landmarks.visible, ids, sightings.visible)
        np.add.at(landmarks.found, ids, sightings.found)

    def _brought_up_to_date(self, message: NewKeyframe) -> tuple[Tracked, int]:
        """The tracked frame where the map is by now, and its segment."""
        tracked, mapper = message.tracked, self.system.mapper
        if message.reference is None:
            return tracked, message.segment
        reference_id, T_world_reference = message.reference
        parent_id, T_parent_reference = mapper.history.parent(reference_id)
        parent = mapper.world.keyframes[parent_id]
        T_now = parent.T_world_camera @ T_parent_reference
        landmarks = mapper.world.landmarks
        ids = landmarks.current(tracked.landmark_ids)
        _, first = np.unique(ids, return_index=True)
        first = np.sort(first[landmarks.alive[ids[first]]])
        return replace(
            tracked,
            T_world_camera=carried_along(tracked.T_world_camera, T_world_reference, T_now),
            keypoints=tracked.keypoints[first],
            landmark_ids=ids[first],
            visible_ids=landmarks.living(tracked.visible_ids),
        ), parent.segment
