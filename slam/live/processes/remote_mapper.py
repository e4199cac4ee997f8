"""Tracking's side of the map: a copy to track against, and the process that owns the original."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.back_end.map_backend import add_keyframe
from bmask_slam.events import Event, EventLog
from bmask_slam.features.descriptor_index import DescriptorIndex
from bmask_slam.graph.arrays import Arrays, Ints, Mask, no_ids
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.sensors.streams import Measurements
from bmask_slam.labelling.awaited_masks import kept_depth
from bmask_slam.labelling.results import MapObjects
from bmask_slam.live.messages import (
    AddMeasurements,
    Finish,
    Handled,
    LostKeyframe,
    MapChanged,
    MapSaved,
    NewKeyframe,
    ObjectsTold,
    PruneLandmarks,
    PruneMask,
    RestoreObservations,
    SaveState,
    TellObjects,
    VisibilityCounts,
)
from bmask_slam.live.processes.map_return import MapPlace
from bmask_slam.live.processes.map_worker import MapWorker
from bmask_slam.live.replica import UntoldCounts, apply_delta, landmarks_ahead
from bmask_slam.loops.verification import LoopConstraint
from bmask_slam.semantics.instances.instances import PackedMask
from bmask_slam.sensing.sensor_fusion import SensorFusion
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.appearance import Patches
from bmask_slam.world.frame_history import NO_KEYFRAME, Entries, FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

SAVE_EVERY, SAVE_SHARE, MAX_UNSAVED = 20, 0.05, 2000  # a state is the whole map
"""Keyframes between saved states, least and as a share of the map's; most messages between them."""
MAX_PENDING = 3
"""Largest number of keyframes that wait for the process; then no further one is accepted."""


