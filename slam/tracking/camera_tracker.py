"""The camera's pose, frame by frame: motion model, tracking, relocalisation, new map segments."""

from __future__ import annotations

import numpy as np

from bmask_slam.features.brisk import BriskExtractor, Features
from bmask_slam.graph.arrays import Array, Arrays, Ints, no_ids
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.geometry import inverse, orthonormalised
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.guided_landmarks import GuidedLandmarks
from bmask_slam.tracking.motion_model import MotionModel
from bmask_slam.tracking.relocalisation import RelocalisationConfig, is_within_reach, relocalise
from bmask_slam.tracking.results import Tracked, TrackingStatus, best, lost, reckoned, starting
from bmask_slam.tracking.tracker import Tracker
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.local_map import LocalMapConfig, local_landmarks
from bmask_slam.world.map_editor import MapReader


class CameraTracker:
    """Tracks frames against a map that the back end owns, and keeps the motion between frames.

    Attributes:
        lost_frames: frames since the last pose; 0 while tracking.
        reference: the keyframe that poses are stored relative to; None where no map has been begun.
        segment: the map segment that is tracked in.
        motion: the last pose, and how the camera moved.
        local_ids: (N,) landmarks of the local map that the next frame will be tracked against.
    """

    def __init__(
        self,
        tracker: Tracker,
        map_reader: MapReader,
        relocalisation: RelocalisationConfig,
        local_map: LocalMapConfig,
        extractor: BriskExtractor,
    ):
        self.tracker = tracker
        self.lost_frames = 0
        self.reference: Keyframe | None = None
        self.segment = 0
        self._map = map_reader
        self._relocalisation, self._local_map = relocalisation, local_map
        self.motion = MotionModel()
        self._recent_ids, self.local_ids = no_ids(), no_ids()
        self._images = GuidedLandmarks(extractor, tracker.config.image_motion)

    def state(self) -> Arrays:
        """The motion, and the landmarks that the next frame will be tracked against."""
        return {
            "lost_frames": np.array(self.lost_frames),
            **self.motion.state(),
            "recent_ids": self._recent_ids,
            "local_ids": self.local_ids,
            **nested(images=self._images.state()),
        }

    def restore(self, state: Arrays) -> None:
        """Become the tracker of a state; its reference and segment are restored by the system."""
        self.lost_frames = int(state["lost_frames"])
        self.motion.restore(state)
        self._recent_ids, self.local_ids = state["recent_ids"], state["local_ids"]
        self._images.restore(part(state, "images"))

    def use_camera(self, camera: Camera) -> None:
        """Go on with another camera."""
        self.tracker.camera = camera
        self._images.use_camera(camera)

    @property
    def timestamp_s(self) -> float:
        """Time of the last frame that was begun; NaN before the first."""
        return self.motion.now_s

    def begin_session(self) -> None:
        """A new recording in a known map: the first frame is searched in the largest segment.

        Frames that are not recognised begin a segment of their own, which is joined once one is.
        """
        world = self._map.world
        self.segment = world.largest_segment()
        self.reference = world.in_segment(self.segment)[-1]
        self.motion.last_s = self.motion.now_s = np.nan
        self.reset(self._relocalisation.patience_frames)

    def reset(self, lost_frames: int) -> None:
        """Lost for so many frames, with no knowledge of where the camera is."""
        self.lost_frames = lost_frames
        self._recent_ids, self.local_ids = no_ids(), no_ids()
        self._images.forget()
        self.restart(np.eye(4))

    def restart(self, T_world_camera: Array) -> None:
        """Begin at a pose, without speed: a new segment, or a map that was moved."""
        self.motion.restart(T_world_camera)

    def begin_frame(self, timestamp_s: float) -> None:
        """Set the time of the frame that is tracked next; else the last interval is repeated."""
        self.motion.now_s = timestamp_s
        self._images.end_frame()

    def look(self, frame: Frame, features: Features) -> None:
        """Predict the frame's pose by its image, if the last one was surprising or found weakly.

        Without it the pose is predicted by constant velocity alone.
        """
        if self.reference is None:
            return
        self._images.frame = frame
        if self.lost_frames or self._images.needed:
            self._follow(features)

    def prediction(self) -> Array | None:
        """T_world_camera (4, 4) by optical flow, else by velocity; None while lost without flow."""
        unknown = self.lost_frames and self._images.followed is None
        return None if unknown or self.reference is None else self._predicted()

    def preview(self, features: Features) -> Array | None:
        """The frame's pose by the local map alone, None if not found; no state is changed."""
        tracked = self._tracked(features, self._map.world.landmarks.remaining(self.local_ids))
        return None if tracked.status is TrackingStatus.LOST else tracked.T_world_camera

    def can_begin(self, features: Features) -> bool:
        """Whether a frame has depth enough to begin a map, and will be worked on."""
        enough = np.isfinite(features.depth_m).sum() >= self._relocalisation.min_new_points
        return bool(enough) and self._map.accepts_keyframes

    def goes_on(self, tracked: Tracked) -> bool:
        """Whether a frame goes on with the map where odometry has led, after a long blackout."""
        waited = self.lost_frames > self._relocalisation.patience_frames
        by_odometry = tracked.status is TrackingStatus.DEAD_RECKONING
        return by_odometry and waited and self.can_begin(tracked.features)

    def exclude_landmarks(self, landmark_ids: Ints) -> None:
        """Do not track against these landmarks (N,)."""
        if len(landmark_ids):
            self.local_ids = np.setdiff1d(self.local_ids, landmark_ids)
            self._recent_ids = self._recent_ids[~np.isin(self._recent_ids, landmark_ids)]

    def track(self, features: Features) -> Tracked:
        """The frame's pose, also in another segment; one that is long lost begins a segment.

        A frame that begins a segment has the pose of its origin, and must become its first
        keyframe. Where odometry knows the way none begins.
        """
        can_begin = self.can_begin(features)
        if self.reference is None:
            return starting(np.eye(4), features) if can_begin else lost(np.eye(4), features)
        tracked = self.track_in_map(features, everywhere=True)
        waits = self.lost_frames <= self._relocalisation.patience_frames or not can_begin
        if waits or tracked.status is not TrackingStatus.LOST:
            return tracked
        self.begin_apart()
        return starting(np.eye(4), features)

    def begin_apart(self) -> None:
        """Let the next keyframe begin a segment of its own."""
        self.segment = 1 + max((k.segment for k in self._map.world.keyframes.values()), default=-1)
        self.reference = None
        self.restart(np.eye(4))

    def track_in_map(self, features: Features, everywhere: bool = False) -> Tracked:
        """The pose by constant velocity and the local map; when lost, by the segment's keyframes.

        ``everywhere``: by all keyframes, and tracking goes on in the segment that it is found in.

        Raises:
            ValueError: no map has been begun.
        """
        if self.reference is None:
            raise ValueError("no map has been begun")
        world = self._map.world
        self.local_ids = world.landmarks.remaining(self.local_ids)
        tracked = self._tracked_or_ahead(features)
        if tracked.status is TrackingStatus.LOST:
            tracked = self._found_again(features, everywhere) or tracked
        if tracked.status is TrackingStatus.LOST:
            self.lost_frames += 1
            self._images.end_frame()
            self.motion.stop()
            moved = self.motion.by_odometry(self._map.sensors)
            return tracked if moved is None else reckoned(tracked, *moved)
        world.landmarks.visible[tracked.visible_ids] += 1
        world.landmarks.found[tracked.landmark_ids] += 1
        return tracked

    def _found_again(self, features: Features, everywhere: bool) -> Tracked | None:
        """A frame's pose in a segment, which is tracked in from then on; None if not found."""
        world = self._map.world
        known = list(world.keyframes.values()) if everywhere else world.in_segment(self.segment)
        tracked = self.recognise(features, known)
        if tracked is None:
            return None
        _, nearest = world.covisible(tracked.landmark_ids, 1)[0]
        if nearest.segment != self.segment:
            self.refer_to(nearest)
            self.segment = nearest.segment
            return tracked
        way, rules = (nearest, self.reference), self._relocalisation
        near = is_within_reach(self.motion, tracked.T_world_camera, world, way, rules)
        return tracked if near else None

    def recognise(self, features: Features, keyframes: list[Keyframe]) -> Tracked | None:
        """The frame's pose against some keyframes, without a prior; None if it is not there."""
        rules = self._relocalisation, self._local_map
        return relocalise(features, keyframes, self._map, self.tracker, *rules)

    def update_motion(self, T_world_tracked: Array, T_world_camera: Array, ids: Ints) -> None:
        """Set the pose that the next frame is predicted from.

        T_world_tracked is the pose as tracked, T_world_camera as optimised; ``ids`` (N,) are the
        landmarks that the frame observes.
        """
        self.motion.advance(T_world_tracked, T_world_camera, steady=self.lost_frames == 0)
        self._recent_ids = ids
        self.lost_frames = 0

    def remember(self, features: Features, landmark_ids: Ints, T_world_camera: Array) -> None:
        """Keep what the frame saw from a pose (4, 4), to follow it into the next image.

        ``landmark_ids`` (N,) are those that its features observe, -1 for none. To be called before
        ``update_motion``.
        """
        poses = (self._without_image(), T_world_camera)
        self._images.remember(features, landmark_ids, poses, self._map.world.landmarks)

    def follow_map(self, T_old: Array, T_new: Array) -> None:
        """The map was moved by its owner, as a keyframe from T_old to T_new (4, 4).

        The last pose moves with it, and fused landmarks are replaced; a new owner may have fewer.
        """
        landmarks = self._map.world.landmarks
        self.motion.follow_map(T_old, T_new)
        known = self._recent_ids[self._recent_ids < len(landmarks)]
        self._recent_ids = landmarks.remaining(landmarks.current(known))
        self._images.follow_map(landmarks)

    def refer_to(self, keyframe: Keyframe) -> None:
        """Make a keyframe the reference, and track against its surroundings from now on."""
        world = self._map.world
        self.reference = keyframe
        _, observed = world.observed(keyframe)
        self.local_ids = local_landmarks(world, observed, self._local_map)

    def _tracked(self, features: Features, local_ids: Ints) -> Tracked:
        T, world, last = self._predicted(), self._map.world, self.motion.previous(self.lost_frames)
        return self.tracker.track(features, T, self._recent_ids, local_ids, world, last)

    def _follow(self, features: Features) -> None:
        """Follow the last frame's corners into this one."""
        T_last_next = inverse(self.motion.T_world_last) @ self._without_image()
        self._images.follow(features, T_last_next, self.motion.ago_s)

    def _tracked_or_ahead(self, features: Features) -> Tracked:
        """The pose by the local map; where that ends, by the landmarks ahead of it as well."""
        known, enough = self.local_ids, self.tracker.config.min_inliers
        tracked = self._by_landmarks(features, known)
        if tracked.by_appearance >= enough or not len(ahead := self._map.landmarks_ahead):
            return tracked
        seen, *_ = self.tracker.in_view(self._predicted(), known, self._map.world.landmarks)
        if len(seen) >= len(features):  # it does not end: something is before it, and may move
            return tracked
        return best(tracked, self._by_landmarks(features, np.concatenate([known, ahead])), enough)

    def _by_landmarks(self, features: Features, ids: Ints) -> Tracked:
        """The pose by landmarks (N,), with the help of the image's motion where there is need."""
        enough = self.tracker.config.min_inliers
        if self._images.followed is not None:
            guided = self._guided(features, ids)
            if guided.by_appearance >= enough:
                return guided
            return best(guided, self._tracked(features, ids), enough)
        tracked = self._tracked(features, ids)
        if tracked.by_appearance < self._images.config.few_inliers:
            self._follow(features)
        followed = self._images.followed is not None
        return best(tracked, self._guided(features, ids), enough) if followed else tracked

    def _guided(self, features: Features, ids: Ints) -> Tracked:
        """The pose by landmarks (N,), some of which were followed from the last image."""
        T, world, last = self._predicted(), self._map.world, self.motion.previous(self.lost_frames)
        guided = self._images.guided(features, ids, world.landmarks)
        return self.tracker.refine(features, T, ids, world, last, guided)

    def _predicted(self) -> Array:
        """T_world_camera (4, 4), by the image's motion if that is known, else by velocity."""
        followed = self._images.followed
        if followed is None:
            return self._without_image()
        return orthonormalised(self.motion.T_world_last @ followed.estimate.T_world_camera)

    def _without_image(self) -> Array:
        """T_world_camera (4, 4) by the last motion; in a blackout by odometry if that knows it."""
        moved = self.motion.by_odometry(self._map.sensors) if self.lost_frames else None
        return self.motion.by_velocity() if moved is None else moved[0]
