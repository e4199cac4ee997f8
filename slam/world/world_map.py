"""The map that the front end tracks against: keyframes, landmarks, observations."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.features.patch_alignment import SubpixelConfig, cut_patches
from bmask_slam.graph.arrays import Array, Arrays, Ints, distinct
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.files.disk_arrays import DiskRecords
from bmask_slam.graph.geometry import step_lengths, transform
from bmask_slam.world.keyframe import CulledKeyframe, Keyframe
from bmask_slam.world.landmark_table import LandmarkTable, ends_of_chains
from bmask_slam.world.observers import Observers

MAX_CULLED, MIN_SEGMENT_SHARE = 500, 0.05
_COLUMNS = [f.name for f in fields(Features) if f.name != "gray"]


@dataclass
class WorldMap:
    """Keyframes by id, in the order they were made, and the landmark table; methods change them.

    Attributes:
        culled: the keyframes that were culled last. label_views: number of label views ever made.
        changed: ids of keyframes whose observations changed; who sends them to the graph clears it.
    """

    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    landmarks: LandmarkTable = field(default_factory=LandmarkTable)
    next_keyframe_id: int = 0
    culled: dict[int, CulledKeyframe] = field(default_factory=dict)
    label_views: int = 0
    changed: set[int] = field(default_factory=set, repr=False, compare=False)
    _observers: Observers = field(default_factory=Observers, repr=False, compare=False)
    _disk: DiskRecords = field(default_factory=DiskRecords, repr=False, compare=False)

    def __post_init__(self) -> None:
        for keyframe in self.keyframes.values():
            self._index(keyframe)

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Add a keyframe; its id must be ``next_keyframe_id``."""
        self.keyframes[keyframe.id] = keyframe
        self.next_keyframe_id = keyframe.id + 1
        self._index(keyframe)

    def set_keyframes(self, keyframes: dict[int, Keyframe]) -> None:
        """Replace all keyframes; those with an id that is there already are the same objects."""
        for k in self.keyframes.keys() - keyframes.keys():
            self._unindex(self.keyframes[k])
        for k in sorted(keyframes.keys() - self.keyframes.keys()):
            self._index(keyframes[k])
        self.keyframes = keyframes

    def observe(self, keyframe: Keyframe, keypoints: Ints, landmark_ids: Ints | int) -> None:
        """Record that keypoints (N,) of a keyframe observe landmarks (N,), -1 for none.

        That is all: what the map knows of the landmarks stays, see ``attach`` and ``detach``.
        """
        before = keyframe.landmark_ids[keypoints]
        self._observers.remove(keyframe.id, before[before >= 0])
        keyframe.landmark_ids[keypoints] = landmark_ids
        now = keyframe.landmark_ids[keypoints]
        self._observers.add(keyframe.id, now[now >= 0])
        keyframe.revision += 1
        self.changed.add(keyframe.id)

    def observing(self, landmark_ids: Ints) -> list[Keyframe]:
        """The keyframes that observe any of these landmarks, oldest first."""
        found = distinct(self._observers.of(distinct(landmark_ids)))
        return [self.keyframes[k] for k in found.tolist()]

    def _index(self, keyframe: Keyframe) -> None:
        self._observers.add(keyframe.id, keyframe.landmark_ids[keyframe.landmark_ids >= 0])
        self.changed.add(keyframe.id)

    def _unindex(self, keyframe: Keyframe) -> None:
        self._observers.remove(keyframe.id, keyframe.landmark_ids[keyframe.landmark_ids >= 0])
        self.changed.discard(keyframe.id)

    def store_features(self, keyframe: Keyframe) -> None:
        """Move a keyframe's features to the disk, without their grey image."""
        arrays = self._disk.stored({name: getattr(keyframe.features, name) for name in _COLUMNS})
        keyframe.features = Features(**arrays, gray=np.zeros((0, 0), np.uint8))

    def release_memory(self) -> None:
        """Give back the memory of what was read from the disk since the last call."""
        self._disk.release()
        self.landmarks.release_memory()

    def in_segment(self, segment: int) -> list[Keyframe]:
        """The keyframes of one map segment, oldest first."""
        return [k for k in self.keyframes.values() if k.segment == segment]

    def is_alone(self, keyframe: Keyframe) -> bool:
        """Whether a keyframe is the only one of its map segment."""
        return self.in_segment(keyframe.segment) == [keyframe]

    def largest_segment(self) -> int:
        """The mapped segment with most keyframes, any if none is; the older of equal ones."""
        counts, mapped = Counter(k.segment for k in self.keyframes.values()), self.mapped_segments()
        return max(counts, key=lambda s: (s in mapped, counts[s], -s), default=0)

    def mapped_segments(self) -> set[int]:
        """Those with landmarks; one with less than this share of the richest one's is a remnant."""
        found = self._segments(np.flatnonzero(self.landmarks.in_map))
        return {s for s, count in found.items() if count >= MIN_SEGMENT_SHARE * max(found.values())}

    def segment_of(self, landmark_ids: Ints) -> int:
        """The segment whose keyframes made most of these landmarks."""
        found = self._segments(landmark_ids)
        return max(found, key=lambda segment: (found[segment], -segment))

    def _segments(self, landmark_ids: Ints) -> Counter[int]:
        """How many landmarks the keyframes of each segment made."""
        hosts, counts = np.unique(self.landmarks.host[landmark_ids], return_counts=True)
        found: Counter[int] = Counter()
        for host, count in zip(hosts.tolist(), counts.tolist(), strict=True):
            if host in self.keyframes:
                found[self.keyframes[host].segment] += count
        return found

    def travelled(self) -> tuple[Ints, Array]:
        """Ids (K,) of all keyframes, ascending, and (K, 2) radians and metres of path up to each.

        The path goes straight from keyframe to keyframe.
        """
        ids = np.fromiter(self.keyframes, np.int64)
        poses = np.array([k.T_world_camera for k in self.keyframes.values()])
        steps = step_lengths(poses[:-1], poses[1:])
        return ids, np.cumsum(np.concatenate([np.zeros((1, 2)), steps]), axis=0)

    def observed(self, keyframe: Keyframe) -> tuple[Ints, Ints]:
        """Keypoint indices and ids of the landmarks in the map that a keyframe observes."""
        keypoints = np.flatnonzero(keyframe.landmark_ids >= 0)
        keypoints = keypoints[self.landmarks.in_map[keyframe.landmark_ids[keypoints]]]
        return keypoints, keyframe.landmark_ids[keypoints]

    def make_landmarks(
        self, keyframe: Keyframe, keypoints: Ints, points_world: Array, ids: Ints | None = None
    ) -> Ints:
        """Make landmarks at points (N, 3) that keypoints (N,) observe: see `LandmarkTable.add`."""
        colours = keyframe.features.colours[keypoints]
        host = np.full(len(keypoints), keyframe.id)
        columns: Arrays = {"points_world": points_world, "colours": colours, "host": host}
        ids = self.landmarks.add(columns, ids)
        self.attach(keyframe, keypoints[ids >= 0], ids[ids >= 0])
        return ids

    def attach(self, keyframe: Keyframe, keypoints: Ints, landmark_ids: Ints) -> None:
        """Record that keypoints (N,) of a keyframe observe landmarks (N,), and refresh these.

        Masked keypoints are skipped.
        """
        usable = ~keyframe.masked[keypoints]
        keypoints, landmark_ids = keypoints[usable], landmark_ids[usable]
        self.observe(keyframe, keypoints, landmark_ids)
        self.landmarks.observations[landmark_ids] += 1
        self._refresh(keyframe, keypoints, landmark_ids)

    def mask(self, keyframe: Keyframe, keypoints: Ints) -> None:
        """Keypoints (N,) of a keyframe lie on what moves: they observe nothing until ``unmask``."""
        keyframe.masked[keypoints] = True
        self.detach(keyframe, keypoints)

    def unmask(self, keyframe: Keyframe, keypoints: Ints) -> None:
        """Record that keypoints (N,) of a keyframe lie on something static."""
        keyframe.masked[keypoints] = False
        keyframe.revision += 1

    def detach(self, keyframe: Keyframe, keypoints: Ints) -> None:
        """Record that keypoints (N,) of a keyframe observe nothing.

        Landmarks whose appearance was from here get it from the newest keyframe that is left.
        """
        landmarks, ids = self.landmarks, keyframe.landmark_ids[keypoints]
        self.observe(keyframe, keypoints, -1)
        keyframe.sent_ids[keypoints] = -1
        ids = landmarks.remaining(ids)
        landmarks.observations[ids] -= 1
        stale = ids[landmarks.last_keyframe[ids] == keyframe.id]
        landmarks.last_keyframe[stale] = -1
        landmarks.patch_views[stale] = np.nan
        for other in self.observing(stale):
            rows = np.flatnonzero(np.isin(other.landmark_ids, stale))
            self._refresh(other, rows, other.landmark_ids[rows])

    def split(self, landmark_ids: Ints, keyframes: list[Keyframe], camera: Camera) -> Ints:
        """Undo a wrong fusion: what these keyframes observe becomes new landmarks.

        Each is placed where the first of the keyframes that measures its depth observes it; if none
        does, its observations are dropped. Returns the new ids.
        """
        twin = np.full(len(self.landmarks) + 1, -1, np.int64)
        for keyframe in keyframes:
            rows = np.flatnonzero(np.isin(keyframe.landmark_ids, landmark_ids))
            ids = keyframe.landmark_ids[rows]
            self.detach(keyframe, rows)
            known = twin[ids] >= 0
            self.attach(keyframe, rows[known], twin[ids[known]])
            first = ~known & np.isfinite(keyframe.features.depth_m[rows])
            pixels, depth_m = keyframe.features.pixels, keyframe.features.depth_m
            points = camera.backproject(pixels[rows[first]], depth_m[rows[first]])
            points_world = transform(keyframe.T_world_camera, points)
            twin[ids[first]] = self.make_landmarks(keyframe, rows[first], points_world)
        return twin[twin >= 0]

    def mask_landmarks(self, landmark_ids: Ints) -> None:
        """Remove landmarks, and mask the keypoints that observe them."""
        removed = np.zeros(len(self.landmarks) + 1, bool)  # the last entry is for id -1
        removed[landmark_ids] = True
        for keyframe in self.observing(landmark_ids):
            rows = np.flatnonzero(removed[keyframe.landmark_ids])
            keyframe.masked[rows] = True
            self.observe(keyframe, rows, -1)
            keyframe.sent_ids[rows] = -1
        self.landmarks.observations[landmark_ids] = 0
        self.landmarks.remove(landmark_ids)

    def _refresh(self, keyframe: Keyframe, keypoints: Ints, landmark_ids: Ints) -> None:
        """Appearance of landmarks (N,) from keypoints (N,), unless a newer keyframe sees them."""
        landmarks, features = self.landmarks, keyframe.features
        newest = landmarks.last_keyframe[landmark_ids] <= keyframe.id
        ids, rows = landmark_ids[newest], keypoints[newest]
        landmarks.last_keyframe[ids] = keyframe.id
        landmarks.descriptors[ids] = features.descriptors[rows]
        towards = keyframe.T_world_camera[:3, 3] - landmarks.points_world[ids]
        landmarks.directions[ids] = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        z = -towards @ keyframe.T_world_camera[:3, 2]
        landmarks.angles_rad[ids] = features.angles_rad[rows]
        landmarks.extent[ids] = features.scales[rows] * np.maximum(z, 0.05)

    def remove_keyframe(self, keyframe: Keyframe, parent: Keyframe) -> None:
        """Take a keyframe out of the map; the landmarks it made follow the parent from now on."""
        _, ids = self.observed(keyframe)
        self.landmarks.observations[ids] -= 1
        self.landmarks.host[self.landmarks.host == keyframe.id] = parent.id
        self._unindex(keyframe)
        del self.keyframes[keyframe.id]
        pixels = keyframe.features.image_pixels
        self.culled[keyframe.id] = CulledKeyframe(pixels, keyframe.landmark_ids)
        if len(self.culled) > MAX_CULLED:
            del self.culled[next(iter(self.culled))]

    def renew_patches(self, keyframe: Keyframe, config: SubpixelConfig) -> None:
        """Store patches of landmarks that a keyframe sees from a view no patch of theirs covers.

        The new patch replaces the least similar one. Every new patch shifts the landmark's image a
        little; so patches are kept as long as they can be used, and a place that is visited again
        is matched with its first patches.
        """
        landmarks, features = self.landmarks, keyframe.features
        rows, ids = self.observed(keyframe)
        views = keyframe.T_world_camera[:3, 3] - landmarks.points_world[ids]
        apart = landmarks.patch_distances(ids, views, config.limits)
        unlike = np.flatnonzero(apart.min(axis=1) > 1)
        patches = cut_patches(features.gray, features.image_pixels[rows[unlike]])
        landmarks.put_patches(ids[unlike], apart[unlike].argmax(axis=1), patches, views[unlike])

    def covisible(self, landmark_ids: Ints, minimum: int) -> list[tuple[int, Keyframe]]:
        """(shared landmarks, keyframe) of all that share at least a minimum, by falling number.

        The minimum is at least 1; of keyframes that share as many the newest comes first.
        """
        shared = np.bincount(self._observers.of(distinct(landmark_ids)))
        strong = np.flatnonzero(shared >= minimum)[::-1]
        strong = strong[np.argsort(-shared[strong], kind="stable")]
        return [(int(shared[k]), self.keyframes[k]) for k in strong.tolist()]

    def replace_landmarks(self, old_ids: Ints, new_ids: Ints) -> Ints:
        """Fuse duplicates: every observation of old_ids[k] becomes one of new_ids[k].

        Returns the ids removed. A keyframe that observes both keeps the new one's keypoint.
        """
        old, new = ends_of_chains(old_ids, new_ids)
        new_ids = new[np.searchsorted(old, old_ids)]
        involved, present = np.zeros((2, len(self.landmarks) + 1), bool)
        involved[old_ids] = True
        for keyframe in self.observing(old_ids):
            rows = np.flatnonzero(involved[keyframe.landmark_ids])
            targets = new[np.searchsorted(old, keyframe.landmark_ids[rows])]
            present[keyframe.landmark_ids] = True
            occupied = present[targets]
            present[keyframe.landmark_ids] = False
            _, first = np.unique(targets, return_index=True)
            keep = np.zeros(len(targets), bool)
            keep[first] = ~occupied[first]
            self.observe(keyframe, rows[~keep], -1)
            self.attach(keyframe, rows[keep], targets[keep])
        np.add.at(self.landmarks.found, new_ids, self.landmarks.found[old_ids])
        np.add.at(self.landmarks.visible, new_ids, self.landmarks.visible[old_ids])
        self.landmarks.replaced_by[old_ids] = new_ids
        self.landmarks.remove(old_ids)
        return old_ids
