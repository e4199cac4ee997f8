"""Instances that are left out for their class alone, until depth shows that they are static.

A mask with the class person counts as moving at once. Whether it is wrong, or the person stands, is
known only after some frames. What was taken out of the map for it is then restored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Ints, Mask
from bmask_slam.graph.files.array_file import split_rows
from bmask_slam.graph.geometry import transform
from bmask_slam.moving.depth_view_buffer import PosedView
from bmask_slam.moving.free_space_check import DepthView, FreeSpaceCheck
from bmask_slam.moving.keyframe_masks import KeyframeMasks, Surface
from bmask_slam.semantics.instances.instances import PackedMask
from bmask_slam.semantics.tracks.instance_track import Track
from bmask_slam.world.appearance import Patches
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.landmark_table import LandmarkTable
from bmask_slam.world.masked_keypoints import keypoints_under
from bmask_slam.world.world_map import WorldMap


@dataclass(frozen=True)
class StaticVerificationConfig:
    """An instance is static if frames at least ``stands_s`` later find its points in place.

    A frame finds it in place if ``share`` of its points in view lie on a surface, and the median of
    their distances from it along the ray is below ``shift_m``. At least ``frames`` frames, and
    ``share`` of those with enough points in view, must do so. (A walking person has left a third of
    the place after 0.3 s.) An instance stays pending for ``patience_s``. An instance that stood as
    long before is not left out at all; this is decided in the same way with ``recent`` frames, kept
    ``interval_s`` apart. With ``stands_s`` of 0 the verification is off, and only
    ``FreeSpaceCheckConfig.still_s`` decides.
    """

    stands_s: float = 0.4
    share: float = 0.8
    shift_m: float = 0.03
    frames: int = 3
    patience_s: float = 3.0
    recent: int = 10
    interval_s: float = 0.1

    def __post_init__(self) -> None:
        if self.stands_s < 0 or self.patience_s <= 0 or self.frames < 1:
            raise ValueError("stands_s must not be negative, patience_s positive, frames 1 or more")
        if not 0 < self.share <= 1 or self.shift_m <= 0:
            raise ValueError("share must be in (0, 1], shift_m positive")
        if self.recent < 1 or self.interval_s <= 0:
            raise ValueError("recent must be 1 or more, interval_s positive")

    def stands(self, static_views: int, moved_views: int) -> bool:
        """Whether an instance with these numbers of frames is static."""
        return static_views >= max(self.frames, self.share * (static_views + moved_views))


@dataclass(frozen=True, eq=False)
class Removed:
    """What was removed from a keyframe for an instance.

    Attributes:
        keyframe_id: of the keyframe.
        keypoints: (N,) keypoints that were masked.
        patches: (N) patches of the landmarks that they observed.
        mask: of the instance.
    """

    keyframe_id: int
    keypoints: Ints
    patches: Patches
    mask: PackedMask


@dataclass(frozen=True, eq=False)
class PendingMovable:
    """An instance that was left out for its class alone.

    Attributes:
        track_id: of its track, which may have ended.
        keyframe_id: of the keyframe that saw it first, or that a label view which did is near.
        time_s: when it was seen first.
        points: (N, 3) on its surface, m, in the keyframe's camera frame.
        removed: what was removed for it, from this and later keyframes.
        static_views, moved_views: number of later frames that found it in place, and that did not.
    """

    track_id: int
    keyframe_id: int
    time_s: float
    points: Array
    removed: tuple[Removed, ...]
    static_views: int = 0
    moved_views: int = 0


class StaticVerification:
    """All pending instances; map and graph belong to the caller.

    A frame is used if it sees ``at_least`` points of an instance. Masks are widened by
    ``border_px`` when their observations are removed.
    """

    def __init__(
        self, check: FreeSpaceCheck, config: StaticVerificationConfig, at_least: int, border_px: int
    ) -> None:
        self.config = config
        self.pending: list[PendingMovable] = []
        self._check = check
        self._at_least, self._border_px = at_least, border_px

    def add(
        self,
        masks: KeyframeMasks,
        observed_surfaces: Sequence[Surface | None],
        tracks: Sequence[Track | None],
        world: WorldMap,
    ) -> None:
        """Add a keyframe's instances (K,) of these tracks, before they are removed from it.

        An instance that is pending already stays so from its first time, unless it moved.
        """
        if self.config.stands_s == 0:
            return
        anchor = world.keyframes[masks.anchor_id]
        for k, (surface, track) in enumerate(zip(observed_surfaces, tracks, strict=True)):
            if surface is None or track is None:
                continue
            mask = masks.assignment.owner == k
            removed: tuple[Removed, ...] = ()
            if masks.of_keyframe:
                own = _about_to_be_removed(mask, anchor, world.landmarks, self._border_px)
                removed = (own,)
            points = transform(masks.T_anchor_camera, surface.points[surface.complete])
            pending = PendingMovable(track.id, anchor.id, masks.timestamp_s, points, removed)
            before = [
                s
                for s in self.pending
                if s.track_id == track.id and s.moved_views <= s.static_views
            ]
            if before:
                pending = replace(before[0], removed=(*before[0].removed, *removed))
            self.pending = [s for s in self.pending if s.track_id != track.id] + [pending]

    def stood(
        self,
        masks: KeyframeMasks,
        observed_surfaces: Sequence[Surface | None],
        recent: Sequence[PosedView],
        now_s: float,
    ) -> list[bool]:
        """Which of a keyframe's instances (K,), observed at ``now_s``, were static for long enough.

        Decided by recent frames before the keyframe, and after it if the masks come late.
        """
        least_s = self.config.stands_s
        apart = [v for v in recent if abs(v.timestamp_s - now_s) >= least_s]
        if least_s == 0 or not apart:
            return [False] * len(observed_surfaces)
        views = [(v.full, v.T_world_camera) for v in apart]
        stood = []
        for surface in observed_surfaces:
            points = np.zeros((0, 3)) if surface is None else surface.points[surface.complete]
            points_world = transform(masks.T_world_camera, points)
            stood.append(self.config.stands(*self._count_views(points_world, views)))
        return stood

    def verify(
        self, time_s: float, view: DepthView, T_world_camera: Array, world: WorldMap
    ) -> list[PendingMovable]:
        """Update by a tracked frame's depth; returns those that are static, no longer pending."""
        oldest_s = time_s - self.config.patience_s
        recent = [s for s in self.pending if s.time_s >= oldest_s]
        kept = [s for s in recent if s.keyframe_id in world.keyframes]
        judged = [
            self._updated(s, view, T_world_camera, world)
            if time_s - s.time_s >= self.config.stands_s
            else s
            for s in kept
        ]
        stand = [self.config.stands(s.static_views, s.moved_views) for s in judged]
        self.pending = [s for s, stands in zip(judged, stand, strict=True) if not stands]
        return [s for s, stands in zip(judged, stand, strict=True) if stands]

    def not_pending(self, removed: Removed) -> Mask:
        """Mask (N,) of the removed keypoints that no other pending instance covers."""
        others = [r.keypoints for s in self.pending for r in s.removed if _same(r, removed)]
        return ~np.isin(removed.keypoints, np.concatenate([np.zeros(0, np.int64), *others]))

    def clear(self) -> None:
        """Drop all pending instances: another recording begins."""
        self.pending = []

    def state(self) -> Arrays:
        """All pending instances, as named arrays."""
        every = self.pending
        removed = [r for s in every for r in s.removed]
        no_patches = LandmarkTable().patches_of(np.zeros(0, np.int64))
        points, keypoints = [s.points for s in every], [r.keypoints for r in removed]
        counts = [
            (s.track_id, s.keyframe_id, s.static_views, s.moved_views, len(s.removed))
            for s in every
        ]
        return {
            "counts": np.array(counts, np.int64).reshape(-1, 5),
            "times_s": np.array([s.time_s for s in every], float),
            "points": np.concatenate([np.zeros((0, 3)), *points]),
            "points_each": np.array([len(p) for p in points], np.int64),
            "keyframe_ids": np.array([r.keyframe_id for r in removed], np.int64),
            "keypoints": np.concatenate([np.zeros(0, np.int64), *keypoints]),
            "keypoints_each": np.array([len(k) for k in keypoints], np.int64),
            "patches": np.concatenate([no_patches.images, *(r.patches.images for r in removed)]),
            "patch_views": np.concatenate([no_patches.views, *(r.patches.views for r in removed)]),
            "bits": np.array([r.mask.bits for r in removed], np.uint8).ravel(),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        points = split_rows(state["points"], state["points_each"])
        keypoints, images, views = (
            split_rows(state[name], state["keypoints_each"])
            for name in ("keypoints", "patches", "patch_views")
        )
        patches = [Patches(*both) for both in zip(images, views, strict=True)]
        ids = state["keyframe_ids"].tolist()
        bits = state["bits"].reshape(max(len(ids), 1), -1)[: len(ids)]
        shape = self._check.camera.height, self._check.camera.width
        masks = [PackedMask(of_one, shape) for of_one in bits]
        removed = [Removed(*row) for row in zip(ids, keypoints, patches, masks, strict=True)]
        self.pending = []
        counts = state["counts"].tolist()
        rows = zip(counts, state["times_s"].tolist(), points, strict=True)
        for (track_id, keyframe_id, static_views, moved_views, count), time_s, of_one in rows:
            own_removed, removed = tuple(removed[:count]), removed[count:]
            self.pending.append(
                PendingMovable(
                    track_id, keyframe_id, time_s, of_one, own_removed, static_views, moved_views
                )
            )

    def _updated(
        self, pending: PendingMovable, view: DepthView, T_world_camera: Array, world: WorldMap
    ) -> PendingMovable:
        """A pending instance with the evidence of a frame counted."""
        pose = world.keyframes[pending.keyframe_id].T_world_camera
        points_world = transform(pose, pending.points)
        now = [(view, T_world_camera)]
        static_views, moved_views = self._count_views(points_world, now)
        static_views += pending.static_views
        moved_views += pending.moved_views
        return replace(pending, static_views=static_views, moved_views=moved_views)

    def _count_views(
        self, points_world: Array, views: Sequence[tuple[DepthView, Array]]
    ) -> tuple[int, int]:
        """Numbers of views, each with T_world_camera, with and without a surface at points (N, 3).

        Views that see too few of the points are not counted.
        """
        off_m, inside = self._check.offsets(points_world, views)
        in_view, found = inside.sum(axis=1), np.isfinite(off_m)
        judged = in_view >= self._at_least
        stays = judged & (found.sum(axis=1) >= self.config.share * in_view)
        shift_m = [np.median(off_m[k, found[k]]) for k in np.flatnonzero(stays)]
        static_views = int(np.count_nonzero(np.abs(shift_m) < self.config.shift_m))
        return static_views, int(np.count_nonzero(judged)) - static_views


def _about_to_be_removed(
    mask: Mask, keyframe: Keyframe, landmarks: LandmarkTable, border_px: int
) -> Removed:
    """What a widened mask (H, W) covers in a keyframe that is not masked yet."""
    keypoints = keypoints_under(mask, keyframe.features.image_pixels, -border_px)
    free = keypoints[~keyframe.masked[keypoints]]
    patches = landmarks.patches_of(keyframe.landmark_ids[free])
    return Removed(keyframe.id, free, patches, PackedMask.of(mask))


def _same(a: Removed, b: Removed) -> bool:
    return a.keyframe_id == b.keyframe_id
