"""The live system: the same step as offline, with map and segmentation in other processes."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from bmask_slam.back_end.reinterpretation import KeyframeMotion
from bmask_slam.calibration.keyframe_motions import motions_without_images
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.own_factors import own_factor, text_of
from bmask_slam.graph.files.array_file import nested, read_arrays
from bmask_slam.graph.sensors.streams import Measurements
from bmask_slam.labelling.label_views import LabelView
from bmask_slam.labelling.results import LandmarkLabels
from bmask_slam.labelling.semantic_mapper import SemanticMapper
from bmask_slam.live.messages import STATE_FILE, ChangeOwnFactors, ImageToSegment, Masks, UseCamera
from bmask_slam.live.processes.map_return import MapPlace
from bmask_slam.live.processes.remote_calibration import RemoteCalibration
from bmask_slam.live.processes.remote_mapper import RemoteMapper
from bmask_slam.live.processes.segmentation import BEGINNING_S, RemoteSegmenter
from bmask_slam.live.processes.supervision import RestartPolicy
from bmask_slam.moving.covered_parts import CoveredWatch, with_verdict
from bmask_slam.runtime.memory import short_pauses
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter
from bmask_slam.semantics.segmenters.segmenter_table import LabelsOnly
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.pose_filter import PoseFilter
from bmask_slam.tracking.results import FrameResult, Tracked
from bmask_slam.world.frame_history import NO_KEYFRAME
from bmask_slam.world.keyframe import Keyframe

if TYPE_CHECKING:  # it loads torch
    from bmask_slam.live.processes.remote_dense import RemoteDenseMapper

MASKS_S, CALIBRATION_S = 10.0, 15.0
"""Longest waits at the end: for masks of the last keyframes, for an estimate that is under way."""
FINISH_S, FINISH_KEYFRAME_S = 600.0, 0.5
"""Longest time of the last optimisation, and for each keyframe; 3937 took 144 s on idle cores."""
REFRESH_FRAMES = 5
"""Where no keyframes are made, the local map is chosen anew after so many frames."""


class LiveSystem(SlamSystem):
    """Tracks in the caller's process; ``finish`` fetches the map from its process.

    Attributes:
        remote: the copy of the map, and the process that owns the map.
        segmenter: the process that makes masks, if any.
        dense: the process that makes submaps, if any.
        calibration: the process that estimates the camera, if any.
        watch, covered: looks for what does not show the room in the images; what it found.
        label_names: the segmenter's classes by number.
        mask_listeners: called with the masks of each keyframe as they arrive.
    """

    mapper_type: type[RemoteMapper] = RemoteMapper

    def __init__(
        self,
        camera: Camera,
        config: SystemConfig,
        place: MapPlace,
        segmenter: RemoteSegmenter | None = None,
        dense: RemoteDenseMapper | None = None,
        calibration: RemoteCalibration | None = None,
    ) -> None:
        self.segmenter, self.dense, self.calibration = segmenter, dense, calibration
        self.watch: CoveredWatch | None = None
        self.covered = ""
        self._measured: deque[Measurements] = deque()
        self._own_factors, self._located = -1, 0
        self._filter = PoseFilter()
        self.label_names = (segmenter or NoSegmenter).labels.names
        self.mask_listeners: list[Callable[[Masks], None]] = []
        with ExitStack() as undo:
            self.remote = self.mapper_type(camera, config, self.label_names, place)
            undo.callback(self.remote.close)
            super().__init__(camera, config, back_end=self.remote)
            self.remote.worker.wait_until_ready(RestartPolicy().start_s)
            if dense is not None:
                dense.wait_until_ready()
            self.semantics = _RemoteSemantics(self)
            undo.enter_context(short_pauses())
            self._resources = undo.pop_all()

    def process(self, frame: Frame, features: Features | None = None) -> FrameResult:
        """Apply the other processes' results, then do the same step as offline.

        The second frame of a map segment waits for the masks of the first, up to ``BEGINNING_S``:
        it has no other landmarks, and a camera before a person would follow that person.
        """
        self.catch_up()
        while self.segmenter is not None and self.segmenter.waits_for_masks():
            time.sleep(0.001)
            self.catch_up()
        found = self.calibration
        if found is not None and self.remote.extends and found.begins_anew(frame, self.camera):
            self.events.calibration("the map so far is bent by depth's delay and begins anew")
            self.begin_anew()
        seen = self.watch.look(frame, self.camera) if self.watch is not None else None
        if seen is not None:
            self._found_covered(*seen)
        result = super().process(frame, features if seen is None else None)
        return self._filter.filtered(result) if self.config.smooth_trajectory else result

    def _found_covered(self, camera: Camera, text: str) -> None:
        """Leave it out, if the camera is not only told about; a map that grows begins anew."""
        self.watch, adopts = None, self.calibration is None or self.calibration.adopts
        self.covered = with_verdict(text, adopts)
        self.events.calibration(self.covered)
        if adopts:
            self.leave_out(camera)
            if self.remote.extends:  # the map so far may be bent by it
                self.begin_anew()

    def _map_uses_camera(self, camera: Camera, motions: Mapping[int, KeyframeMotion]) -> None:
        """Tell the map; tracking uses the camera from the next frame on."""
        self.remote.camera = camera
        self.remote.send(UseCamera(camera, dict(motions)))

    def add_measurements(self, new: Measurements) -> None:
        """Use the measurements of a sensor with the next frame; from any thread."""
        self.config.sensors.check_enabled(new.sensor)
        self._measured.append(new)

    def add_factor(self, factor: Any) -> int:
        """See `SensorInput.add_factor`; one that the map refuses is told as an event."""
        self._own_factors += 1
        text = text_of(own_factor(factor).factor)
        self.remote.send(ChangeOwnFactors(((self._own_factors, text),), ()))
        return self._own_factors

    def remove_factor(self, number: int) -> None:
        """See `SensorInput.remove_factor`."""
        self.remote.send(ChangeOwnFactors((), (number,)))

    def catch_up(self) -> None:
        """Update the copy of the map, pass masks on, and move tracking with the map."""
        while self._measured:
            self.remote.add_measurements(self._measured.popleft())
        reference, changes = self.camera_tracker.reference, self.remote.changes
        T_before = None if reference is None else reference.T_world_camera
        for masks in self.remote.catch_up():
            self.moving_objects.observe_masks(masks)
            if self.segmenter is not None:
                self.segmenter.urgent.pop(masks.keyframe_id, None)
        for found in self.segmenter.receive_masks() if self.segmenter else ():
            self.remote.send(found)
            for listener in self.mask_listeners:
                listener(found)
            if self.dense is not None:
                self.dense.add_masks(found, self.remote.world)
        if self.dense is not None:
            self._update_dense(self.dense, moved=self.remote.changes != changes)
        if reference is not None and T_before is not None and self.remote.changes != changes:
            self._follow_map(reference, T_before)
        if self.calibration is not None:
            said, answer = self.calibration.text, self.calibration.update(self.remote)
            if answer is not None and answer.camera is not None:
                self._use_found(answer.camera, answer.motions)
            if self.calibration.text != said:
                self.events.calibration(self.calibration.text)

    def _use_found(self, found: Camera, motions: Mapping[int, KeyframeMotion]) -> None:
        """Go on with a camera that calibration has found."""
        camera = replace(found, covered=self.camera.covered)
        paths = self.remote.history.trajectories(self.remote.world)
        moved = motions_without_images(self.frame_observations, paths, self.camera, camera)
        self.use_camera(camera, motions, moved)

    def _follow_map(self, reference: Keyframe, T_before: Array) -> None:
        """Move tracking with a keyframe whose pose was T_before (4, 4).

        If the keyframe that began the segment was lost, the next frame begins the segment anew.
        """
        tracker = self.camera_tracker
        parent_id, T_parent_reference = self.remote.history.parent(reference.id)
        if parent_id == NO_KEYFRAME:
            tracker.reference = None
            tracker.reset(0)
            return
        parent = self.remote.world.keyframes[parent_id]
        T_after = parent.T_world_camera @ T_parent_reference
        tracker.follow_map(T_before, T_after)
        self._filter.follow_map(T_before, T_after)
        tracker.refer_to(parent)
        tracker.segment = parent.segment

    def _update_dense(self, dense: RemoteDenseMapper, moved: bool) -> None:
        """Tell the dense map which keyframes are optimised, have masks or were culled."""
        remote, segmenter = self.remote, self.segmenter
        if moved:
            dense.remove_culled(remote.world, remote.awaits)
        dense.place(remote.world, remote.history, moved)
        lacks = segmenter.awaits if segmenter is not None else (lambda number: False)
        dense.update(remote.world, remote.awaits, lacks)

    def insert(self, frame: Frame, tracked: Tracked, local_ids: Ints) -> tuple[Tracked, Keyframe]:
        """Make a frame a keyframe; the map's process joins segments."""
        self.remote.reference = self.camera_tracker.reference
        segment = self.camera_tracker.segment
        return tracked, self.remote.insert(frame, tracked, segment, local_ids)

    def _record_pose(
        self, frame: Frame, tracked: Tracked, keyframe: Keyframe | None
    ) -> Array | None:
        """As offline, and calibration gets the frame, as it is tracked.

        Where no keyframes are made, the local map follows the landmarks in view.
        """
        T_world_camera = super()._record_pose(frame, tracked, keyframe)
        if self.calibration is not None:
            self.calibration.add_frame(frame, keyframe)
        reference = self.camera_tracker.reference
        if self.dense and reference and tracked.status.by_image and T_world_camera is not None:
            self.dense.frames.offer(frame, T_world_camera, reference, keyframe)
        if not self.remote.extends and T_world_camera is not None:
            self._located += 1
            near = self.remote.world.covisible(tracked.landmark_ids, 1)
            if near and self._located % REFRESH_FRAMES == 0:
                self.camera_tracker.refer_to(near[0][1])
        return T_world_camera

    def finish(self) -> None:
        """Let the other processes finish; afterwards this is an offline system with the map."""
        begin_s, calibration = time.monotonic(), self.calibration
        while self.segmenter and self.segmenter.waiting and time.monotonic() < begin_s + MASKS_S:
            time.sleep(0.02)
            self.catch_up()
        while calibration and calibration.busy and time.monotonic() < begin_s + CALIBRATION_S:
            time.sleep(0.02)
            self.catch_up()
        self.catch_up()
        limit_s = FINISH_S + FINISH_KEYFRAME_S * len(self.remote.world.keyframes)
        path = self.remote.finish(limit_s, self.frame_observations.state())
        state = read_arrays(path, STATE_FILE)[1]
        own = nested(dynamics=self.moving_objects.state())
        labels = LabelsOnly(self.label_names, self.config.semantics.segmenter)
        whole = SlamSystem(self.camera, self.config, labels)
        whole.restore({**state, **own}, path)
        self.map, self.camera_tracker = whole.map, whole.camera_tracker
        self.semantics, self.moving_objects = whole.semantics, whole.moving_objects
        self._stop_workers()

    def close(self) -> None:
        """Kill the other processes; what they have not sent is lost."""
        self._stop_workers()
        for worker in (self.dense, self.calibration):
            if worker is not None:
                worker.close()

    def _stop_workers(self) -> None:
        """Kill the map's and the segmenter's process, and restore the settings."""
        self._resources.close()
        if self.segmenter is not None:
            self.segmenter.close()


