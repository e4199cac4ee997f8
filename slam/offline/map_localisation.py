"""Localisation in a finished map, which is not changed: frames in, poses in its frame out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.runtime.stage_clock import stage
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.tracking.results import FrameResult, Tracked, TrackingStatus

REFRESH_FRAMES = 5  # a sixth of a second at 30 Hz


class MapLocalisation(SlamSystem):
    """A system, restored from a map, that only locates frames in the map's largest segment.

    It makes no keyframes and optimises nothing. Every few frames, and after every relocalisation,
    the local map is chosen anew around the landmarks that were observed.
    """

    def begin_session(self) -> None:
        """Start without a known camera pose in the map."""
        super().begin_session()
        self._frames_since_refresh = 0
        self._located: list[tuple[float, Array]] = []

    def process(self, frame: Frame, features: Features | None = None) -> FrameResult:
        """Locate a frame in the map."""
        frame = self._begin(frame)
        features = self._extract(frame, features)
        tracked = self._find(frame, features)
        T_world_camera = self._follow(frame, tracked)
        return FrameResult(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=tracked.status,
            T_world_camera=T_world_camera,
            segment=self.camera_tracker.segment,
            matches=tracked.matches,
            inliers=len(tracked.landmark_ids),
            stage_ms=self.stage_ms,
            events=self.events.take(),
        )

    def finish(self) -> None:
        """Do nothing: the map has not changed."""

    def segments(self) -> dict[int, Trajectory]:
        """The frames that were located, all in the map's largest segment."""
        stamps_s, poses = [stamp_s for stamp_s, _ in self._located], [T for _, T in self._located]
        segment = self.camera_tracker.segment
        return {segment: Trajectory(np.array(stamps_s), np.array(poses))} if poses else {}

    def files(self) -> dict[str, Callable[[Path], None]]:
        """No files: the map has not changed."""
        return {}

    @stage("tracking")
    def _find(self, frame: Frame, features: Features) -> Tracked:
        self.camera_tracker.look(frame, features)
        return self._reported(self.camera_tracker.track_in_map(features))

    @stage("tracking")
    def _follow(self, frame: Frame, tracked: Tracked) -> Array | None:
        if tracked.status is TrackingStatus.LOST:
            return None
        T, ids, world = tracked.T_world_camera, tracked.landmark_ids, self.map.world
        self._located.append((frame.timestamp_s, T))
        if not tracked.status.by_image:
            return T
        self.camera_tracker.remember(tracked.features, tracked.landmark_of, T)
        self.camera_tracker.update_motion(T, T, ids)
        self._frames_since_refresh += 1
        outside = not np.isin(ids, self.camera_tracker.local_ids).all()
        if outside or self._frames_since_refresh >= REFRESH_FRAMES:
            self._frames_since_refresh = 0
            self.camera_tracker.refer_to(world.covisible(ids, 1)[0][1])
        return T
