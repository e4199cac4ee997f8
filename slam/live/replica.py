"""A copy of the map in another process, kept up to date by differences.

The map's owner runs in its own process, and tracking needs the whole map for every frame. So the
owner sends a ``WorldDelta`` after each change: every keyframe's pose, and of points, descriptors,
patches and observations those that changed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bmask_slam.back_end.landmark_management import create_landmarks
from bmask_slam.features.brisk import Features
from bmask_slam.features.patch_alignment import SubpixelConfig
from bmask_slam.graph.arrays import Array, Arrays, Bits, Bytes, Ints, Mask, digest_rows
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import carried_along, inverse, transform
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.landmark_table import LandmarkTable
from bmask_slam.world.world_map import WorldMap

COLUMNS = (
    *("descriptors", "directions", "extent", "angles_rad", "patches", "patch_views"),
    *("colours", "host", "last_keyframe", "observations"),
)
"""Columns of the landmark table that are sent whenever they change."""
COUNTED = ("visible", "found")
"""Columns that are sent with a landmark that is new; then the copy counts them itself."""


@dataclass(frozen=True, eq=False)
class KeyframeRow:
    """A keyframe's observations (N,), if they changed; features only if the copy has none."""

    landmark_ids: Ints
    masked: Mask
    frame_index: int
    timestamp_s: float
    features: Features | None


@dataclass(frozen=True, eq=False)
class WorldDelta:
    """What changed in a map since the last delta.

    Attributes:
        size: number of landmarks ever made.
        in_map: (size,) flags as packed bits.
        moved: (A,) valid landmarks that are new or have another position.
        points_world: (A, 3) of these.
        ids: (R,) valid landmarks of which another column changed.
        columns: the rows of these, by the name of the column.
        replaced_by: (size,) of all landmarks if any was fused, else None.
        next_keyframe_id, label_views: of the map.
        keyframe_ids: (K,) of all keyframes.
        poses: (K, 4, 4) T_world_camera.
        segments: (K,) map segments.
        rows: observations of the keyframes where they changed, by id.
        parents: new parents of culled keyframes, as the arguments of ``FrameHistory.hand_over``.
    """

    size: int
    in_map: Bytes
    moved: Ints
    points_world: Array
    ids: Ints
    columns: Arrays
    replaced_by: Ints | None
    next_keyframe_id: int
    label_views: int
    keyframe_ids: Ints
    poses: Array
    segments: Ints
    rows: dict[int, KeyframeRow]
    parents: dict[int, tuple[int, Array]]


@dataclass
class _Sent:
    """What the copy has of landmarks (N,) and keyframes; points are digests."""

    in_map: Mask = field(default_factory=lambda: np.zeros(0, bool))
    points: Bits = field(default_factory=lambda: np.zeros(0, np.uint64))
    host: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    observations: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    appearance: int = 0  # revision
    fused: int = 0
    keyframes: dict[int, int] = field(default_factory=dict)  # revisions
    parents: set[int] = field(default_factory=set)


