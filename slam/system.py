"""The system: one step a frame."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graph.camera import Camera
from graph.geometry import Array, inverse, orthonormalised
from graph.smoother import Smoother
from graph.smoother_config import SmootherConfig
from graph.trajectory import Trajectory
from graph.updates import GraphEstimate
from slam.features import BriskExtractor, FeatureConfig, Features
from slam.frame import Frame
from slam.graph_feed import GraphFeed, GraphFeedConfig, read_back
from slam.history import FrameHistory
from slam.keyframes import KeyframeConfig, KeyframeEvidence, keyframe_reason
from slam.landmarks import Ints
from slam.local_mapping import (
    MappingConfig,
    create_landmarks,
    cull_landmarks,
    fuse_into_neighbours,
    local_landmarks,
    redundant_keyframe,
)
from slam.results import FrameResult, TrackingStatus
from slam.tracker import Tracked, Tracker, TrackingConfig
from slam.world_map import Keyframe, WorldMap

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SystemConfig:
    """Everything that can be configured; YAML files hold only what differs from these defaults."""

    features: FeatureConfig = field(default_factory=FeatureConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    feed: GraphFeedConfig = field(default_factory=GraphFeedConfig)
    graph: SmootherConfig = field(default_factory=SmootherConfig)


@dataclass(frozen=True)
class LandmarkCloud:
    """The living landmarks: ids (N,), points_world (N, 3) m, colours (N, 3), observations (N,)."""

    ids: NDArray[np.int64]
    points_world: Array
    colours: NDArray[np.uint8]
    observations: NDArray[np.int64]


class SlamSystem:
    """RGB-D frames in, poses out; the map and the graph grow on the way."""

    def __init__(self, camera: Camera, config: SystemConfig | None = None):
        self.camera = camera
        self.config = config or SystemConfig()
        self.world = WorldMap()
        self.history = FrameHistory()
        self.extractor = BriskExtractor(camera, self.config.features)
        self.tracker = Tracker(camera, self.config.tracking)
        self.smoother = Smoother(camera, self.config.graph)
        self.feed = GraphFeed(self.config.feed)
        self.segment = 0
        self.update_ms: list[float] = []
        self._reference: Keyframe | None = None
        self._frames_since_keyframe = 0
        self._T_last = np.eye(4)
        self._velocity = np.eye(4)
        self._recent_ids: Ints = np.zeros(0, np.int64)
        self._local_ids: Ints = np.zeros(0, np.int64)

    def prepare(self, frame: Frame) -> Features:
        """The frame's features; pure, so that it may run ahead in another thread."""
        return self.extractor.extract(frame)

    def process(self, frame: Frame, features: Features | None = None) -> FrameResult:
        """Track a frame and, if it becomes a keyframe, extend and optimise the map."""
        clock = StageClock()
        with clock.stage("features"):
            features = features if features is not None else self.prepare(frame)
        with clock.stage("tracking"):
            tracked = self._track(features)
        with clock.stage("keyframe"):
            reason = self._keyframe_reason(tracked, features)
            keyframe = self._insert_keyframe(frame, tracked) if reason else None
        with clock.stage("graph"):
            if keyframe is not None:
                self._optimise(keyframe)
        T_world_camera = self._remember(frame, tracked, keyframe)
        return FrameResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=tracked.status,
            T_world_camera=T_world_camera,
            segment=self.segment,
            matches=tracked.matches,
            inliers=len(tracked.landmark_ids),
            keyframe_id=keyframe.id if keyframe else None,
            keyframe_reason=reason,
            stage_ms=clock.stage_ms,
        )

    def finish(self) -> None:
        """Flush what is pending; the map is then final."""

    def trajectory(self) -> Trajectory:
        """Every frame with a pose, composed from the keyframes as they are now."""
        return self.history.trajectory(self.world, self.segment)

    def keyframe_trajectory(self) -> Trajectory:
        """The keyframes of the map."""
        keyframes = [self.world.keyframes[i] for i in sorted(self.world.keyframes)]
        stamps = np.array([k.timestamp_s for k in keyframes])
        return Trajectory(stamps, np.array([k.T_world_camera for k in keyframes]).reshape(-1, 4, 4))

    def landmarks(self) -> LandmarkCloud:
        """The living landmarks with their colours."""
        table = self.world.landmarks
        ids = np.flatnonzero(table.alive)
        return LandmarkCloud(
            ids, table.points_world[ids], table.colours[ids], table.observations[ids]
        )

    def save_graph(self, folder: Path) -> None:
        """Write the graph and its values so that they load again."""
        self.smoother.save(folder)

    def statistics(self) -> dict[str, float | list[float]]:
        """Sizes of the map and the time of every graph update in milliseconds."""
        return {
            "keyframes": len(self.world.keyframes),
            "landmarks": int(self.world.landmarks.alive.sum()),
            "isam2_update_ms": list(self.update_ms),
        }

    def _track(self, features: Features) -> Tracked:
        if self._reference is None:
            none = np.zeros(0, np.int64)
            return Tracked(
                TrackingStatus.OK, np.eye(4), features, none, none, 0, none, np.zeros((6, 6))
            )
        T_predicted = orthonormalised(self._T_last @ self._velocity)
        landmarks = self.world.landmarks
        tracked = self.tracker.track(
            features, T_predicted, self._recent_ids, self._local_ids, self.world
        )
        if tracked.status is TrackingStatus.LOST:
            return tracked
        landmarks.visible[tracked.visible_ids] += 1
        landmarks.found[tracked.landmark_ids] += 1
        return tracked

    def _keyframe_reason(self, tracked: Tracked, features: Features) -> str:
        if self._reference is None:
            return "first frame"
        if tracked.status is TrackingStatus.LOST:
            return ""
        self._frames_since_keyframe += 1
        _, points = self.world.observed(self._reference)
        settled = points[self.world.landmarks.observations[points] >= 2]
        shared = np.isin(settled, tracked.landmark_ids).mean() if len(settled) else 0.0
        close = features.depth_m < 40 * self.camera.baseline_m
        evidence = KeyframeEvidence(
            frames_since=self._frames_since_keyframe,
            mapping_idle=True,
            tracked=len(tracked.landmark_ids),
            shared=float(shared),
            close_tracked=int(close[tracked.keypoints].sum()),
            close_new=int(close.sum() - close[tracked.keypoints].sum()),
        )
        return keyframe_reason(evidence, self.config.keyframes)

    def _insert_keyframe(self, frame: Frame, tracked: Tracked) -> Keyframe:
        world = self.world
        keyframe = Keyframe(
            id=world.next_keyframe_id,
            frame_index=frame.index,
            timestamp_s=frame.timestamp_s,
            segment=self.segment,
            T_world_camera=tracked.T_world_camera,
            features=tracked.features,
            landmark_ids=np.full(len(tracked.features), -1, np.int64),
        )
        world.next_keyframe_id += 1
        world.keyframes[keyframe.id] = keyframe
        world.attach(keyframe, tracked.keypoints, tracked.landmark_ids)
        new_ids = create_landmarks(world, keyframe, self.camera)
        fused = fuse_into_neighbours(world, keyframe, new_ids, self.tracker, self.config.mapping)
        world.renew_patches(keyframe, self.config.tracking.subpixel)
        self.feed.forget_landmarks(fused)
        self.feed.forget_landmarks(cull_landmarks(world, self._local_ids, self.config.mapping))
        return keyframe

    def _optimise(self, keyframe: Keyframe) -> None:
        estimate: GraphEstimate = self.smoother.update(
            self.feed.keyframe_update(self.world, keyframe)
        )
        self.update_ms.append(estimate.update_ms)
        if estimate.rebuilt:
            logger.warning("graph rebuilt after a failure at %s", estimate.failed_variable)
        read_back(self.world, estimate)
        self._cull_keyframe(keyframe)
        self._reference = keyframe
        self._frames_since_keyframe = 0
        _, seen = self.world.observed(keyframe)
        self._local_ids = local_landmarks(self.world, seen, self.config.mapping)

    def _cull_keyframe(self, newest: Keyframe) -> None:
        _, seen = self.world.observed(newest)
        recent = {newest.id, newest.id - 1, newest.id - 2, 0}
        candidates = [k for _, k in self.world.covisible(seen, 15) if k.id not in recent]
        redundant = redundant_keyframe(self.world, candidates, self.config.mapping)
        if redundant is None:
            return
        _, ids = self.world.observed(redundant)
        parent = next(k for _, k in self.world.covisible(ids, 0) if k is not redundant)
        T_parent_keyframe = inverse(parent.T_world_camera) @ redundant.T_world_camera
        self.history.hand_over(redundant.id, parent.id, T_parent_keyframe)
        self.world.remove_keyframe(redundant, parent)
        self.feed.forget_keyframe(redundant.id)

    def _remember(self, frame: Frame, tracked: Tracked, keyframe: Keyframe | None) -> Array | None:
        if tracked.status is TrackingStatus.LOST or self._reference is None:
            return None
        T = keyframe.T_world_camera if keyframe else tracked.T_world_camera
        self._velocity = inverse(self._T_last) @ tracked.T_world_camera
        self._T_last = T
        self._recent_ids = (
            self.world.observed(keyframe)[1] if keyframe else tracked.landmark_ids
        )
        reference = self._reference
        self.history.append(frame.timestamp_s, reference.id, reference.T_world_camera, T)
        return T


class StageClock:
    """Wall time of named stages in milliseconds."""

    def __init__(self) -> None:
        self.stage_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is done inside, under this name."""
        started_s = time.perf_counter()
        yield
        self.stage_ms[name] = 1e3 * (time.perf_counter() - started_s)
