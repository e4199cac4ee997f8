"""The map's process: graph, landmarks, loops, labels and objects, extended by keyframes.

It has a whole ``SlamSystem`` and does with it what an offline run does at a keyframe. Tracking uses
a copy of the map that is a little older: keyframes come with poses relative to a reference
keyframe and with landmarks that may have been fused since, and are updated here.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import no_ids
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import read_arrays, write_arrays
from bmask_slam.graph.geometry import carried_along
from bmask_slam.graph.smoother.storage import read_camera
from bmask_slam.labelling.label_views import LabelView, described
from bmask_slam.labelling.semantic_mapper import SemanticMapper
from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import (
    STATE_FILE,
    AddMeasurements,
    ChangeOwnFactors,
    Finish,
    FramesTracked,
    Handled,
    LostKeyframe,
    MapChanged,
    MapSaved,
    Masks,
    NewKeyframe,
    ObjectsTold,
    PruneLandmarks,
    PruneMask,
    Ready,
    Resent,
    RestoreObservations,
    SaveMap,
    SaveState,
    Started,
    StateSaved,
    TellObjects,
    UseCamera,
)
from bmask_slam.live.replica import DeltaMaker
from bmask_slam.runtime.memory import give_back_memory
from bmask_slam.semantics.segmenters.segmenter_table import LabelsOnly
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.frame_history import NO_KEYFRAME

logger = logging.getLogger(__name__)

NICENESS = 5
"""Tracking has priority where there are too few cores."""


def serve_map(
    channel: Channel,
    camera: Camera,
    config: SystemConfig,
    names: tuple[str, ...],
    state: Path | None,
    resent: int,
) -> None:
    """Handle messages until the channel ends, from a saved state on if there is one.

    Messages up to the number ``resent`` had been sent to a process that died.
    """
    os.nice(NICENESS)
    segmenter = LabelsOnly(names, config.semantics.segmenter)
    saved = None
    if state is not None:
        header, saved = read_arrays(state, STATE_FILE)
        camera = read_camera(header, state)
    system = SlamSystem(camera, config, segmenter)
    system.semantics = SemanticMapper(  # what moves: tracking knows
        camera, config.semantics, system.map, segmenter, on_masks=channel.send
    )
    system.events.on_event = channel.send
    if state is not None and saved is not None:
        system.restore(saved, state)
    server = MapServer(system, channel.send, resent)
    channel.send(Ready())
    if saved is not None:
        server.send_changes(-1, done=False)
    for number, message in channel.messages():
        server.handle(number, message)


class MapServer:
    """Handles the messages of tracking and the segmenter; answers go to ``send``."""

    def __init__(self, system: SlamSystem, send: Callable[[Any], None], resent: int = 0) -> None:
        self.system = system
        system.mapper.world.landmarks.reserved_only = True
        self._send = send
        self._resent = resent
        self._deltas = DeltaMaker()

    def handle(self, number: int, message: Any) -> None:
        """Handle one message."""
        self._send(Started(number))
        match message:
            case NewKeyframe():
                self.add_keyframe(number, message)
            case LostKeyframe():
                self.skip_keyframe(message)
            case LabelView() | Masks():
                self.label(message)
            case PruneLandmarks() | PruneMask() | RestoreObservations():
                self.change_observations(message)
            case UseCamera():
                self.use_camera(message)
            case AddMeasurements() | ChangeOwnFactors():
                self.take_from_user(message)
            case SaveState():
                self.save(number, message.path)
            case Resent():
                self._resent = message.number
            case TellObjects() | SaveMap():
                self.answer(message)
            case FramesTracked():
                self._add_frames(message)
            case Finish():
                self.finish(number, message)
            case _:
                raise TypeError(f"not a message for the map: {message!r}")
        self._send(Handled(number))

    def finish(self, number: int, message: Finish) -> None:
        """Optimise a last time, and save the state."""
        self.system.mapper.history.extend(message.history)
        if message.frames:
            self.system.frame_observations.restore(message.frames)
        self.system.finish()
        self._write(message.path)
        self._send(StateSaved(number, message.path))

    def take_from_user(self, message: AddMeasurements | ChangeOwnFactors) -> None:
        """Measurements, or changes of a user's factors; one that cannot enter is reported."""
        if isinstance(message, AddMeasurements):
            self.system.add_measurements(message.measurements)
            return
        try:
            self.system.mapper.change_own_factors(message.added, message.removed)
        except InputError as error:
            self.system.events.sensor(f"own factor refused: {error}", logging.WARNING)
        self.send_changes(-1, done=False)

    def change_observations(
        self, message: PruneLandmarks | PruneMask | RestoreObservations
    ) -> None:
        """Take out what moves, or put back what does not; landmarks that are gone are left out."""
        editor = self.system.map
        match message:
            case PruneLandmarks():
                ids = self.system.mapper.world.landmarks.remaining(message.ids)
                if len(ids):
                    editor.prune_landmarks(ids)
            case PruneMask():
                editor.prune_mask(message.keyframe_id, message.mask.unpacked(), message.widen_px)
            case RestoreObservations():
                editor.world.landmarks.reserve(*message.reserved, no_ids())
                back = message.keyframe_id, message.keypoints, message.patches
                editor.restore_observations(*back)
                self.send_changes(-1, done=False)

    def use_camera(self, message: UseCamera) -> None:
        """Go on with another camera, and send the map that was adjusted to it."""
        started_s = time.perf_counter()
        self.system.use_camera(message.camera, message.motions)
        self.send_changes(-1, done=False)
        ms, count = 1e3 * (time.perf_counter() - started_s), len(message.motions)
        logger.info("camera: %d keyframes interpreted anew in %.0f ms", count, ms)

    def save(self, number: int, path: Path) -> None:
        """Save the state; messages up to this number are then not needed any more."""
        try:
            self._write(path)
        except InputError as error:  # a later state may be written
            logger.warning("%s", error)
        else:
            self._send(StateSaved(number, path))
        give_back_memory()  # of the state, and of what the graph has changed since

    def answer(self, message: TellObjects | SaveMap) -> None:
        """Send the objects of the largest segment, or write the map for other runs."""
        failure = ""
        if isinstance(message, TellObjects):
            self._send(ObjectsTold(self.system.objects()))
            return
        try:
            self.system.save_map(message.path)
        except (InputError, OSError) as error:
            failure = str(error)
        self._send(MapSaved(message.path, failure))

    def _write(self, path: Path) -> None:
        write_arrays(path, STATE_FILE, {"camera": asdict(self.system.camera)}, self.system.state())

    def add_keyframe(self, number: int, message: NewKeyframe) -> None:
        """Add a keyframe that tracking made; changes are sent before and after optimisation."""
        started_s = time.perf_counter()
        if number > self._resent:  # else tracking may have been told to remove it
            self._deltas.mark_features_known(message.id)
        system = self.system
        if not self._has_reference(message):
            history, landmarks = message.history, message.reserved[1]
            self.skip_keyframe(LostKeyframe(message.id, NO_KEYFRAME, np.eye(4), history, landmarks))
            return
        system.mapper.world.landmarks.reserve(*message.reserved, message.tracked.new_ids)
        self._add_frames(message)
        tracked, segment = self._updated(message)
        no_rgb, no_depth = np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.float32)
        frame = Frame(message.frame_index, message.timestamp_s, no_rgb, no_depth)
        system.camera_tracker.segment = segment
        system.events.begin_frame(frame.index, frame.timestamp_s)
        _, keyframe = system.insert(frame, tracked, message.local_ids)
        assert keyframe.id == message.id, "tracking and map count keyframes differently"
        if system.semantics.enabled:
            system.semantics.await_masks(keyframe, message.depth_m)
        self.send_changes(message.id, done=False)
        system.mapper.optimise(keyframe)
        system.mapper.close_loops(keyframe)
        if system.semantics.enabled:
            system.semantics.follow_map()
        self.send_changes(message.id, done=True, update_ms=1e3 * (time.perf_counter() - started_s))

    def skip_keyframe(self, message: LostKeyframe) -> None:
        """Skip a keyframe; its frames are attached to its parent."""
        mapper = self.system.mapper
        mapper.history.extend(message.history)
        mapper.history.hand_over(message.id, message.parent_id, message.T_parent_lost)
        mapper.world.next_keyframe_id = message.id + 1
        landmarks = mapper.world.landmarks
        landmarks.extend_to(max(message.landmarks, len(landmarks)))
        self.send_changes(message.id, done=True)

    def _has_reference(self, message: NewKeyframe) -> bool:
        """Whether the reference of its pose is in the map; not if that began a lost segment."""
        reference, history = message.reference, self.system.mapper.history
        return reference is None or history.parent(reference[0])[0] != NO_KEYFRAME

    def label(self, message: LabelView | Masks) -> None:
        """Await a label view's masks, or use masks; those that cannot be used are skipped."""
        if isinstance(message, LabelView):
            self.system.semantics.await_view(message)
            return
        try:
            self.system.semantics.attach(message.keyframe_id, message.instances)
        except InputError as error:
            logger.warning("%s has no masks: %s", described(message.keyframe_id), error)

    def send_changes(self, keyframe_id: int, done: bool, update_ms: float = 0.0) -> None:
        """Send what changed in the map."""
        mapper = self.system.mapper
        delta = self._deltas.delta(mapper.world, mapper.history)
        loops, newest = len(mapper.loops.closed), mapper.sensors.newest
        self._send(MapChanged(keyframe_id, delta, done, update_ms, loops, newest))

    def _add_frames(self, message: NewKeyframe | FramesTracked) -> None:
        """Add the frames since the last keyframe, and how often they saw landmarks."""
        self.system.mapper.history.extend(message.history)
        landmarks, counts = self.system.map.world.landmarks, message.visibility
        ids = landmarks.current(counts.ids)
        np.add.at(landmarks.visible, ids, counts.visible)
        np.add.at(landmarks.found, ids, counts.found)

    def _updated(self, message: NewKeyframe) -> tuple[Tracked, int]:
        """The tracked frame in the map as it is now, and its segment."""
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
        first = np.sort(first[landmarks.in_map[ids[first]]])
        return replace(
            tracked,
            T_world_camera=carried_along(tracked.T_world_camera, T_world_reference, T_now),
            keypoints=tracked.keypoints[first],
            landmark_ids=ids[first],
            visible_ids=landmarks.remaining(tracked.visible_ids),
        ), parent.segment