class DeltaMaker:
    """Makes deltas relative to what was sent before."""

    def __init__(self) -> None:
        self._sent = _Sent()
        self._features: set[int] = set()

    def mark_features_known(self, keyframe_id: int) -> None:
        """Do not send the features of this keyframe: the copy has made it itself."""
        self._features.add(keyframe_id)

    def delta(self, world: WorldMap, history: FrameHistory) -> WorldDelta:
        """What changed since the last call; the whole map at the first."""
        table, keyframes = world.landmarks, list(world.keyframes.values())
        moved, ids = self._changed_landmarks(world)
        fused = int(np.count_nonzero(table.replaced_by >= 0))
        replaced_by = table.replaced_by.copy() if fused != self._sent.fused else None
        self._sent.fused = fused
        for culled in self._sent.keyframes.keys() - world.keyframes.keys():
            del self._sent.keyframes[culled]
        return WorldDelta(
            size=len(table),
            in_map=np.packbits(table.in_map),
            moved=moved,
            points_world=table.points_world[moved],
            ids=ids,
            columns={name: getattr(table, name)[ids] for name in (*COLUMNS, *COUNTED)},
            replaced_by=replaced_by,
            next_keyframe_id=world.next_keyframe_id,
            label_views=world.label_views,
            keyframe_ids=np.array([k.id for k in keyframes], np.int64),
            poses=np.array([k.T_world_camera for k in keyframes], float).reshape(-1, 4, 4),
            segments=np.array([k.segment for k in keyframes], np.int64),
            rows={k.id: self._row(k) for k in keyframes if self._has_changed(k)},
            parents=self._new_parents(history),
        )

    def _changed_landmarks(self, world: WorldMap) -> tuple[Ints, Ints]:
        """Valid landmarks that moved, and those of which another column changed."""
        table, sent = world.landmarks, self._sent
        fresh = table.in_map.copy()
        fresh[: len(sent.in_map)] &= ~sent.in_map[: len(fresh)]
        moved, changed = fresh.copy(), fresh
        valid = np.flatnonzero(table.in_map)
        points = np.zeros(len(table), np.uint64)
        points[valid] = digest_rows([table.points_world[valid]])
        written, sent.appearance = table.written_since(sent.appearance)
        known = np.flatnonzero(table.in_map & ~fresh)
        moved[known] = points[known] != sent.points[known]
        changed[known] = written[known] | (table.host[known] != sent.host[known])
        changed[known] |= table.observations[known] != sent.observations[known]
        sent.in_map, sent.points = table.in_map.copy(), points
        sent.host, sent.observations = table.host.copy(), table.observations.copy()
        return np.flatnonzero(moved), np.flatnonzero(changed)

    def _has_changed(self, keyframe: Keyframe) -> bool:
        return self._sent.keyframes.get(keyframe.id) != keyframe.revision

    def _row(self, keyframe: Keyframe) -> KeyframeRow:
        ids, masked = keyframe.landmark_ids.copy(), keyframe.masked.copy()
        self._sent.keyframes[keyframe.id] = keyframe.revision
        features = None if keyframe.id in self._features else keyframe.features
        self._features.add(keyframe.id)
        return KeyframeRow(ids, masked, keyframe.frame_index, keyframe.timestamp_s, features)

    def _new_parents(self, history: FrameHistory) -> dict[int, tuple[int, Array]]:
        fresh = {k: parent for k, parent in history.parents.items() if k not in self._sent.parents}
        self._sent.parents |= fresh.keys()
        return fresh


class UntoldCounts:
    """How often frames saw the landmarks of a copy (N,) since the map's owner was told."""

    def __init__(self, anew: bool) -> None:
        """``anew``: what was told is not kept, and a landmark that is new has no counts yet."""
        self._anew = anew
        self._told = np.zeros((2, 0), np.int32)

    def take(self, landmarks: LandmarkTable) -> tuple[Ints, Ints, Ints]:
        """Ids (V,), frames in whose view they were, and in which they were found; to be told."""
        told = self._known(landmarks)
        visible, found = landmarks.visible - told[0], landmarks.found - told[1]
        ids = np.flatnonzero(visible)
        self.are_known(ids, landmarks)
        return ids, visible[ids], found[ids]

    def are_known(self, ids: Ints, landmarks: LandmarkTable) -> None:
        """The owner knows the counts of landmarks (N,) as they are."""
        if self._anew:
            landmarks.visible[ids] = landmarks.found[ids] = 0
        self._known(landmarks)[:, ids] = landmarks.visible[ids], landmarks.found[ids]

    def _known(self, landmarks: LandmarkTable) -> NDArray[np.int32]:
        """The counts (2, N) that the owner knows."""
        more = max(len(landmarks) - self._told.shape[1], 0)
        self._told = np.pad(self._told, ((0, 0), (0, more))) if more else self._told
        return self._told[:, : len(landmarks)]


def landmarks_ahead(
    world: WorldMap, keyframe: Keyframe, camera: Camera, subpixel: SubpixelConfig
) -> tuple[Ints, tuple[int, int]]:
    """Make landmarks of a new keyframe in a copy, to be tracked before the owner has made them.

    The keyframe does not observe them yet. Returns their ids, -1 for none, by keypoint (N,), and
    the ids that are reserved: the first, and what follows the last. These are as many as there are
    keypoints without a landmark, since the owner needs some of its own.
    """
    table = world.landmarks
    first = len(table)
    reserved = first, first + int(np.count_nonzero(keyframe.free))
    ids = create_landmarks(world, keyframe, camera)
    table.reserve(*reserved, ids)
    world.renew_patches(keyframe, subpixel)
    new_ids = np.where(keyframe.landmark_ids >= first, keyframe.landmark_ids, -1)
    world.observe(keyframe, np.flatnonzero(new_ids >= 0), -1)
    return new_ids, reserved


