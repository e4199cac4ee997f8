"""Moving things, by depth and by masks: kept out of tracking, taken out of map and graph."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bmask_slam.features.brisk import FeatureConfig, Features, select
from bmask_slam.graph.arrays import Array, Arrays, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.geometry import inverse
from bmask_slam.moving.config import MovingObjectConfig
from bmask_slam.moving.depth_view_buffer import DepthViewBuffer, PosedView
from bmask_slam.moving.feature_motion import FeatureMotion, FeatureMotions
from bmask_slam.moving.free_space_check import DepthView, FreeSpaceCheck, PointMotion, depth_view
from bmask_slam.moving.instance_motion import InstanceMotion
from bmask_slam.moving.keyframe_masks import KeyframeMasks, surfaces
from bmask_slam.moving.landmark_motion import LandmarkMotion
from bmask_slam.moving.static_features import FeatureReplenishment, StaticFeatures
from bmask_slam.moving.static_verification import StaticVerification
from bmask_slam.semantics.beliefs.movability import log_odds, read_priors
from bmask_slam.semantics.tracks.instance_track import Sighting, Track
from bmask_slam.semantics.tracks.instance_tracks import InstanceTracks
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.camera_tracker import CameraTracker
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_editor import MapEditor

logger = logging.getLogger(__name__)


class MovingObjectFilter:
    """Finds features, landmarks and instances that move, and keeps them out of tracking and map.

    Attributes:
        landmarks: which of them move.
        tracks: instances that may move, over time.
        keyframe_views: depth that the last keyframes saw; recent_views: that of the last frames.
        static_verification: instances excluded by class only, until verified as static.
    """

    def __init__(
        self,
        camera: Camera,
        config: MovingObjectConfig,
        features: FeatureConfig,
        map_editor: MapEditor,
        camera_tracker: CameraTracker,
    ) -> None:
        self.camera = camera
        self.config = config
        self.priors = read_priors(config.priors)
        self.tracks = InstanceTracks(config.tracks)
        verification = config.static_verification
        self.keyframe_views = DepthViewBuffer(config.check.views, config.check.interval_s)
        self.recent_views = DepthViewBuffer(verification.recent, verification.interval_s)
        self._map = map_editor
        self._camera_tracker = camera_tracker
        self._check = FreeSpaceCheck(
            camera, camera.noise_of_depth(features.disparity_sigma_px), config.check
        )
        self.landmarks = LandmarkMotion(self._check, self.priors, config.movability, map_editor)
        self.static_verification = StaticVerification(
            self._check, verification, config.min_judged, config.mask_border_px
        )
        self._feature_motion = FeatureMotion(camera, self._check, config.regions)
        self._replenishment = FeatureReplenishment(camera, features)
        self._instance_motion = InstanceMotion(
            camera, self._check, self.priors, config.movability.step, config.min_judged
        )

    def leave_out(self, camera: Camera) -> None:
        """Find no other features in what this camera says is covered."""
        self._replenishment.extractor.leave_out(camera)

    def filter(self, frame: Frame, features: Features) -> StaticFeatures:
        """A frame's features (N,) without those on moving things, and others in their place.

        Features are judged at the predicted pose, if there is one. If most seem to move, the pose
        is found by tracking all of them; if that fails too, all are used.
        """
        self.tracks.expire(frame.timestamp_s)
        views = self.keyframe_views.posed(self._camera_tracker.segment, self._map)
        predicted = self._camera_tracker.prediction()
        static = self.static_features_at(frame, features, predicted, views)
        doubted = self.is_crowded(static)
        settled = max(self.config.min_static, self.config.settled_share * len(features))
        if predicted is not None and doubted and static.static_count < settled:
            found = self._camera_tracker.preview(features)
            if found is None:
                return replace(static, features=features, mostly_moving=True)
            static = self.static_features_at(frame, features, found, views)
        return self._replenished(frame, features, static, views)

    def is_crowded(self, static: StaticFeatures) -> bool:
        """Whether most features of a frame seem to move."""
        return bool(static.moving.sum() > self.config.doubt_share * len(static.moving))

    def static_features_at(
        self, frame: Frame, features: Features, T_world_camera: Array | None, views: list[PosedView]
    ) -> StaticFeatures:
        """A frame's static features at a pose (4, 4); all features without a pose."""
        geometry = self.config.geometry
        view = depth_view(frame.depth_m, self.config.check.window_px) if geometry else None
        if T_world_camera is None:
            return StaticFeatures(features, np.zeros(len(features), bool), False, view)
        motions, space = self._judge(frame, features, T_world_camera, views)
        moving = motions == PointMotion.MOVING
        if not moving.any():
            return StaticFeatures(features, moving, False, view, space=space)
        if np.count_nonzero(~moving) < self.config.min_static:
            logger.info("frame %d: nearly all features move; all are used", frame.index)
            return StaticFeatures(features, moving, True, view)
        static_count = int(np.count_nonzero(motions == PointMotion.STATIC))
        left = select(features, np.flatnonzero(~moving))
        return StaticFeatures(left, moving, False, view, static_count, T_world_camera, space)

    def learn(self, timestamp_s: float, tracked: Tracked, static: StaticFeatures) -> bool:
        """Update landmarks and pending instances by the depth of a tracked frame.

        Landmarks that move are not tracked against from now on. Returns whether observations were
        restored, of something that proved static: the frame was tracked without them, so that its
        number of tracked landmarks is no measure of how much of the map it shows.
        """
        if not tracked.status.by_image:
            return False
        moving = self.landmarks.observe_frame(tracked, static.view)
        self._camera_tracker.exclude_landmarks(moving)
        reference, view = self._camera_tracker.reference, static.view
        if reference is None or view is None:
            return False
        restored = self._reinstate(timestamp_s, tracked.T_world_camera, view, reference)
        if restored:
            self._camera_tracker.refer_to(reference)
        return restored

    def remove_moving(self) -> None:
        """Take the landmarks that move out of the map, before the graph gets a new keyframe."""
        self.landmarks.follow_map()
        self.landmarks.remove_moving(self.landmarks.movability.known_moving())

    def store_keyframe(self, keyframe: Keyframe, static: StaticFeatures) -> None:
        """A keyframe was made: keep its depth.

        Depth on moving things is not kept: the same thing would be judged by it later.
        """
        self.landmarks.follow_map()
        if static.view is not None:
            self.keyframe_views.add(keyframe.id, keyframe.timestamp_s, static.view, static.space)

    def observe_masks(self, masks: KeyframeMasks) -> None:
        """Use a keyframe's masks, now or late: observations on moving things are removed."""
        if not self.config.labels:
            return
        anchor = self._map.world.keyframes.get(masks.anchor_id)
        views: list[PosedView] = []
        recent: list[PosedView] = []
        if anchor is not None and self.config.geometry:
            views = self.keyframe_views.posed(anchor.segment, self._map)
            recent = self.recent_views.posed(anchor.segment, self._map)
        now_s = np.nan if anchor is None else masks.timestamp_s
        visible_surfaces = surfaces(
            self.camera, masks, self.config.check.window_px, self.config.min_judged
        )
        stood_before = self.static_verification.stood(masks, visible_surfaces, recent, now_s)
        sightings = self._instance_motion.sightings(
            masks, visible_surfaces, stood_before, views, now_s
        )
        moving, tracks = self._tracked_instances(masks, sightings, now_s)
        class_is_no_evidence = [
            s is not None and (s.still or (track is not None and track.stood))
            for s, track in zip(sightings, tracks, strict=True)
        ]
        self.landmarks.observe_masks(masks, sightings, class_is_no_evidence)
        static_pixels = np.isin(masks.assignment.owner, np.flatnonzero(class_is_no_evidence))
        self.keyframe_views.restore_depth(masks.keyframe_id, static_pixels)
        if not moving.any():
            return
        moves = np.isin(masks.assignment.owner, np.flatnonzero(moving))
        self.keyframe_views.clear_depth(masks.keyframe_id, moves)
        if anchor is not None and self.config.geometry:
            by_class = [t if _by_class(t) else None for t in tracks]
            self.static_verification.add(masks, visible_surfaces, by_class, self._map.world)
        if masks.of_keyframe:
            self._map.prune_mask(masks.keyframe_id, moves, self.config.mask_border_px)
        self.landmarks.remove_moving(masks.landmark_ids)

    def begin_session(self) -> None:
        """Forget what moved in an earlier recording; landmarks stay what they are."""
        self.static_verification.clear()
        self.keyframe_views.clear()
        self.recent_views.clear()
        self.tracks.clear()

    def state(self) -> Arrays:
        """All that was learned, as named arrays."""
        return nested(
            movability=self.landmarks.state(),
            tracks=self.tracks.state(),
            memory=self.keyframe_views.state(),
            recent=self.recent_views.state(),
            suspects=self.static_verification.state(),
        )

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self.landmarks.restore(part(state, "movability"))
        self.tracks.restore(part(state, "tracks"))
        self.keyframe_views.restore(part(state, "memory"))
        self.recent_views.restore(part(state, "recent"))
        self.static_verification.restore(part(state, "suspects"))

    def _replenished(
        self, frame: Frame, features: Features, static: StaticFeatures, views: list[PosedView]
    ) -> StaticFeatures:
        """With further keypoints of the frame in place of its features that were left out."""
        pose = static.T_world_camera
        if pose is None or static.mostly_moving:
            return static

        def moving(others: Features) -> Mask:
            return self._judge(frame, others, pose, views).point_motions == PointMotion.MOVING

        found = self._replenishment.replenished(frame, features, static.moving, moving)
        return replace(static, features=found)

    def _reinstate(
        self, time_s: float, T_world_camera: Array, view: DepthView, near: Keyframe
    ) -> bool:
        """Restore what was left out for its class alone and proved static; whether anything was.

        The frame's view is kept with its pose relative to a near keyframe.
        """
        T_keyframe_camera = inverse(near.T_world_camera) @ T_world_camera
        self.recent_views.add(near.id, time_s, view, T_keyframe_camera=T_keyframe_camera)
        world = self._map.world
        standing = self.static_verification.verify(time_s, view, T_world_camera, world)
        for pending in standing:
            logger.info(
                "track %d is static: its class is not counted as evidence", pending.track_id
            )
            self.tracks.reinstate(pending.track_id, float(log_odds(self.priors.unknown)))
            for removed in pending.removed:
                self.keyframe_views.restore_depth(removed.keyframe_id, removed.mask.unpacked())
                free = self.static_verification.not_pending(removed)
                self._map.restore_observations(
                    removed.keyframe_id, removed.keypoints[free], removed.patches[free]
                )
        return bool(standing)

    def _judge(
        self, frame: Frame, features: Features, T_world_camera: Array, views: list[PosedView]
    ) -> FeatureMotions:
        """What views and the tracks' boxes say about features (N,)."""
        boxes_world = self.tracks.moving_boxes(frame.timestamp_s)
        views = views if self.config.geometry else []
        return self._feature_motion.judge(frame, features, T_world_camera, views, boxes_world)

    def _tracked_instances(
        self, masks: KeyframeMasks, sightings: Sequence[Sighting | None], now_s: float
    ) -> tuple[Mask, list[Track | None]]:
        """Which of a keyframe's sightings (K,) move, by their tracks, if they have one; these.

        Masks whose time ``now_s`` is not known add nothing to the tracks, nor do those that come
        after newer ones: their process may have been started again.
        """
        moving = np.array([s is not None and s.log_odds > 0 for s in sightings], bool)
        tracks: list[Track | None] = [None] * len(sightings)
        if np.isnan(now_s):
            return moving, tracks
        least = log_odds(self.config.tracks.min_prior)
        movable = {k: s for k, s in enumerate(sightings) if s is not None and s.log_odds > least}
        ids = self.tracks.update(now_s, list(movable.values()), masks.T_world_camera[:3, :3])
        if len(ids) < len(movable):
            return moving, tracks
        ahead = [self.tracks.predicted(track, now_s) for track in self.tracks.tracks]
        by_id = {track.id: track for track in ahead}
        for k, track_id in zip(movable, ids, strict=True):
            tracks[k] = by_id[track_id]
            moving[k] = by_id[track_id].moving
        self.tracks.miss(
            now_s, [track for track in ahead if self._instance_motion.shows(masks, track)]
        )
        return moving, tracks


def _by_class(track: Track | None) -> bool:
    """Whether a track moves by its class alone, without evidence from geometry."""
    return track is not None and track.moving and track.evidence <= 0
