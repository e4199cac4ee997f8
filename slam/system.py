"""The system: one step a frame."""

from __future__ import annotations

import logging
from dataclasses import replace

from bmask_slam.back_end.frame_adjustment import adjust_with_frames
from bmask_slam.back_end.map_backend import MapBackend
from bmask_slam.back_end.mapper import Mapper
from bmask_slam.back_end.marker_loops import join_by_markers
from bmask_slam.back_end.reinterpretation import beginning
from bmask_slam.back_end.segment_joining import can_join
from bmask_slam.features.brisk import BriskExtractor, Features
from bmask_slam.features.marker_detection import MarkerDetector
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.labelling.semantic_mapper import SemanticMapper
from bmask_slam.moving.moving_object_filter import MovingObjectFilter
from bmask_slam.moving.static_features import StaticFeatures
from bmask_slam.runtime.memory import give_back_memory
from bmask_slam.runtime.stage_clock import stage
from bmask_slam.semantics.segmenters.segmenter import Segmenter, begin_early, check_segmenter
from bmask_slam.sequences.frame import Frame, check_frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.system_state import SavedSystem
from bmask_slam.tracking.camera_tracker import CameraTracker
from bmask_slam.tracking.keyframe_decision import KeyframeDecision
from bmask_slam.tracking.results import FrameResult, Tracked, TrackingStatus
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.frame_observations import FrameObservations
from bmask_slam.world.keyframe import Keyframe

logger = logging.getLogger(__name__)