def apply_delta(delta: WorldDelta, world: WorldMap, history: FrameHistory) -> Ints:
    """Make a copy of the map equal to its owner's; returns the landmarks that it did not have.

    Keyframes that the owner has not received yet stay, with the landmarks that were made of them
    ahead, and keep their pose relative to the newest keyframe that both have. An owner that was
    restarted from an older state may have fewer keyframes, which are then such, and fewer landmarks
    that it has made itself, which then stay as ones that are not in the map. It may also have
    keyframes that had been culled.
    """
    ahead, new = _apply_landmarks(delta, world)
    pending = [k for k in world.keyframes.values() if k.id >= delta.next_keyframe_id]
    shared = [i for i in delta.keyframe_ids.tolist() if i in world.keyframes]
    poses = dict(zip(delta.keyframe_ids.tolist(), delta.poses, strict=True))
    if pending and shared:
        T_old, T_new = world.keyframes[shared[-1]].T_world_camera, poses[shared[-1]]
        for keyframe in pending:
            keyframe.T_world_camera = carried_along(keyframe.T_world_camera, T_old, T_new)
        points_world = world.landmarks.points_world
        points_world[ahead] = transform(T_new @ inverse(T_old), points_world[ahead])
    segments = dict(zip(delta.keyframe_ids.tolist(), delta.segments.tolist(), strict=True))
    kept = {i: _keyframe(i, delta, world) for i in poses}
    for i, keyframe in kept.items():
        keyframe.T_world_camera, keyframe.segment = poses[i], segments[i]
    world.set_keyframes(kept | {k.id: k for k in pending})
    world.next_keyframe_id = max(world.next_keyframe_id, delta.next_keyframe_id)
    world.label_views = max(world.label_views, delta.label_views)
    history.take_back(kept)
    for keyframe_id, (parent, T_parent_culled) in delta.parents.items():
        history.hand_over(keyframe_id, parent, T_parent_culled)
    return new


def _apply_landmarks(delta: WorldDelta, world: WorldMap) -> tuple[Ints, Ints]:
    """Returns the landmarks of keyframes that the owner has not received yet, and its new ones."""
    table = world.landmarks
    table.extend_to(max(delta.size, len(table)))
    in_map = table.in_map & (table.host >= delta.next_keyframe_id)
    in_map[: delta.size] = in_map[table.spare] = False  # spare ids are the owner's
    ahead, had = np.flatnonzero(in_map), table.in_map[delta.ids]
    in_map[: delta.size] = np.unpackbits(delta.in_map, count=delta.size)
    table.set_in_map(in_map)
    table.points_world[delta.moved] = delta.points_world
    new = np.flatnonzero(~had)
    for name, rows in delta.columns.items():
        chosen = new if name in COUNTED else slice(None)
        getattr(table, name)[delta.ids[chosen]] = rows[chosen]
    if delta.replaced_by is not None:
        table.replaced_by[: delta.size] = delta.replaced_by
        table.replaced_by[delta.size :] = -1
    return ahead, delta.ids[new]


def _keyframe(keyframe_id: int, delta: WorldDelta, world: WorldMap) -> Keyframe:
    """The copy's keyframe with the owner's observations; made if the copy has none."""
    keyframe, row = world.keyframes.get(keyframe_id), delta.rows.get(keyframe_id)
    if keyframe is None:
        assert row is not None and row.features is not None, "a delta of another map"
        keyframe = Keyframe(
            id=keyframe_id,
            frame_index=row.frame_index,
            timestamp_s=row.timestamp_s,
            segment=0,
            T_world_camera=np.eye(4),
            features=row.features,
            landmark_ids=row.landmark_ids,
        )
        world.store_features(keyframe)
    if row is not None:
        rows = np.flatnonzero(keyframe.landmark_ids != row.landmark_ids)
        world.observe(keyframe, rows, row.landmark_ids[rows])
        keyframe.masked = row.masked
    return keyframe