class RemoteMapper:
    """The back end of a live system: a copy of the map, and the process that owns the original.

    Attributes:
        world: the copy, with the keyframes that the process has not handled yet.
        camera: of the frames that are tracked.
        history: of every tracked frame.
        places: index of the keyframes' descriptors, for relocalisation.
        events: of tracking and, as they arrive, of the process.
        sensors: measurements of sensors beside the camera, for the motion in a blackout.
        update_ms: time that the process took for each keyframe.
        changes: how often the copy was updated.
        reference: the keyframe that tracking refers to; set before ``insert``.
        handled: largest number of a message that the process has handled.
        worker: the process that owns the map.
        objects: as the process told them last; None before.
        maps_saved: answers to ``SaveMap``, which their reader removes.
        extends: whether keyframes are made; else frames are only located in the map.
        counts_anew: landmarks are counted anew from each keyframe on: fewer keyframes are made.
    """

    counts_anew = True

    def __init__(
        self, camera: Camera, config: SystemConfig, names: tuple[str, ...], place: MapPlace
    ) -> None:
        self.world, self.history = WorldMap(), FrameHistory()
        self.camera, self._subpixel = camera, config.tracking.subpixel
        self.places, self.events = DescriptorIndex(config.loops.index), EventLog()
        self.sensors = SensorFusion(config.sensors, EventLog())  # the process reports
        self.update_ms: list[float] = []
        self.loops_closed = self.changes = self.handled = 0
        self.reference: Keyframe | None = None
        self._folder, self._has_labels = place.folder, len(names) > 1
        self.objects: MapObjects | None = None
        self.maps_saved: list[MapSaved] = []
        self.extends, self._asked = True, False
        self._sent_frames = self._saved_keyframes = self._owned = self._unsaved = 0
        self._pending, self._counts = set[int](), UntoldCounts(self.counts_anew)
        self.worker = MapWorker((camera, config, names), self._replacement, place)

    @property
    def pending(self) -> int:
        """Number of keyframes that the process has not finished."""
        return len(self._pending)

    def awaits(self, keyframe_id: int) -> bool:
        """Whether the process has not finished a keyframe."""
        return keyframe_id in self._pending

    @property
    def idle(self) -> bool:
        """Whether the process waits for work."""
        return not self._pending

    @property
    def accepts_keyframes(self) -> bool:
        """Whether a keyframe will be worked on soon: not while too many wait."""
        return self.extends and self.pending < MAX_PENDING and not self.given_up

    @property
    def landmarks_ahead(self) -> Ints:
        """See ``MapReader``: those that the process's map did not have when it answered last."""
        return self._owned + np.flatnonzero(self.world.landmarks.in_map[self._owned :])

    @property
    def given_up(self) -> bool:
        """Whether the process died too often to be restarted."""
        return self.worker.given_up

    def insert(self, frame: Frame, tracked: Tracked, segment: int, local_ids: Ints) -> Keyframe:
        """Add a tracked frame to the copy as a keyframe, and send it to the process.

        Until the answer comes it observes the tracked landmarks only; those of its own that have
        depth are among ``landmarks_ahead``.
        """
        reference, counts = self.reference, self._visibility_counts()
        keyframe = add_keyframe(self.world, frame, tracked, segment)
        self.world.observe(keyframe, tracked.keypoints, tracked.landmark_ids)
        new_ids, reserved = landmarks_ahead(self.world, keyframe, self.camera, self._subpixel)
        self._counts.are_known(new_ids[new_ids >= 0], self.world.landmarks)
        self.world.store_features(keyframe)
        self.places.add(keyframe.id, keyframe.features.descriptors)
        self._pending.add(keyframe.id)
        made = NewKeyframe(
            keyframe.id,
            frame.index,
            frame.timestamp_s,
            replace(tracked, new_ids=new_ids),
            segment,
            None if reference is None else (reference.id, reference.T_world_camera),
            local_ids,
            reserved,
            counts,
            self._unsent_history(),
            kept_depth(frame.depth_m if self._has_labels else frame.depth_m[:0]),
        )
        self.send(made)
        return keyframe

    def add_measurements(self, new: Measurements) -> None:
        """Keep the measurements of a sensor, and send them to the process."""
        self.sensors.add(new, self.world)
        self.send(AddMeasurements(new))

    def optimise(self, keyframe: Keyframe) -> None:
        """Nothing: the process does it."""

    def close_loops(self, keyframe: Keyframe) -> list[LoopConstraint]:
        """Nothing: the process does it."""
        return []

    def prune_mask(self, keyframe_id: int, mask: Mask, widen_px: int) -> None:
        """As ``Mapper.prune_mask``; the map is changed when the answer comes."""
        self.send(PruneMask(keyframe_id, PackedMask.of(mask), widen_px))

    def prune_landmarks(self, landmark_ids: Ints) -> None:
        """As ``Mapper.prune_landmarks``; tracking drops them at once."""
        self.world.landmarks.in_map[landmark_ids] = False
        self.send(PruneLandmarks(landmark_ids))

    def restore_observations(self, keyframe_id: int, keypoints: Ints, patches: Patches) -> None:
        """As ``Mapper.restore_observations``; the map is changed when the answer comes."""
        if len(keypoints):
            landmarks = self.world.landmarks
            reserved = len(landmarks), len(landmarks) + len(keypoints)
            landmarks.reserve(*reserved, no_ids())
            self.send(RestoreObservations(keyframe_id, keypoints, patches, reserved))

    def send(self, message: Any) -> None:
        """Send a message, which is sent again to a new process if this one dies."""
        self.worker.send(message)
        self._unsaved += 1
        if self._unsaved == MAX_UNSAVED:
            self.save_state()

    def ask_for_objects(self) -> None:
        """Let the process send its objects, unless it is asked already."""
        if not self._asked and not self.given_up:
            self._asked = True
            self.send(TellObjects())

    def save_state(self) -> None:
        """Let the process save its state, from which it can be started again."""
        self._unsaved = 0
        self.send(SaveState(self._folder / ".live-state"))

    def catch_up(self, timeout_s: float = 0.0) -> list[Any]:
        """Apply the process's answers to the copy; waits at most so long for the first.

        Returns the messages that are not about the map: masks, for the moving-object filter.
        """
        others = self._apply_answers(self.worker.receive(timeout_s))
        if self.worker.has_crashed:
            others += self._apply_answers(self.worker.receive_last())
            self.worker.restart()
        return others

    def _apply_answers(self, messages: list[Any]) -> list[Any]:
        """Apply the changes of the map, and keep events; returns the other messages."""
        others = []
        for message in messages:
            match message:
                case MapChanged():
                    self._apply(message)
                case Event():
                    self.events.receive(message)
                case ObjectsTold():
                    self.objects, self._asked = message.objects, False
                case MapSaved():
                    self.maps_saved.append(message)
                case Handled():
                    self.handled = max(message.number, self.handled)
                case _:
                    others.append(message)
        return others

    def finish(self, timeout_s: float, frames: Arrays) -> Path:
        """Let the process optimise a last time and save its state; returns the file's path.

        ``frames`` is the state of what frames observe that are no keyframes.

        Raises:
            InputError: it did not finish within the timeout.
        """
        path = self._folder / ".live-final"
        if self.given_up:
            self.worker.try_again()
        self.send(Finish(path, self._unsent_history(), frames))
        deadline_s = time.monotonic() + timeout_s
        while self.worker.busy and not self.given_up and time.monotonic() < deadline_s:
            self.catch_up(0.1)
        self.worker.stop()
        if self.worker.busy:
            died = self.given_up
            raise InputError(f"the map's process {'died too often' if died else 'did not finish'}")
        return path

    def close(self) -> None:
        """Kill the process and remove its files."""
        self.worker.kill()
        for path in self._folder.glob(".live-*"):
            path.unlink(missing_ok=True)

    def _replacement(self, message: Any) -> LostKeyframe | None:
        """The message in place of one of which two processes died, if it needs one."""
        if not isinstance(message, NewKeyframe):
            return None
        parent_id, T_parent_lost = NO_KEYFRAME, np.eye(4)
        if message.reference is not None:
            parent_id, T_world_parent = message.reference
            T_parent_lost = inverse(T_world_parent) @ message.tracked.T_world_camera
        lost = message.id, parent_id, T_parent_lost
        self.history.hand_over(*lost)
        return LostKeyframe(*lost, message.history, len(self.world.landmarks))

    def _apply(self, message: MapChanged) -> None:
        new = apply_delta(message.delta, self.world, self.history)
        self._counts.are_known(new, self.world.landmarks)
        known_ids, present = set(self.places.keyframe_ids), self.world.keyframes
        for keyframe_id in known_ids - present.keys():
            self.places.remove(keyframe_id)
        for keyframe_id in sorted(present.keys() - known_ids):
            self.places.add(keyframe_id, present[keyframe_id].features.descriptors)
        self.changes, self._owned = self.changes + 1, message.delta.size
        self.loops_closed, self.sensors.newest = message.loops_closed, message.newest
        if not message.done:
            return
        self.update_ms.append(message.update_ms)
        self.world.release_memory()
        self._pending -= set(message.delta.keyframe_ids.tolist()) | {message.keyframe_id}
        made = message.keyframe_id + 1
        if made - self._saved_keyframes >= max(SAVE_EVERY, SAVE_SHARE * len(present)):
            self._saved_keyframes = made
            self.save_state()

    def _visibility_counts(self) -> VisibilityCounts:
        return VisibilityCounts(*self._counts.take(self.world.landmarks))

    def _unsent_history(self) -> Entries:
        entries = self.history.since(self._sent_frames)
        self._sent_frames += len(entries)
        return entries
