"""Things that are left out for their class alone, watched until they are seen to stand.

A mask says at once that a person moves; that what it shows is no person, or stands, is known only
once it was watched for a while. What was taken out of the map for it meanwhile then comes back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graph.array_file import Arrays
from graph.geometry import Array, transform
from semantics.instance_track import Track
from semantics.instances import PackedMask
from slam.keyframe_masks import KeyframeMasks, surface_points
from slam.landmarks import Ints, Mask
from slam.map_pruning import covered
from slam.static_check import DepthView, StaticCheck
from slam.world_map import Keyframe, WorldMap


@dataclass(frozen=True)
class SuspectConfig:
    """When a thing stands: what a keyframe saw of it is where it was ``stands_s`` later, or more.

    A frame says so if ``share`` of its points in view lie on a surface and the median of their
    distances from it along the ray is below ``shift_m``; at least ``frames`` have to, and ``share``
    of those that say anything. Someone who walks has left a third of his own place after 0.3 s. A
    thing is watched for ``patience_s``; with ``stands_s`` of 0 not at all.
    """

    stands_s: float = 0.4
    share: float = 0.8
    shift_m: float = 0.03
    frames: int = 3
    patience_s: float = 3.0

    def __post_init__(self) -> None:
        if self.stands_s < 0 or self.patience_s <= 0 or self.frames < 1:
            raise ValueError("stands_s must not be negative, patience_s positive, frames 1 or more")
        if not 0 < self.share <= 1 or self.shift_m <= 0:
            raise ValueError("share must be in (0, 1], shift_m positive")


@dataclass(frozen=True, eq=False)
class Removed:
    """What was taken out of a keyframe for a thing.

    Attributes:
        keyframe_id: its.
        keypoints: (N,) that were masked.
        mask: the thing's.
    """

    keyframe_id: int
    keypoints: Ints
    mask: PackedMask


@dataclass(frozen=True, eq=False)
class Suspect:
    """A thing as a keyframe saw it.

    Attributes:
        track_id: of its track, which may have ended.
        keyframe_id, time_s: where and when it was seen.
        points: (N, 3) on its surface, m, in the keyframe's camera frame.
        removed: what was taken out for it, of this and later keyframes.
        there, gone: frames, long enough after that, that found it where it was, and that did not.
    """

    track_id: int
    keyframe_id: int
    time_s: float
    points: Array
    removed: tuple[Removed, ...]
    there: int = 0
    gone: int = 0


class Suspects:
    """All things that are watched; map and graph belong to the caller.

    ``at_least`` so many of a thing's points have to be in view. ``border_px`` are those by which
    masks of moving things are widened.
    """

    def __init__(
        self, check: StaticCheck, config: SuspectConfig, at_least: int, border_px: int
    ) -> None:
        self.config = config
        self.watched: list[Suspect] = []
        self._check = check
        self._at_least, self._border_px = at_least, border_px

    def add(self, masks: KeyframeMasks, tracks: Sequence[Track | None], keyframe: Keyframe) -> None:
        """A keyframe's instances (K,) on these tracks are about to be taken out of it.

        What is seen again is watched on from the first time, unless it was found to move.
        """
        if self.config.stands_s == 0:
            return
        view = masks.view(self._check.config.window_px)
        for k, track in enumerate(tracks):
            if track is None:
                continue
            points = surface_points(self._check.camera, masks, k, self._at_least)
            if points is None:
                continue
            seen, _ = self._check.offsets(points, view, np.eye(4))
            removed = _about_to_be_removed(masks.claims.owner == k, keyframe, self._border_px)
            suspect = Suspect(
                track.id,
                keyframe.id,
                keyframe.timestamp_s,
                points[np.isfinite(seen)],
                (removed,),
            )
            before = [s for s in self.watched if s.track_id == track.id and s.gone <= s.there]
            if before:
                suspect = replace(before[0], removed=(*before[0].removed, removed))
            self.watched = [s for s in self.watched if s.track_id != track.id] + [suspect]

    def watch(
        self, time_s: float, view: DepthView, T_world_camera: Array, world: WorldMap
    ) -> list[Suspect]:
        """What a tracked frame's depth says; returns the things that stand, not watched further."""
        oldest_s = time_s - self.config.patience_s
        recent = [s for s in self.watched if s.time_s >= oldest_s]
        kept = [s for s in recent if s.keyframe_id in world.keyframes]
        told = [
            self._told(s, view, T_world_camera, world)
            if time_s - s.time_s >= self.config.stands_s
            else s
            for s in kept
        ]
        stand = [self._stands(s) for s in told]
        self.watched = [s for s, stands in zip(told, stand, strict=True) if not stands]
        return [s for s, stands in zip(told, stand, strict=True) if stands]

    def without_watched(self, removed: Removed) -> Ints:
        """Keypoints (N,) of what was taken out that are not under anything else that is watched."""
        others = [r.keypoints for s in self.watched for r in s.removed if _same(r, removed)]
        return np.setdiff1d(removed.keypoints, np.concatenate([np.zeros(0, np.int64), *others]))

    def clear(self) -> None:
        """Watch nothing: another recording."""
        self.watched = []

    def state(self) -> Arrays:
        """All that is watched, as named arrays."""
        every = self.watched
        removed = [r for s in every for r in s.removed]
        points, keypoints = [s.points for s in every], [r.keypoints for r in removed]
        counts = [(s.track_id, s.keyframe_id, s.there, s.gone, len(s.removed)) for s in every]
        return {
            "counts": np.array(counts, np.int64).reshape(-1, 5),
            "times_s": np.array([s.time_s for s in every], float),
            "points": np.concatenate([np.zeros((0, 3)), *points]),
            "points_each": np.array([len(p) for p in points], np.int64),
            "keyframe_ids": np.array([r.keyframe_id for r in removed], np.int64),
            "keypoints": np.concatenate([np.zeros(0, np.int64), *keypoints]),
            "keypoints_each": np.array([len(k) for k in keypoints], np.int64),
            "bits": np.array([r.mask.bits for r in removed], np.uint8).ravel(),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        points = np.split(state["points"], np.cumsum(state["points_each"])[:-1])
        keypoints = np.split(state["keypoints"], np.cumsum(state["keypoints_each"])[:-1])
        ids = state["keyframe_ids"].tolist()
        bits = state["bits"].reshape(max(len(ids), 1), -1)
        shape = self._check.camera.height, self._check.camera.width
        masks = [PackedMask(of_one, shape) for of_one in bits]
        removed = [Removed(*row) for row in zip(ids, keypoints, masks, strict=False)]
        self.watched = []
        rows = zip(state["counts"].tolist(), state["times_s"].tolist(), points, strict=False)
        for (track_id, keyframe_id, there, gone, count), time_s, of_one in rows:
            mine, removed = tuple(removed[:count]), removed[count:]
            self.watched.append(Suspect(track_id, keyframe_id, time_s, of_one, mine, there, gone))

    def _told(
        self, suspect: Suspect, view: DepthView, T_world_camera: Array, world: WorldMap
    ) -> Suspect:
        """A suspect with what a frame says of it counted."""
        pose = world.keyframes[suspect.keyframe_id].T_world_camera
        points_world = transform(pose, suspect.points)
        off_m, inside = self._check.offsets(points_world, view, T_world_camera)
        in_view, there_m = np.count_nonzero(inside), off_m[np.isfinite(off_m)]
        if in_view < self._at_least:
            return suspect
        stays = len(there_m) >= self.config.share * in_view
        if stays and abs(float(np.median(there_m))) < self.config.shift_m:
            return replace(suspect, there=suspect.there + 1)
        return replace(suspect, gone=suspect.gone + 1)

    def _stands(self, suspect: Suspect) -> bool:
        frames = suspect.there + suspect.gone
        return suspect.there >= max(self.config.frames, self.config.share * frames)


def _about_to_be_removed(mask: Mask, keyframe: Keyframe, border_px: int) -> Removed:
    """What a mask (H, W), widened, covers of a keyframe that is not masked yet."""
    keypoints = covered(mask, keyframe.features.image_pixels, -border_px)
    free = keypoints[~keyframe.masked[keypoints]]
    return Removed(keyframe.id, free, PackedMask.of(mask))


def _same(a: Removed, b: Removed) -> bool:
    return a.keyframe_id == b.keyframe_id
