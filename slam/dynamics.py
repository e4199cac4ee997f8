"""What moves: kept out of tracking and of the map, taken out of the graph where it was put in."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graph.array_file import Arrays, nested, part
from graph.camera import Camera
from graph.geometry import Array
from semantics.instance_track import Sighting
from semantics.instance_tracks import InstanceTracks, TrackConfig
from semantics.movability import MovabilityConfig, MovabilityFilter, log_odds, read_priors
from slam.depth_regions import DepthRegionConfig, MovingSpace
from slam.feature_check import FeatureCheck, Judged
from slam.features import FeatureConfig, Features, select
from slam.frame import Frame
from slam.keyframe_masks import KeyframeMasks
from slam.landmarks import Ints, Mask
from slam.localiser import Localiser
from slam.mapper import Mapper
from slam.refill import Refill
from slam.static_check import (
    DepthView,
    StaticCheck,
    StaticCheckConfig,
    Verdict,
    depth_view,
)
from slam.tracker import Tracked
from slam.view_memory import PosedView, ViewMemory
from slam.witness import Witness
from slam.world_map import Keyframe, WorldMap

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DynamicsConfig:
    """Which evidence of motion counts: that of masks by their ``labels``, that of ``geometry``.

    ``priors`` is a YAML file of P(moving) by class, or the name of one in ``data/labels``. With
    fewer than ``min_static`` keypoints left all are used, and the frame says so. If more than
    ``doubt_share`` of them seem to move, the pose is looked at again. Masks of moving
    things are widened by ``mask_border_px``. An instance is judged by at least ``min_judged`` of
    its pixels.
    """

    labels: bool = True
    geometry: bool = True
    priors: str = "movability"
    doubt_share: float = 0.5
    settled_share: float = 0.2
    min_static: int = 60
    mask_border_px: int = 5
    min_judged: int = 20
    movability: MovabilityConfig = field(default_factory=MovabilityConfig)
    check: StaticCheckConfig = field(default_factory=StaticCheckConfig)
    regions: DepthRegionConfig = field(default_factory=DepthRegionConfig)
    tracks: TrackConfig = field(default_factory=TrackConfig)

    def __post_init__(self) -> None:
        if self.min_static < 0 or self.mask_border_px < 0 or self.min_judged < 1:
            raise ValueError(
                "min_static and mask_border_px must not be negative, min_judged at least 1"
            )


@dataclass(frozen=True, eq=False)
class Sifted:
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


class Dynamics:
    """Keeps which landmarks and instances move; map and graph belong to the caller."""

    def __init__(
        self, camera: Camera, config: DynamicsConfig, features: FeatureConfig | None = None
    ) -> None:
        features = features or FeatureConfig()
        self.camera = camera
        self.config = config
        self.priors = read_priors(config.priors)
        self.movability = MovabilityFilter(self.priors.unknown, config.movability)
        self.tracks = InstanceTracks(config.tracks)
        self.memory = ViewMemory(config.check)
        self._check = StaticCheck(camera, features.disparity_sigma_px, config.check)
        self._features = FeatureCheck(camera, self._check, config.regions)
        self._refill = Refill(camera, features)
        rules = config.movability.step, config.min_judged
        self._witness = Witness(camera, self._check, self.priors, *rules)

    def leave_out(
        self,
        frame: Frame,
        features: Features,
        localiser: Localiser | None,
        segment: int,
        mapper: Mapper,
    ) -> Sifted:
        """Leave out the features on moving things, by the predicted pose, if there is one.

        If most seem to move, all are tracked first, and used if even they give no pose.
        """
        self.tracks.expire(frame.timestamp_s)
        views = self.memory.posed(segment, mapper)
        predicted = localiser.prediction() if localiser is not None else None
        sifted = self.sift(frame, features, predicted, views)
        doubted = sifted.moving.sum() > self.config.doubt_share * len(features)
        settled = max(self.config.min_static, self.config.settled_share * len(features))
        if localiser is None or not doubted or sifted.standing >= settled:
            return sifted
        found = localiser.preview(features, mapper.world)
        if found is None:
            return replace(sifted, features=features, mostly_moving=True)
        return self.sift(frame, features, found, views)

    def sift(
        self,
        frame: Frame,
        features: Features,
        T_world_camera: Array | None,
        views: list[PosedView],
    ) -> Sifted:
        """Leave out the features on moving things, given a pose; none without it."""
        geometry = self.config.geometry
        view = depth_view(frame.depth_m, self.config.check.window_px) if geometry else None
        if T_world_camera is None:
            return Sifted(features, np.zeros(len(features), bool), False, view)
        verdicts, space = self._judge(frame, features, T_world_camera, views)
        moving = verdicts == Verdict.MOVING
        if not moving.any():
            return Sifted(features, moving, False, view, space=space)
        if np.count_nonzero(~moving) < self.config.min_static:
            logger.info("frame %d: nearly everything moves; all is used", frame.index)
            return Sifted(features, moving, True, view)

        standing = int(np.count_nonzero(verdicts == Verdict.STATIC))
        left = select(features, np.flatnonzero(~moving))
        return Sifted(left, moving, False, view, standing, T_world_camera, space)

    def fill_up(
        self, frame: Frame, features: Features, sifted: Sifted, segment: int, mapper: Mapper
    ) -> Sifted:
        """With further keypoints of the frame in place of its features that were left out."""
        pose = sifted.T_world_camera
        if pose is None or sifted.mostly_moving:
            return sifted
        views = self.memory.posed(segment, mapper)

        def moving(others: Features) -> Mask:
            return self._judge(frame, others, pose, views).verdicts == Verdict.MOVING

        found = self._refill.filled_up(frame, features, sifted.moving, moving)
        return replace(sifted, features=found)

    def watch(self, tracked: Tracked, view: DepthView | None, world: WorldMap) -> Ints:
        """Evidence of a tracked frame about landmarks; returns those in view believed moving."""
        ids = tracked.visible_ids
        if view is None or not len(ids):
            return ids[self.movability.moving(ids)]
        points = world.landmarks.points_world[ids]
        gone = self._check.judge(points, view, tracked.T_world_camera) == Verdict.MOVING
        tracked_now = np.zeros(len(world.landmarks), bool)
        tracked_now[tracked.landmark_ids] = True
        found = tracked_now[ids]
        gone &= ~found
        told = found | gone
        self.movability.update(ids[told], gone[told], self.config.movability.frame_power)
        return ids[self.movability.moving(ids)]

    def remember(self, keyframe: Keyframe, sifted: Sifted, mapper: Mapper) -> None:
        """A keyframe was made: landmarks that move leave map and graph, its depth is kept.

        Not that of what moves: it would be a surface that the same thing is found at next.
        """
        self._follow(mapper.world)
        self._remove(self.movability.known(), mapper)
        if sifted.view is not None:
            self.memory.add(keyframe.id, keyframe.timestamp_s, sifted.view, sifted.space)

    def see(self, masks: KeyframeMasks, mapper: Mapper) -> None:
        """A keyframe's masks, now or late: what is on moving things leaves map and graph."""
        if not self.config.labels:
            return
        keyframe = mapper.world.keyframes.get(masks.keyframe_id)
        views: list[PosedView] = []
        if keyframe is not None and self.config.geometry:
            views = self.memory.posed(keyframe.segment, mapper)
        now_s = np.nan if keyframe is None else keyframe.timestamp_s
        sightings = self._witness.sightings(masks, views, now_s)
        moving = self._tracked(masks, sightings, now_s)
        self._believe(masks, sightings)
        still = [s is not None and s.still for s in sightings]
        standing = np.isin(masks.claims.owner, np.flatnonzero(still))
        self.memory.recall_space(masks.keyframe_id, standing)
        if not moving.any():
            return
        covered = np.isin(masks.claims.owner, np.flatnonzero(moving))
        self.memory.forget_space(masks.keyframe_id, covered)
        pruner = replace(mapper.pruner(), border_px=-self.config.mask_border_px)
        pruner.prune_mask(masks.keyframe_id, covered)
        self._remove(masks.landmark_ids, mapper)

    def begin_session(self) -> None:
        """Forget what moved in an earlier recording; landmarks stay what they are."""
        self.memory.clear()
        self.tracks.clear()

    def state(self) -> Arrays:
        """All that was learned, as named arrays."""
        return nested(
            movability=self.movability.state(),
            tracks=self.tracks.state(),
            memory=self.memory.state(),
        )

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self.movability.restore(part(state, "movability"))
        self.tracks.restore(part(state, "tracks"))
        self.memory.restore(part(state, "memory"))

    def _judge(
        self, frame: Frame, features: Features, T_world_camera: Array, views: list[PosedView]
    ) -> Judged:
        """What views and the tracks' boxes say about features (N,)."""
        boxes_world = self.tracks.moving_boxes(frame.timestamp_s)
        views = views if self.config.geometry else []
        return self._features.judge(frame, features, T_world_camera, views, boxes_world)

    def _tracked(
        self, masks: KeyframeMasks, sightings: Sequence[Sighting | None], now_s: float
    ) -> Mask:
        """Which of a keyframe's sightings (K,) move, by their tracks, if they have one.

        A culled keyframe, whose time ``now_s`` is NaN, adds nothing to the tracks.
        """
        moving = np.array([s is not None and s.log_odds > 0 for s in sightings], bool)
        if np.isnan(now_s):
            return moving
        least = log_odds(self.config.tracks.min_prior)
        movable = {k: s for k, s in enumerate(sightings) if s is not None and s.log_odds > least}
        ids = self.tracks.see(now_s, list(movable.values()), masks.T_world_camera[:3, :3])
        ahead = [self.tracks.predicted(track, now_s) for track in self.tracks.tracks]
        by_id = {track.id: track.moving for track in ahead}
        if ids:
            moving[list(movable)] = [by_id[track_id] for track_id in ids]
        self.tracks.miss(now_s, [track for track in ahead if self._witness.shows(masks, track)])
        return moving

    def _believe(self, masks: KeyframeMasks, sightings: Sequence[Sighting | None]) -> None:
        """Landmarks on instances have their classes' priors, and move if views say so of their
        instance; of what stood still for long the class says nothing.
        """
        ids, first = np.unique(masks.landmark_ids, return_index=True)
        priors = masks.label_distributions[first] @ self.priors.of(masks.names)
        instances = masks.instances[first]
        still = np.array([s is not None and s.still for s in sightings] + [False])
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
        heirs = world.landmarks.current(gone)
        alive = world.landmarks.alive[heirs]
        self.movability.move(gone[alive], heirs[alive])
        self.movability.drop(gone[~alive])
