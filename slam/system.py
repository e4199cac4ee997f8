"""The system: one step a frame."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from bmask_slam.back_end.mapper import Mapper
from bmask_slam.features.brisk import BriskExtractor, Features
from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.array_file import check_like, nested, part
from bmask_slam.labelling.semantic_mapper import SemanticMapper
from bmask_slam.moving.moving_object_filter import MovingObjectFilter, StaticFeatures
from bmask_slam.runtime.stage_clock import StageClock
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.system_results import SystemResults, largest
from bmask_slam.tracking.camera_tracker import CameraTracker
from bmask_slam.tracking.keyframe_decision import KeyframeEvidence, keyframe_reason
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.tracking.tracker import Tracked, Tracker, lost, untracked
from bmask_slam.world.world_map import Keyframe

logger = logging.getLogger(__name__)


class SlamSystem(SystemResults):
    """RGB-D frames in, poses out; the map and the graph grow on the way."""

    def __init__(
        self,
        camera: Camera,
        config: SystemConfig | None = None,
        segmenter: Segmenter | None = None,
    ):
        self.camera = camera
        self.config = config = config or SystemConfig()
        self.extractor = BriskExtractor(camera, config.features)
        tracker = Tracker(camera, config.tracking)
        self.mapper = self._make_mapper(tracker)
        rules = (config.relocalisation, config.mapping)
        self.camera_tracker = CameraTracker(tracker, self.mapper.places, rules)
        self.moving_objects = MovingObjectFilter(camera, config.moving_objects, config.features)
        self.semantics = SemanticMapper(camera, config.semantics, segmenter, self.moving_objects)
        self._segment = 0
        self._reference: Keyframe | None = None
        self._frames_since_keyframe = 0
        self._first_keyframe = 0  # of this session

    def _make_mapper(self, tracker: Tracker) -> Mapper:
        c = self.config
        return Mapper(self.camera, tracker, (c.mapping, c.factor_selection, c.graph, c.loops))

    def state(self) -> Arrays:
        """All that the past has left behind, as named arrays."""
        return {
            "segment": np.array(self._segment),
            "reference": np.array(-1 if self._reference is None else self._reference.id),
            "frames_since_keyframe": np.array(self._frames_since_keyframe),
            "first_keyframe": np.array(self._first_keyframe),
            **nested(
                mapper=self.mapper.state(),
                localiser=self.camera_tracker.state(),
                semantics=self.semantics.state(),
                dynamics=self.moving_objects.state(),
            ),
        }

    def restore(self, state: Arrays, path: Path) -> None:
        """Become the system of a state that was read from a file. Raises InputError."""
        check_like(state, self.state(), path)
        self.mapper.restore(part(state, "mapper"), path)
        self.camera_tracker.restore(part(state, "localiser"))
        self.semantics.restore(part(state, "semantics"), path)
        self.moving_objects.restore(part(state, "dynamics"))
        self._segment = int(state["segment"])
        self._reference = self.mapper.world.keyframes.get(int(state["reference"]))
        self._frames_since_keyframe = int(state["frames_since_keyframe"])
        self._first_keyframe = int(state["first_keyframe"])

    def restart(self) -> None:
        """From here on, go on exactly like a system restored from the present state."""
        self.mapper.restart()

    def begin_session(self) -> None:
        """Forget where the camera was and what was tracked; the map stays.

        The first frame is looked for in the map's largest segment. What is not recognised there
        begins a segment of its own, which is joined once it is.
        """
        world = self.mapper.world
        self._segment = world.largest_segment()
        self._reference = world.in_segment(self._segment)[-1]
        self._frames_since_keyframe = 0
        self._first_keyframe = world.next_keyframe_id
        self.mapper.begin_session()
        self.semantics.begin_session()
        self.moving_objects.begin_session()
        self.camera_tracker.forget(self.config.relocalisation.patience_frames)

    def prepare(self, frame: Frame) -> Features:
        """The frame's features; pure, so that it may run ahead in another thread."""
        return self.extractor.extract(frame)

    def process(self, frame: Frame, features: Features | None = None) -> FrameResult:
        """Track a frame and, if it becomes a keyframe, extend and optimise the map."""
        clock, keyframe = StageClock(), None
        self.camera_tracker.expect(frame.timestamp_s)
        with clock.stage("features"):
            features = features if features is not None else self.prepare(frame)
        with clock.stage("moving"):
            static = self._static_features(frame, features)
        with clock.stage("features"):
            static = self._replenish(frame, features, static)
        with clock.stage("tracking"):
            tracked = self._track(static.features)
        with clock.stage("moving"):
            came_back = self._watch(frame.timestamp_s, tracked, static)
        with clock.stage("keyframe"):
            reason = self._keyframe_reason(tracked) if not came_back else ""
            if reason:
                tracked, keyframe = self.insert(frame, tracked, self.camera_tracker.local_ids)
        with clock.stage("graph"):
            if keyframe:
                self.mapper.optimise(keyframe)
        with clock.stage("loops"):
            if keyframe:
                self.mapper.close_loops(keyframe)
                self._refer_to(keyframe)
        with clock.stage("semantics"):
            if keyframe:
                self.moving_objects.remember(keyframe, static, self.mapper)
                self.semantics.observe(frame, keyframe, self.mapper)
        return FrameResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=tracked.status,
            T_world_camera=self._remember(frame, tracked, keyframe),
            segment=self._segment,
            matches=tracked.matches,
            inliers=len(tracked.landmark_ids),
            ignored=static.ignored,
            mostly_moving=static.mostly_moving,
            information=tracked.information if tracked.information.any() else None,
            keyframe_id=keyframe.id if keyframe else None,
            keyframe_reason=reason,
            stage_ms=clock.stage_ms,
        )

    def continue_segment(self, segment: int) -> None:
        """The next keyframe belongs to this map segment."""
        self._segment = segment

    def insert(self, frame: Frame, tracked: Tracked, local_ids: Ints) -> tuple[Tracked, Keyframe]:
        """Make a frame a keyframe; its segment is joined to another that shows it too.

        ``local_ids`` are the landmarks that it was tracked against. Returns the frame as it is
        tracked in the joined map, and the keyframe.
        """
        tracked = self._join_segments(tracked)
        return tracked, self.mapper.insert(frame, tracked, self._segment, local_ids)

    def finish(self) -> None:
        """The last optimisation; the map is then final."""
        if self.config.final_adjustment:
            self.mapper.finish()
        known = self.mapper.world.in_segment(largest(self.segments()))
        if self._first_keyframe and known and known[0].id >= self._first_keyframe:
            logger.warning("never recognised in the map: the trajectory has a frame of its own")

    def _track(self, features: Features) -> Tracked:
        """Against the map; where there is none, or it is long lost, the frame begins a new one."""
        rules = self.config.relocalisation
        can_begin = np.isfinite(features.depth_m).sum() >= rules.min_new_points
        if self._reference is None:
            return untracked(np.eye(4), features) if can_begin else lost(np.eye(4), features)
        tracked = self.camera_tracker.track(features, self.mapper.world, self._reference)
        if self.camera_tracker.lost_frames <= rules.patience_frames or not can_begin:
            return tracked
        self._segment = 1 + max(k.segment for k in self.mapper.world.keyframes.values())
        self._reference = None
        self.camera_tracker.restart(np.eye(4))
        return untracked(np.eye(4), features)

    def _static_features(self, frame: Frame, features: Features) -> StaticFeatures:
        """The frame's features without those on moving things."""
        camera_tracker = self.camera_tracker if self._reference is not None else None
        return self.moving_objects.leave_out(
            frame, features, camera_tracker, self._segment, self.mapper
        )

    def _replenish(
        self, frame: Frame, features: Features, static: StaticFeatures
    ) -> StaticFeatures:
        """With other keypoints in place of those on moving things."""
        return self.moving_objects.replenish(frame, features, static, self._segment, self.mapper)

    def _watch(self, time_s: float, tracked: Tracked, static: StaticFeatures) -> bool:
        """Landmarks that are believed to move are not tracked against from now on.

        Returns whether some came back that stand: this frame was tracked without them, so that it
        cannot say how much of the map it shows.
        """
        if tracked.status is TrackingStatus.LOST:
            return False
        moving = self.moving_objects.watch(tracked, static.view, self.mapper.world)
        self.camera_tracker.leave_out(moving)
        near, view = self._reference, static.view
        if near is None or view is None:
            return False
        pose = tracked.T_world_camera
        came_back = self.moving_objects.reinstate(time_s, pose, view, near, self.mapper)
        if came_back:
            self.camera_tracker.new_local_map(self.mapper.world, near)
        return came_back

    def _keyframe_reason(self, tracked: Tracked) -> str:
        if tracked.status is TrackingStatus.LOST:
            return ""
        if self._reference is None:
            return "first frame" if self._segment == 0 else "new segment"
        self._frames_since_keyframe += 1
        _, points = self.mapper.world.observed(self._reference)
        close = tracked.features.depth_m < 40 * self.camera.baseline_m
        close_tracked = int(close[tracked.keypoints].sum())
        evidence = KeyframeEvidence(
            frames_since=self._frames_since_keyframe,
            mapping_idle=self.mapper.idle,
            tracked=len(tracked.landmark_ids),
            shared=len(tracked.landmark_ids) / max(len(points), 1),
            close_tracked=close_tracked,
            close_new=int(close.sum()) - close_tracked,
        )
        reason = keyframe_reason(evidence, self.config.keyframes)
        return "" if reason and self._changed_reference(tracked.landmark_ids) else reason

    def _changed_reference(self, landmark_ids: Ints) -> bool:
        """Whether another keyframe shows most of these landmarks; it is the reference then."""
        world = self.mapper.world
        if self.config.keyframes.max_shared >= 1:
            return False
        strong = world.covisible(landmark_ids, 1)
        if not strong or strong[0][1] is self._reference:
            return False
        self._reference = strong[0][1]
        self.camera_tracker.new_local_map(world, self._reference)
        return True

    def _join_segments(self, tracked: Tracked) -> Tracked:
        """Where other segments exist, look for this frame in them; found, they become one map."""
        world = self.mapper.world
        others = [k for k in world.keyframes.values() if k.segment != self._segment]
        recognised = self.camera_tracker.find(tracked.features, others, world) if others else None
        if recognised is None or not world.in_segment(self._segment):
            return tracked
        joined = self.mapper.join(self._segment, tracked, recognised)
        self._segment = world.segment_of(recognised.landmark_ids)
        self.camera_tracker.restart(joined.T_world_camera)
        return joined

    def _refer_to(self, keyframe: Keyframe) -> None:
        self._reference = keyframe
        self._frames_since_keyframe = 0
        self.camera_tracker.new_local_map(self.mapper.world, keyframe)

    def _remember(self, frame: Frame, tracked: Tracked, keyframe: Keyframe | None) -> Array | None:
        reference = self._reference
        if tracked.status is TrackingStatus.LOST or reference is None:
            return None
        T_world_camera, seen_ids = tracked.T_world_camera, tracked.landmark_ids
        if keyframe:
            T_world_camera = keyframe.T_world_camera
            _, seen_ids = self.mapper.world.observed(keyframe)
        self.camera_tracker.moved_on(tracked.T_world_camera, T_world_camera, seen_ids)
        T_world_reference = reference.T_world_camera
        self.mapper.history.append(
            frame.timestamp_s, reference.id, T_world_reference, T_world_camera
        )
        return T_world_camera
