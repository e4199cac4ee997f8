"""Where the instances of a keyframe are in space, and whether they move."""

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
from bmask_slam.moving.free_space_check import FreeSpaceCheck, PointMotions
from bmask_slam.moving.keyframe_masks import KeyframeMasks, Surface
from bmask_slam.semantics.beliefs.movability import MovabilityPriors, log_odds
from bmask_slam.semantics.tracks.instance_track import Sighting, Track


class MotionState(Enum):
    """The motion of an instance, by depth views."""

    MOVING = "moving"
    """Most of it is in space that was observed to be free."""
    UNKNOWN = "unknown"
    STATIC = "static"
    """Most of it is where a surface was observed."""
    STILL = "still"
    """It stood there for so long that its class is not evidence of motion."""

    @property
    def is_static(self) -> bool:
        """Whether it is static, for long or not."""
        return self in (MotionState.STATIC, MotionState.STILL)


def motion_state(
    points_world: Array,
    time_s: float,
    views: Sequence[PosedView],
    check: FreeSpaceCheck,
    at_least: int,
) -> MotionState:
    """The motion of an instance at points (N, 3) at a time; unknown with too few points.

    STILL is decided with the views as recorded, with moving parts: otherwise an instance with
    a wrong class would remove its own evidence.
    """
    if not views:
        return MotionState.UNKNOWN
    apart_s = np.array([v.timestamp_s - time_s for v in views])
    by_full_view = check.judge_all(points_world, [(v.full, v.T_world_camera) for v in views])
    if check.stood_still(by_full_view, apart_s, at_least):
        return MotionState.STILL
    motions = check.judge_all(points_world, [(v.view, v.T_world_camera) for v in views])
    found = _of_most(check.agree(motions), at_least)
    if found is MotionState.STATIC:  # in a shorter time most of what moves stays in its own place
        found = _of_most(check.agree(motions[np.abs(apart_s) >= check.config.static_s]), at_least)
    return found


def _of_most(point_motions: PointMotions, at_least: int) -> MotionState:
    """The motion of an instance by that of its points (N,)."""
    known = np.count_nonzero(point_motions)
    if known < at_least:
        return MotionState.UNKNOWN
    moves = np.count_nonzero(point_motions < 0) > known / 2
    return MotionState.MOVING if moves else MotionState.STATIC


@dataclass(frozen=True, eq=False)
class InstanceMotion:
    """Evidence of the motion of instances, by masks, class priors and views of other keyframes.

    Attributes:
        step: change of the log odds of an instance that moves, or is static.
        min_judged: least number of pixels by which an instance is judged.
    """

    camera: Camera
    check: FreeSpaceCheck
    priors: MovabilityPriors
    step: float
    min_judged: int

    def sightings(
        self,
        masks: KeyframeMasks,
        by_full_view: Sequence[Surface | None],
        stood: Sequence[bool],
        views: Sequence[PosedView],
        now_s: float,
    ) -> list[Sighting | None]:
        """A keyframe's instances (K,) in space; None for those without a surface.

        Those that ``stood`` (K,) are STILL. The keyframe was taken at ``now_s``; its own view is
        not used.
        """
        others = [v for v in views if v.keyframe_id != masks.keyframe_id]
        found: list[Sighting | None] = []
        for k, surface in enumerate(by_full_view):
            if surface is None:
                found.append(None)
                continue
            points_world = transform(masks.T_world_camera, surface.points)
            known = MotionState.STILL
            if not stood[k]:
                known = motion_state(points_world, now_s, others, self.check, self.min_judged)
            found.append(self._sighting(k, surface, masks, known))
        return found

    def shows(self, masks: KeyframeMasks, track: Track) -> bool:
        """Whether a keyframe sees the predicted place of a track, or what is behind it."""
        (centre,) = transform(inverse(masks.T_world_camera), track.mean[None, :3])
        if centre[2] < NEAREST_M:
            return False
        column, row = self.camera.project_distorted(centre[None])[0]
        if not (0 <= column < self.camera.width and 0 <= row < self.camera.height):
            return False
        depth_m, step = masks.depth_m, masks.step
        height, width = depth_m.shape
        measured_m = depth_m[min(int(row / step), height - 1), min(int(column / step), width - 1)]
        return bool(measured_m > centre[2] - track.half_size[2] - self.check.config.margin_m)

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
