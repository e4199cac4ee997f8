"""Where the camera is, frame by frame: the motion model, tracking, and what to do when lost."""

from __future__ import annotations

import numpy as np

from bmask_slam.back_end.landmark_management import MappingConfig, local_landmarks
from bmask_slam.features.brisk import Features
from bmask_slam.features.descriptor_index import DescriptorIndex
from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.geometry import carried_along, inverse, orthonormalised, se3_exp, se3_log
from bmask_slam.tracking.relocalisation import RelocalisationConfig, relocalise, similar_keyframes
from bmask_slam.tracking.results import TrackingStatus
from bmask_slam.tracking.rolling_shutter import PreviousPose
from bmask_slam.tracking.tracker import Tracked, Tracker
from bmask_slam.world.world_map import Keyframe, WorldMap

UNEVEN = 0.25
"""Frames count as evenly spaced if their intervals differ by a smaller share."""
MAX_STEPS = 4.0
"""A motion is not believed to go on for longer than so many times its own length."""

MAX_AGO_S = 0.2
"""An older pose tells too little of the velocity."""


class CameraTracker:
    """Keeps what one frame hands to the next; the map belongs to the caller.

    ``lost_frames`` counts the frames since the last pose, 0 while tracking.
    """

    def __init__(
        self,
        tracker: Tracker,
        places: DescriptorIndex,
        config: tuple[RelocalisationConfig, MappingConfig],
    ):
        self.tracker = tracker
        self.lost_frames = 0
        self._places = places
        self._relocalisation, self._mapping = config
        self._T_world_last = np.eye(4)
        self._T_last_next = np.eye(4)
        self._last_s = self._now_s = np.nan
        self._interval_s = np.nan  # during which T_last_next happened
        self._recent_ids: Ints = np.zeros(0, np.int64)
        self._local_ids: Ints = np.zeros(0, np.int64)

    def state(self) -> Arrays:
        """The motion, and the landmarks that the next frame will be tracked against."""
        return {
            "lost_frames": np.array(self.lost_frames),
            "T_world_last": self._T_world_last,
            "T_last_next": self._T_last_next,
            "stamps_s": np.array([self._last_s, self._now_s, self._interval_s]),
            "recent_ids": self._recent_ids,
            "local_ids": self._local_ids,
        }

    def restore(self, state: Arrays) -> None:
        """Become the localiser of a state."""
        self.lost_frames = int(state["lost_frames"])
        self._T_world_last, self._T_last_next = state["T_world_last"], state["T_last_next"]
        self._last_s, self._now_s, self._interval_s = state["stamps_s"].tolist()
        self._recent_ids, self._local_ids = state["recent_ids"], state["local_ids"]

    def forget(self, lost_frames: int) -> None:
        """Lost for so many frames, knowing nothing about where the camera is."""
        self.lost_frames = lost_frames
        self._recent_ids = self._local_ids = np.zeros(0, np.int64)
        self.restart(np.eye(4))

    @property
    def local_ids(self) -> Ints:
        """Landmarks of the local map that the next frame will be tracked against."""
        return self._local_ids

    def expect(self, timestamp_s: float) -> None:
        """The next frame is of this time; without a word it comes as soon as the last one did."""
        self._now_s = timestamp_s

    def prediction(self) -> Array | None:
        """T_world_camera (4, 4) of the next frame by constant velocity; None when lost."""
        return None if self.lost_frames else self._predicted()

    def preview(self, features: Features, world: WorldMap) -> Array | None:
        """The pose that tracking would find, None if it would not; nothing is remembered of it."""
        recent_ids, local_ids = self._recent_ids, world.landmarks.living(self._local_ids)
        tracked = self.tracker.track(
            features, self._predicted(), recent_ids, local_ids, world, self._previous()
        )
        return None if tracked.status is TrackingStatus.LOST else tracked.T_world_camera

    def leave_out(self, landmark_ids: Ints) -> None:
        """Do not track against these landmarks (N,)."""
        if not len(landmark_ids):
            return
        self._local_ids = np.setdiff1d(self._local_ids, landmark_ids)
        self._recent_ids = self._recent_ids[~np.isin(self._recent_ids, landmark_ids)]

    def track(self, features: Features, world: WorldMap, reference: Keyframe) -> Tracked:
        """The frame's pose by constant velocity and the local map; when lost, by all keyframes."""
        T_predicted = self._predicted()
        self._local_ids = world.landmarks.living(self._local_ids)
        tracked = self.tracker.track(
            features, T_predicted, self._recent_ids, self._local_ids, world, self._previous()
        )
        if tracked.status is TrackingStatus.LOST:
            found = self.find(features, world.in_segment(reference.segment), world)
            tracked = found or tracked
        if tracked.status is TrackingStatus.LOST:
            self.lost_frames += 1
            self._T_last_next = np.eye(4)
            return tracked
        world.landmarks.visible[tracked.visible_ids] += 1
        world.landmarks.found[tracked.landmark_ids] += 1
        return tracked

    def find(
        self, features: Features, keyframes: list[Keyframe], world: WorldMap
    ) -> Tracked | None:
        """The frame's pose against some keyframes, without a prior; None if it is not there."""
        rules = (self._relocalisation, self._mapping)
        min_votes = self._relocalisation.min_votes
        candidates = similar_keyframes(features, keyframes, self._places, min_votes)
        return relocalise(features, candidates, world, self.tracker, rules)

    def moved_on(self, T_world_tracked: Array, T_world_camera: Array, seen_ids: Ints) -> None:
        """A frame is done: T_world_tracked is its pose as tracked, T_world_camera as optimised."""
        steady = self.lost_frames == 0
        self._T_last_next = inverse(self._T_world_last) @ T_world_tracked if steady else np.eye(4)
        self._T_world_last = T_world_camera
        self._interval_s, self._last_s = self._now_s - self._last_s, self._now_s
        self._recent_ids = seen_ids
        self.lost_frames = 0

    def moved(self, T_old: Array, T_new: Array, world: WorldMap) -> None:
        """The map was moved by its owner, as a keyframe from T_old to T_new (4, 4).

        What was tracked in it goes along, fused landmarks too.

        The owner may have begun anew with fewer landmarks.
        """
        self._T_world_last = carried_along(self._T_world_last, T_old, T_new)
        known = self._recent_ids[self._recent_ids < len(world.landmarks)]
        self._recent_ids = world.landmarks.living(world.landmarks.current(known))

    def new_local_map(self, world: WorldMap, keyframe: Keyframe) -> None:
        """Track against the surroundings of this keyframe from now on."""
        _, seen = world.observed(keyframe)
        self._local_ids = local_landmarks(world, seen, self._mapping)

    def _predicted(self) -> Array:
        """The motion goes on, for as long as the frames are apart."""
        known = self._interval_s > 0  # False for NaN
        steps = (self._now_s - self._last_s) / self._interval_s if known else 1.0
        if not abs(steps - 1) >= UNEVEN:
            return orthonormalised(self._T_world_last @ self._T_last_next)
        motion = min(steps, MAX_STEPS) * se3_log(self._T_last_next)
        return orthonormalised(self._T_world_last @ se3_exp(motion))

    def _previous(self) -> PreviousPose | None:
        """The last frame's pose, None where it is too old to tell a velocity."""
        ago_s = self._now_s - self._last_s
        recent = self.lost_frames == 0 and 0 < ago_s < MAX_AGO_S  # False for NaN
        return PreviousPose(self._T_world_last, ago_s) if recent else None

    def restart(self, T_world_camera: Array) -> None:
        """Begin anew at a pose, without speed: a new segment, or a map that was moved."""
        self._T_world_last, self._T_last_next = T_world_camera, np.eye(4)