class _RemoteSemantics(SemanticMapper):
    """Requests a keyframe's masks and submap from other processes."""

    def __init__(self, system: LiveSystem) -> None:
        super().__init__(system.camera, system.config.semantics, system.map)
        self._system = system

    def observe(self, frame: Frame, keyframe: Keyframe, urgent: bool = False) -> None:
        """Send the requests; does not wait for answers."""
        if (segmenter := self._system.segmenter) is not None:
            self._segments(keyframe)
            segmenter.request(ImageToSegment(keyframe.id, frame.rgb, frame.name))
            if urgent:
                begins = self._system.map.world.is_alone(keyframe)
                segmenter.hurry(keyframe.id, BEGINNING_S if begins else 0.0)
        if self._system.dense is not None:
            self._system.dense.add_keyframe(keyframe.id, frame)

    @property
    def _takes_views(self) -> bool:
        """Whether the segmenter waits for work, and the map grows."""
        segmenter, remote = self._system.segmenter, self._system.remote
        return segmenter is not None and not segmenter.waiting and remote.extends

    def _request(self, frame: Frame, view: LabelView) -> None:
        self._system.remote.send(view)
        if (segmenter := self._system.segmenter) is not None:
            segmenter.request(ImageToSegment(view.number, frame.rgb, frame.name))

    def landmark_labels(self, ids: Ints, keyframes: Sequence[Keyframe]) -> LandmarkLabels | None:
        """None: the map's process has them."""
        return None