class SlamSystem(SavedSystem):
    """RGB-D frames in, poses out; the map and the graph grow on the way.

    Attributes:
        camera, config: as given.
        map: the owner of map and graph. events: what happened; all parts report to it.
        camera_tracker: tracks frames against the map.
        moving_objects: keeps what moves out of tracking and out of the map.
        keyframes: decides which frames stay in the map.
        semantics: labels landmarks and finds objects.
        frame_observations: what tracked frames that are no keyframes observe.
        markers: finds fiducial markers in keyframes; None where they are not looked for.
        stage_ms: wall time of each stage of the last frame, in milliseconds.
    """

    def __init__(
        self,
        camera: Camera,
        config: SystemConfig | None = None,
        segmenter: Segmenter | None = None,
        back_end: MapBackend | None = None,
    ):
        """An empty map, in this process unless a back end is given.

        Without a segmenter nothing is labelled, and moving things are found by depth alone.

        Raises:
            InputError: the segmenter is a name or another object that is none.
        """
        if segmenter is not None:
            check_segmenter(segmenter)
        self.camera = camera
        self.config = config = config or SystemConfig()
        self.extractor = BriskExtractor(camera, config.features)
        tracker = Tracker(camera, config.tracking)
        self.map = back_end or Mapper(camera, tracker, config.back_end)
        self.events = self.map.events
        self.camera_tracker = CameraTracker(
            tracker, self.map, config.relocalisation, config.mapping.local_map, self.extractor
        )
        self.moving_objects = MovingObjectFilter(
            camera, config.moving_objects, config.features, self.map, self.camera_tracker
        )
        self.keyframes = KeyframeDecision(
            camera, config.keyframes, self.map, self.camera_tracker, config.mapping.min_found_ratio
        )
        self.semantics = SemanticMapper(
            camera, config.semantics, self.map, segmenter, self.moving_objects.observe_masks
        )
        markers = config.sensors.markers
        self.markers = MarkerDetector(markers, config.features) if markers.enabled else None
        self.stage_ms: dict[str, float] = {}
        self.frame_observations = FrameObservations()
        self._first_keyframe = 0  # of this session

    def process(self, frame: Frame, features: Features | None = None) -> FrameResult:
        """Track a frame and, if it becomes a keyframe, extend and optimise the map.

        ``features`` are those that ``prepare`` made of the frame, if it did.

        Raises:
            InputError: the frame does not fit the camera, or its stamp does not go forward.
        """
        frame = self._begin(frame)
        self._use_masks()
        features = self._extract(frame, features)
        self._look(frame, features)
        static = self._without_moving(frame, features)
        tracked = self._track(static)
        restored = self._learn_motion(frame, tracked, static)
        tracked, keyframe, reason = self._make_keyframe(frame, tracked, restored)
        if keyframe:
            self._optimise(keyframe)
            self._close_loops(keyframe)
        self._label(frame, tracked, keyframe, static)
        return FrameResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=tracked.status,
            T_world_camera=self._record_pose(frame, tracked, keyframe),
            segment=self.camera_tracker.segment,
            matches=tracked.matches,
            inliers=len(tracked.landmark_ids),
            ignored=static.ignored,
            mostly_moving=static.mostly_moving,
            information=tracked.information if tracked.information.any() else None,
            keyframe_id=keyframe.id if keyframe else None,
            keyframe_reason=reason,
            stage_ms=self.stage_ms,
            events=self.events.take(),
        )

    def prepare(self, frame: Frame) -> Features:
        """The frame's features; pure, so that it may run ahead in another thread."""
        return self.extractor.extract(frame)

    def insert(self, frame: Frame, tracked: Tracked, local_ids: Ints) -> tuple[Tracked, Keyframe]:
        """Make a frame a keyframe; if it is recognised in another segment, they are joined.

        ``local_ids`` are the landmarks that it was tracked against. Returns the frame as it is
        tracked in the joined map, and the keyframe.
        """
        tracked = self._join_segments(tracked)
        segment = self.camera_tracker.segment
        return tracked, self.map.insert(frame, tracked, segment, local_ids)

    def finish(self) -> None:
        """The last optimisation; the map is then final."""
        self.semantics.use_masks(everything=True)
        if self.config.final_adjustment:
            self.mapper.finish()
            self._adjust_frames()
        if self.config.smooth_trajectory:
            self.map.history.smooth(self.map.world)
        known = self.map.world.in_segment(self.largest_segment())
        if self._first_keyframe and known and known[0].id >= self._first_keyframe:
            logger.warning(
                "no frame was recognised in the map: the trajectory has its own coordinate frame"
            )

    def _adjust_frames(self) -> None:
        """Adjust the whole map again with what other frames observe."""
        if self.config.adjust_frames:
            give_back_memory()  # that the optimisation before took
            adjust_with_frames(self.mapper, self.frame_observations, self.config.graph)

    def _begin(self, frame: Frame) -> Frame:
        frame = check_frame(frame, self.camera, self.camera_tracker.timestamp_s)
        self.stage_ms = {}
        self.camera_tracker.begin_frame(frame.timestamp_s)
        self.events.begin_frame(frame.index, frame.timestamp_s)
        return frame

    @stage("semantics")
    def _use_masks(self) -> None:
        self.semantics.begin_frame()

    @stage("features")
    def _extract(self, frame: Frame, features: Features | None) -> Features:
        return features if features is not None else self.prepare(frame)

    @stage("tracking")
    def _look(self, frame: Frame, features: Features) -> None:
        self.camera_tracker.look(frame, features)

    @stage("moving")
    def _without_moving(self, frame: Frame, features: Features) -> StaticFeatures:
        return self.moving_objects.filter(frame, features)

    @stage("tracking")
    def _track(self, static: StaticFeatures) -> Tracked:
        return self._after_beginning(self._reported(self.camera_tracker.track(static.features)))

    def _reported(self, tracked: Tracked) -> Tracked:
        """A tracked frame, once it is reported that it is lost, found again or begins a segment."""
        if not tracked.status.by_image:
            self.events.lost(tracked.matches, tracked.status is TrackingStatus.DEAD_RECKONING)
        elif self.camera_tracker.reference is None:
            self.events.new_segment(self.camera_tracker.segment)
        else:
            self.events.tracked(len(tracked.landmark_ids))
        return tracked

    def _after_beginning(self, tracked: Tracked) -> Tracked:
        """A frame; if it is the second of a segment, after it has told how the first one moved."""
        tracker, world, first = self.camera_tracker, self.map.world, self.camera_tracker.reference
        if not self.camera.rolling_shutter_s or first is None or self.keyframes.frames_since:
            return tracked
        previous = tracker.motion.previous(tracker.lost_frames)
        if previous is None or not world.is_alone(first) or not tracked.status.by_image:
            return tracked
        found = beginning(world, first, previous, tracked, self.camera)
        if found is None:
            return tracked
        self._map_uses_camera(self.camera, {first.id: found.motion})
        return found.second

    @stage("moving")
    def _learn_motion(self, frame: Frame, tracked: Tracked, static: StaticFeatures) -> bool:
        return self.moving_objects.learn(frame.timestamp_s, tracked, static)

    @stage("keyframe")
    def _make_keyframe(
        self, frame: Frame, tracked: Tracked, restored: bool
    ) -> tuple[Tracked, Keyframe | None, str]:
        """The frame as a keyframe, and why; None if it does not become one.

        It does not if observations were restored after it was tracked, since the decision compares
        the tracked landmarks with those of the map.
        """
        reason = "" if restored else self.keyframes.decide(tracked)
        if not reason:
            return tracked, None, ""
        begin_early(self.semantics.segmenter, frame.rgb, frame.name)
        if self.markers is not None and len((seen := self.markers.detect(frame, self.camera)).rows):
            self.map.add_measurements(seen)
        return *self.insert(frame, tracked, self.camera_tracker.local_ids), reason

    @stage("graph")
    def _optimise(self, keyframe: Keyframe) -> None:
        self.moving_objects.remove_moving()
        self.map.optimise(keyframe)

    @stage("loops")
    def _close_loops(self, keyframe: Keyframe) -> None:
        self.map.close_loops(keyframe)
        self.keyframes.made()
        self.camera_tracker.refer_to(keyframe)

    @stage("semantics")
    def _label(
        self, frame: Frame, tracked: Tracked, keyframe: Keyframe | None, static: StaticFeatures
    ) -> None:
        if keyframe is None:
            self.semantics.observe_frame(frame, tracked, self.camera_tracker.reference)
            return
        self.moving_objects.store_keyframe(keyframe, static)
        urgent = self.map.world.is_alone(keyframe) or self.moving_objects.is_crowded(static)
        self.semantics.observe(frame, keyframe, urgent)

    def _join_segments(self, tracked: Tracked) -> Tracked:
        """Search the frame in other map segments; if it is recognised, they are joined."""
        world, tracker = self.map.world, self.camera_tracker
        others = [k for k in world.keyframes.values() if k.segment != tracker.segment]
        if not others or not world.in_segment(tracker.segment):
            return tracked
        rules, found = self.config.relocalisation, tracker.recognise(tracked.features, others)
        if found is not None and can_join(self.map, tracker.segment, tracked, found, rules):
            joined = self.mapper.join(tracker.segment, tracked, found)
        elif (T := join_by_markers(self.mapper, tracker.segment)) is not None:
            joined = replace(tracked, T_world_camera=T @ tracked.T_world_camera)
        else:
            return tracked
        tracker.segment = world.segment_of(joined.landmark_ids)
        tracker.restart(joined.T_world_camera)
        return joined

    def _record_pose(
        self, frame: Frame, tracked: Tracked, keyframe: Keyframe | None
    ) -> Array | None:
        """Keep the frame's pose relative to its reference keyframe; None where it has none."""
        reference = self.camera_tracker.reference
        if tracked.status is TrackingStatus.LOST or reference is None:
            return None
        T_world_camera, ids = tracked.T_world_camera, tracked.landmark_ids
        landmark_of = tracked.landmark_of
        if keyframe:
            T_world_camera, landmark_of = keyframe.T_world_camera, keyframe.landmark_ids
            _, ids = self.map.world.observed(keyframe)
        if keyframe or tracked.status.by_image:
            self.camera_tracker.remember(tracked.features, landmark_of, T_world_camera)
            self.camera_tracker.update_motion(tracked.T_world_camera, T_world_camera, ids)
        if not keyframe and tracked.status.by_image:
            self.frame_observations.append(
                frame.timestamp_s, tracked.features, tracked.keypoints, tracked.landmark_ids
            )
        self.map.history.append(
            frame.timestamp_s,
            reference.id,
            reference.T_world_camera,
            T_world_camera,
            tracked.information,
        )
        return T_world_camera
