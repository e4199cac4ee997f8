"""What moves: kept out of tracking and of the map, taken out of the graph where it was put in."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.back_end.mapper import Mapper
from bmask_slam.features.brisk import FeatureConfig, Features, select
from bmask_slam.graph.arrays import Array, Arrays, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.array_file import nested, part
from bmask_slam.graph.geometry import inverse
from bmask_slam.moving.config import MovingObjectConfig
from bmask_slam.moving.depth_segments import MovingSpace
from bmask_slam.moving.depth_view_buffer import DepthViewBuffer, PosedView
from bmask_slam.moving.feature_motion import FeatureMotion, FeatureMotions
from bmask_slam.moving.feature_replenishment import FeatureReplenishment
from bmask_slam.moving.free_space_check import (
    DepthView,
    FreeSpaceCheck,
    PointMotion,
    depth_view,
)
from bmask_slam.moving.instance_motion import InstanceMotion
from bmask_slam.moving.keyframe_masks import KeyframeMasks, surfaces
from bmask_slam.moving.static_verification import StaticVerification
from bmask_slam.semantics.beliefs.movability import MovabilityFilter, log_odds, read_priors
from bmask_slam.semantics.tracks.instance_track import Sighting, Track
from bmask_slam.semantics.tracks.instance_tracks import InstanceTracks
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.camera_tracker import CameraTracker
from bmask_slam.tracking.tracker import Tracked
from bmask_slam.world.world_map import Keyframe, WorldMap

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class StaticFeatures:
    """A frame without what moves.

    Attributes:
        features: those that are left, and others in place of the rest once it is filled up; the
            frame's own where ``mostly_moving``.
        moving: (N,) of the frame's own features, those on moving things.
        mostly_moving: too few would have been left.
        view: what the frame's depth says about space; None if geometry is switched off.
        standing: how many features lie where views saw a surface.
        T_world_camera: (4, 4) that they were judged at; None if nothing was left out.
        space: where the frame moves; None if that is not known.
    """

    features: Features
    moving: Mask
    mostly_moving: bool
    view: DepthView | None
    standing: int = 0
    T_world_camera: Array | None = None
    space: MovingSpace | None = None

    @property
    def ignored(self) -> int:
        """How many features were left out."""
        return 0 if self.mostly_moving else int(np.count_nonzero(self.moving))


class MovingObjectFilter:
    """Keeps which landmarks and instances move; map and graph belong to the caller."""

    def __init__(
        self, camera: Camera, config: MovingObjectConfig, features: FeatureConfig | None = None
    ) -> None:
        features = features or FeatureConfig()
        self.camera = camera
        self.config = config
        self.priors = read_priors(config.priors)
        self.movability = MovabilityFilter(self.priors.unknown, config.movability)
        self.tracks = InstanceTracks(config.tracks)
        self.memory = DepthViewBuffer(config.check.views, config.check.interval_s)
        self.recent = DepthViewBuffer(
            config.static_verification.recent, config.static_verification.interval_s
        )
        self._check = FreeSpaceCheck(camera, features.disparity_sigma_px, config.check)
        watched = config.min_judged, config.mask_border_px
        self.static_verification = StaticVerification(
            self._check, config.static_verification, *watched
        )
        self._features = FeatureMotion(camera, self._check, config.regions)
        self._replenishment = FeatureReplenishment(camera, features)
        rules = config.movability.step, config.min_judged
        self._instance_motion = InstanceMotion(camera, self._check, self.priors, *rules)

    def leave_out(
        self,
        frame: Frame,
        features: Features,
        camera_tracker: CameraTracker | None,
        segment: int,
        mapper: Mapper,
    ) -> StaticFeatures:
        """Leave out the features on moving things, by the predicted pose, if there is one.

        If most seem to move, all are tracked first, and used if even they give no pose.
        """
        self.tracks.expire(frame.timestamp_s)
        views = self.memory.posed(segment, mapper)
        predicted = camera_tracker.prediction() if camera_tracker is not None else None
        static = self.static_features_at(frame, features, predicted, views)
        doubted = static.moving.sum() > self.config.doubt_share * len(features)
        settled = max(self.config.min_static, self.config.settled_share * len(features))
        if camera_tracker is None or not doubted or static.standing >= settled:
            return static
        found = camera_tracker.preview(features, mapper.world)
        if found is None:
            return replace(static, features=features, mostly_moving=True)
        return self.static_features_at(frame, features, found, views)

    def static_features_at(
        self,
        frame: Frame,
        features: Features,
        T_world_camera: Array | None,
        views: list[PosedView],
    ) -> StaticFeatures:
        """Leave out the features on moving things, given a pose; none without it."""
        geometry = self.config.geometry
        view = depth_view(frame.depth_m, self.config.check.window_px) if geometry else None
        if T_world_camera is None:
            return StaticFeatures(features, np.zeros(len(features), bool), False, view)
        point_motions, space = self._judge(frame, features, T_world_camera, views)
        moving = point_motions == PointMotion.MOVING
        if not moving.any():
            return StaticFeatures(features, moving, False, view, space=space)
        if np.count_nonzero(~moving) < self.config.min_static:
            logger.info("frame %d: nearly everything moves; all is used", frame.index)
            return StaticFeatures(features, moving, True, view)

        standing = int(np.count_nonzero(point_motions == PointMotion.STATIC))
        left = select(features, np.flatnonzero(~moving))
        return StaticFeatures(left, moving, False, view, standing, T_world_camera, space)

    def replenish(
        self, frame: Frame, features: Features, static: StaticFeatures, segment: int, mapper: Mapper
    ) -> StaticFeatures:
        """With further keypoints of the frame in place of its features that were left out."""
        pose = static.T_world_camera
        if pose is None or static.mostly_moving:
            return static
        views = self.memory.posed(segment, mapper)

        def moving(others: Features) -> Mask:
            return self._judge(frame, others, pose, views).point_motions == PointMotion.MOVING

        found = self._replenishment.replenished(frame, features, static.moving, moving)
        return replace(static, features=found)

    def watch(self, tracked: Tracked, view: DepthView | None, world: WorldMap) -> Ints:
        """Evidence of a tracked frame about landmarks; returns those in view believed moving."""
        ids = tracked.visible_ids
        if view is None or not len(ids):
            return ids[self.movability.moving(ids)]
        points = world.landmarks.points_world[ids]
        gone = self._check.judge(points, view, tracked.T_world_camera) == PointMotion.MOVING
        tracked_now = np.zeros(len(world.landmarks), bool)
        tracked_now[tracked.landmark_ids] = True
        found = tracked_now[ids]
        gone &= ~found
        told = found | gone
        self.movability.update(ids[told], gone[told], self.config.movability.frame_power)
        return ids[self.movability.moving(ids)]

    def remember(self, keyframe: Keyframe, static: StaticFeatures, mapper: Mapper) -> None:
        """A keyframe was made: landmarks that move leave map and graph, its depth is kept.

        Not that of what moves: it would be a surface that the same thing is found at next.
        """
        self._follow(mapper.world)
        self._remove(self.movability.known(), mapper)
        if static.view is not None:
            self.memory.add(keyframe.id, keyframe.timestamp_s, static.view, static.space)

    def see(self, masks: KeyframeMasks, mapper: Mapper) -> None:
        """A keyframe's masks, now or late: what is on moving things leaves map and graph."""
        if not self.config.labels:
            return
        keyframe = mapper.world.keyframes.get(masks.keyframe_id)
        views: list[PosedView] = []
        recent: list[PosedView] = []
        if keyframe is not None and self.config.geometry:
            views = self.memory.posed(keyframe.segment, mapper)
            recent = self.recent.posed(keyframe.segment, mapper)
        now_s = np.nan if keyframe is None else keyframe.timestamp_s
        rules = self.config.check.window_px, self.config.min_judged
        seen = surfaces(self.camera, masks, *rules)
        stood = self.static_verification.stood(masks, seen, recent, now_s)
        sightings = self._instance_motion.sightings(masks, seen, stood, views, now_s)
        moving, tracks = self._tracked(masks, sightings, now_s)
        still = [
            s is not None and (s.still or (track is not None and track.stood))
            for s, track in zip(sightings, tracks, strict=True)
        ]
        self._believe(masks, sightings, still)
        standing = np.isin(masks.assignment.owner, np.flatnonzero(still))
        self.memory.recall_space(masks.keyframe_id, standing)
        if not moving.any():
            return
        moves = np.isin(masks.assignment.owner, np.flatnonzero(moving))
        self.memory.forget_space(masks.keyframe_id, moves)
        pruner = replace(mapper.pruner(), border_px=-self.config.mask_border_px)
        if keyframe is not None and self.config.geometry:
            by_class = [t if _by_class(t) else None for t in tracks]
            self.static_verification.add(masks, seen, by_class, mapper.world)
        pruner.prune_mask(masks.keyframe_id, moves)
        self._remove(masks.landmark_ids, mapper)

    def reinstate(
        self, time_s: float, T_world_camera: Array, view: DepthView, near: Keyframe, mapper: Mapper
    ) -> bool:
        """What was left out for its class alone, and stands, comes back; whether anything did.

        A tracked frame with this view says so; it is remembered by its pose from a keyframe.
        """
        T_keyframe_camera = inverse(near.T_world_camera) @ T_world_camera
        self.recent.add(near.id, time_s, view, T_keyframe_camera=T_keyframe_camera)
        standing = self.static_verification.watch(time_s, view, T_world_camera, mapper.world)
        for pending in standing:
            logger.info("track %d stands: its class does not count", pending.track_id)
            self.tracks.reinstate(pending.track_id, float(log_odds(self.priors.unknown)))
            for removed in pending.removed:
                self.memory.recall_space(removed.keyframe_id, removed.mask.unpacked())
                free = self.static_verification.without_watched(removed)
                back = removed.keypoints[free], removed.patches[free]
                mapper.restore_observations(removed.keyframe_id, *back)
        return bool(standing)

    def begin_session(self) -> None:
        """Forget what moved in an earlier recording; landmarks stay what they are."""
        self.static_verification.clear()
        self.memory.clear()
        self.recent.clear()
        self.tracks.clear()

    def state(self) -> Arrays:
        """All that was learned, as named arrays."""
        return nested(
            movability=self.movability.state(),
            tracks=self.tracks.state(),
            memory=self.memory.state(),
            recent=self.recent.state(),
            suspects=self.static_verification.state(),
        )

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self.movability.restore(part(state, "movability"))
        self.tracks.restore(part(state, "tracks"))
        self.memory.restore(part(state, "memory"))
        self.recent.restore(part(state, "recent"))
        self.static_verification.restore(part(state, "suspects"))

    def _judge(
        self, frame: Frame, features: Features, T_world_camera: Array, views: list[PosedView]
    ) -> FeatureMotions:
        """What views and the tracks' boxes say about features (N,)."""
        boxes_world = self.tracks.moving_boxes(frame.timestamp_s)
        views = views if self.config.geometry else []
        return self._features.judge(frame, features, T_world_camera, views, boxes_world)

    def _tracked(
        self, masks: KeyframeMasks, sightings: Sequence[Sighting | None], now_s: float
    ) -> tuple[Mask, list[Track | None]]:
        """Which of a keyframe's sightings (K,) move, by their tracks, if they have one; these.

        A culled keyframe, whose time ``now_s`` is NaN, adds nothing to the tracks.
        """
        moving = np.array([s is not None and s.log_odds > 0 for s in sightings], bool)
        tracks: list[Track | None] = [None] * len(sightings)
        if np.isnan(now_s):
            return moving, tracks
        least = log_odds(self.config.tracks.min_prior)
        movable = {k: s for k, s in enumerate(sightings) if s is not None and s.log_odds > least}
        ids = self.tracks.see(now_s, list(movable.values()), masks.T_world_camera[:3, :3])
        ahead = [self.tracks.predicted(track, now_s) for track in self.tracks.tracks]
        by_id = {track.id: track for track in ahead}
        for k, track_id in zip(movable, ids, strict=False):
            tracks[k] = by_id[track_id]
            moving[k] = by_id[track_id].moving
        self.tracks.miss(
            now_s, [track for track in ahead if self._instance_motion.shows(masks, track)]
        )
        return moving, tracks

    def _believe(
        self, masks: KeyframeMasks, sightings: Sequence[Sighting | None], standing: Sequence[bool]
    ) -> None:
        """Landmarks on instances have their classes' priors, and move if views say so of their
        instance; of what stood still for long the class says nothing.
        """
        ids, first = np.unique(masks.landmark_ids, return_index=True)
        priors = masks.label_distributions[first] @ self.priors.of(masks.names)
        instances = masks.instances[first]
        still = np.array([*standing, False])
        evidence = np.array([0.0 if s is None else s.evidence for s in sightings] + [0.0])
        priors[still[instances]] = np.minimum(priors[still[instances]], self.priors.unknown)
        self.movability.set_priors(ids, np.clip(priors, 0.01, 0.99))
        told = evidence[instances] != 0
        self.movability.update(ids[told], evidence[instances[told]] > 0)

    def _remove(self, ids: Ints, mapper: Mapper) -> None:
        """Take those of the landmarks (N,) that move out of map and graph."""
        ids = mapper.world.landmarks.living(ids)
        ids = ids[self.movability.moving(ids)]
        if len(ids):
            mapper.pruner().prune_landmarks(ids)
            self.movability.drop(ids)

    def _follow(self, world: WorldMap) -> None:
        """Landmarks that were fused take what was known of them along; culled ones lose it."""
        known = self.movability.known()
        gone = known[~world.landmarks.alive[known]]
        parents = world.landmarks.current(gone)
        alive = world.landmarks.alive[parents]
        self.movability.move(gone[alive], parents[alive])
        self.movability.drop(gone[~alive])


def _by_class(track: Track | None) -> bool:
    """Whether a track moves for all that its class says, and geometry has not seen it do so."""
    return track is not None and track.moving and track.evidence <= 0
