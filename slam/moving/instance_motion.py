"""Where a keyframe's instances are in space, and whether they move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.moving.depth_view_buffer import PosedView
from bmask_slam.moving.feature_motion import NEAREST_M
from bmask_slam.moving.free_space_check import FreeSpaceCheck
from bmask_slam.moving.keyframe_masks import KeyframeMasks, Surface
from bmask_slam.semantics.beliefs.movability import MovabilityPriors, log_odds
from bmask_slam.semantics.tracks.instance_track import Sighting, Track


class MotionState(Enum):
    """What views say about a thing."""

    MOVING = "moving"
    """Most of it lies in space that was seen to be free."""
    UNKNOWN = "unknown"
    STATIC = "static"
    """Most of it is where a surface was seen."""
    STILL = "still"
    """It was there for so long that its class says nothing about it."""

    @property
    def is_static(self) -> bool:
        """Whether it stands, for long or not."""
        return self in (MotionState.STATIC, MotionState.STILL)


def motion_state(
    points_world: Array,
    time_s: float,
    views: Sequence[PosedView],
    check: FreeSpaceCheck,
    at_least: int,
) -> MotionState:
    """What views say about a thing at points (N, 3) at a time; nothing if of too few points.

    That it is still is asked of all that was seen, things that were believed to move included: a
    thing with a wrong name would hide its own traces.
    """
    if not views:
        return MotionState.UNKNOWN
    apart_s = np.array([v.timestamp_s - time_s for v in views])
    seen = check.judge_all(points_world, [(v.seen, v.T_world_camera) for v in views])
    if check.stood_still(seen, apart_s, at_least):
        return MotionState.STILL
    told = check.judge_all(points_world, [(v.view, v.T_world_camera) for v in views])
    point_motions = check.agree(told)
    known = np.count_nonzero(point_motions)
    if known < at_least:
        return MotionState.UNKNOWN
    moves = np.count_nonzero(point_motions < 0) > known / 2
    return MotionState.MOVING if moves else MotionState.STATIC


@dataclass(frozen=True, eq=False)
class InstanceMotion:
    """Tells of instances by their masks, their classes' priors and what other keyframes saw.

    Attributes:
        step: by how much the log odds of an instance that was seen to move or to stand change.
        min_judged: it is judged by at least so many of its pixels.
    """

    camera: Camera
    check: FreeSpaceCheck
    priors: MovabilityPriors
    step: float
    min_judged: int

    def sightings(
        self,
        masks: KeyframeMasks,
        seen: Sequence[Surface | None],
        stood: Sequence[bool],
        views: Sequence[PosedView],
        now_s: float,
    ) -> list[Sighting | None]:
        """A keyframe's instances (K,) in space; None for those without a surface.

        Of those that ``stood`` that is known. Of the views the keyframe's own does not count. It
        was taken at ``now_s``.
        """
        others = [v for v in views if v.keyframe_id != masks.keyframe_id]
        found: list[Sighting | None] = []
        for k, surface in enumerate(seen):
            if surface is None:
                found.append(None)
                continue
            points_world = transform(masks.T_world_camera, surface.points)
            rules = self.check, self.min_judged
            known = (
                MotionState.STILL if stood[k] else motion_state(points_world, now_s, others, *rules)
            )
            found.append(self._sighting(k, surface, masks, known))
        return found

    def shows(self, masks: KeyframeMasks, track: Track) -> bool:
        """Whether a keyframe shows the place of a track, as predicted, or what is behind it."""
        (centre,) = transform(inverse(masks.T_world_camera), track.mean[None, :3])
        if centre[2] < NEAREST_M:
            return False
        column, row = self.camera.project_distorted(centre[None])[0]
        if not (0 <= column < self.camera.width and 0 <= row < self.camera.height):
            return False
        depth_m, step = masks.depth_m, masks.step
        height, width = depth_m.shape
        there_m = depth_m[min(int(row / step), height - 1), min(int(column / step), width - 1)]
        return bool(there_m > centre[2] - track.half_size[2] - self.check.config.margin_m)

    def _sighting(
        self, k: int, surface: Surface, masks: KeyframeMasks, found: MotionState
    ) -> Sighting:
        low, centroid, high = np.percentile(surface.points, (4, 50, 96), axis=0)
        distribution, still = masks.assignment.instances[k].distribution, found is MotionState.STILL
        prior = float(distribution @ self.priors.of(masks.names))
        prior = min(prior, self.priors.unknown) if still else prior
        return Sighting(
            centroid_world=transform(masks.T_world_camera, centroid[None])[0],
            half_size=np.maximum(high - centroid, centroid - low),
            distribution=distribution,
            prior=float(log_odds(np.clip(prior, 0.01, 0.99))),
            evidence=self.step * (int(found is MotionState.MOVING) - int(found.is_static)),
            still=still,
        )
