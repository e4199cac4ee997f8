"""Poses of ordinary frames, kept relative to their reference keyframes and composed at the end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from graphlib import TopologicalSorter

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.files.array_file import split_rows
from bmask_slam.graph.files.disk_arrays import DiskRows
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.trajectory import Trajectory, nearest_indices
from bmask_slam.graph.trajectory_smoothing import smooth
from bmask_slam.world.world_map import WorldMap

ENTRY = np.dtype(
    [
        ("timestamp_s", float),
        ("keyframe_id", np.int64),
        ("T_keyframe_camera", float, (4, 4)),
        ("information", float, (6, 6)),
    ]
)
"""A frame's stamp, its pose as seen from its reference keyframe, and the pose's information.

The information is of ``[rad, m]`` on the right side, NaN where it is unknown.
"""
UNKNOWN = np.full((6, 6), np.nan)
Entries = NDArray[np.void]
NO_KEYFRAME = -1
"""Parent of a keyframe whose pose was lost: its frames have no pose."""


class FrameHistory:
    """One entry for each tracked frame; the frames of a culled keyframe go to its parent."""

    def __init__(self) -> None:
        self._entries = DiskRows(1024, (), ENTRY)
        self._size = 0
        self._counts: Counter[int] = Counter()  # of the frames of each keyframe
        self._parent: dict[int, tuple[int, Array]] = {}

    @property
    def parents(self) -> dict[int, tuple[int, Array]]:
        """Parent of every culled keyframe, and T_parent_culled (4, 4)."""
        return self._parent

    def append(
        self,
        timestamp_s: float,
        keyframe_id: int,
        T_world_keyframe: Array,
        T_world_camera: Array,
        information: Array | None = None,
    ) -> None:
        """Append a frame's pose relative to a keyframe whose current pose is given."""
        T_keyframe_camera = inverse(T_world_keyframe) @ T_world_camera
        known = UNKNOWN if information is None else information
        self.extend(np.array([(timestamp_s, keyframe_id, T_keyframe_camera, known)], ENTRY))

    def since(self, count: int) -> Entries:
        """What was appended after the first ``count`` frames."""
        return self._store[count : self._size].copy()

    def extend(self, entries: Entries) -> None:
        """Append entries of another history."""
        size, capacity = self._size + len(entries), len(self._store)
        if size > capacity:
            self._entries.grow(max(capacity, size - capacity))
        self._entries.write(np.arange(self._size, size), entries)
        self._size = size
        self._counts.update(entries["keyframe_id"].tolist())

    def hand_over(self, keyframe_id: int, parent_id: int, T_parent_keyframe: Array) -> None:
        """A keyframe leaves the map: its frames follow the parent from now on."""
        self._parent[keyframe_id] = (parent_id, T_parent_keyframe)

    def take_back(self, keyframe_ids: Iterable[int]) -> None:
        """These keyframes are in the map, also if they had left it."""
        for keyframe_id in keyframe_ids:
            self._parent.pop(keyframe_id, None)

    def trajectories(self, world: WorldMap) -> dict[int, Trajectory]:
        """Every tracked frame whose keyframe was not lost, by map segment, from current poses."""
        found = {segment: path for segment, _, _, path in self._segments(world)}
        self._entries.release()
        return found

    def largest_segment(self, world: WorldMap) -> int:
        """The mapped segment with most frames, any if none is; the older of equal ones.

        Its frames are trajectory.txt. Without frames it is the one with most keyframes.
        """
        frames, mapped = self.frames(world), world.mapped_segments()
        if not frames:
            return world.largest_segment()
        return max(frames, key=lambda s: (s in mapped, frames[s], -s))

    def frames(self, world: WorldMap) -> Counter[int]:
        """The number of tracked frames whose keyframe was not lost, by map segment."""
        found: Counter[int] = Counter()
        for keyframe_id, count in self._counts.items():
            owner = self._owner(keyframe_id)
            if owner != NO_KEYFRAME:
                found[world.keyframes[owner].segment] += count
        return found

    def smooth(self, world: WorldMap) -> None:
        """Give the frames the poses that the camera's inertia makes the most probable."""
        for _, rows, origins, measured in self._segments(world):
            found = smooth(measured, self._store["information"][rows])
            self._place(rows, inverse(origins) @ found.poses_world_camera)

    def _place(self, rows: Ints, T_keyframe_camera: Array) -> None:
        """Give rows (N,) other poses (N, 4, 4)."""
        entries = self._store[rows]
        entries["T_keyframe_camera"] = T_keyframe_camera
        self._entries.write(rows, entries)

    @property
    def _store(self) -> Entries:
        return self._entries.rows

    def place(self, world: WorldMap, path: Trajectory) -> None:
        """Give the frames that have these stamps these poses T_world_camera."""
        for _, rows, origins, measured in self._segments(world):
            at = nearest_indices(path.timestamps_s, measured.timestamps_s)
            same = np.flatnonzero(path.timestamps_s[at] == measured.timestamps_s)
            found = path.poses_world_camera[at[same]]
            self._place(rows[same], inverse(origins[same]) @ found)

    def _segments(self, world: WorldMap) -> Iterator[tuple[int, Ints, Array, Trajectory]]:
        """Each map segment: its number, rows (N,) of its entries, what these are relative to,
        T_world_keyframe (N, 4, 4), and the poses.
        """
        origins = np.zeros((self._size, 4, 4))
        segments = np.full(self._size, NO_KEYFRAME)
        for keyframe_id, rows in self._by_keyframe():
            owner, T = self._resolve(keyframe_id, np.eye(4))
            if owner != NO_KEYFRAME:
                keyframe = world.keyframes[owner]
                origins[rows], segments[rows] = keyframe.T_world_camera @ T, keyframe.segment
        for segment in np.unique(segments[segments != NO_KEYFRAME]).tolist():
            rows = np.flatnonzero(segments == segment)
            poses = origins[rows] @ self._store["T_keyframe_camera"][rows]
            yield segment, rows, origins[rows], Trajectory(self._store["timestamp_s"][rows], poses)

    def path(self, world: WorldMap, segment: int, begin_s: float, end_s: float) -> Trajectory:
        """The frames of a segment from one time to another, with one on either side."""
        stamps_s = self._store["timestamp_s"][: self._size]
        begin = int(np.searchsorted(stamps_s, begin_s, side="right")) - 1
        begin = max(min(begin, self._size - 2), 0)
        end = max(int(np.searchsorted(stamps_s, end_s, side="left")) + 1, begin + 2)
        found_s, poses = [], []
        for entry in self._store[: self._size][begin:end]:
            owner, T = self._resolve(int(entry["keyframe_id"]), entry["T_keyframe_camera"])
            if owner != NO_KEYFRAME and world.keyframes[owner].segment == segment:
                found_s.append(float(entry["timestamp_s"]))
                poses.append(world.keyframes[owner].T_world_camera @ T)
        return Trajectory(np.array(found_s), _stacked(poses))

    def without_map(self) -> list[Trajectory]:
        """The frames of each keyframe whose pose was lost, in that keyframe's frame."""
        entries = self._store[: self._size]
        return [
            Trajectory(entries["timestamp_s"][rows], entries["T_keyframe_camera"][rows])
            for keyframe_id, rows in self._by_keyframe()
            if self._owner(keyframe_id) == NO_KEYFRAME
        ]

    def _by_keyframe(self) -> Iterator[tuple[int, Ints]]:
        """Each keyframe that has entries, and their rows in order."""
        ids, which = np.unique(self._store["keyframe_id"][: self._size], return_inverse=True)
        order = np.argsort(which, kind="stable")
        groups = split_rows(order, np.bincount(which, minlength=len(ids)))
        return zip(ids.tolist(), groups, strict=True)

    def parent(self, keyframe_id: int) -> tuple[int, Array]:
        """The keyframe of the map that replaces one, or NO_KEYFRAME, and T_parent_keyframe (4, 4).

        A keyframe that was not culled is its own parent.
        """
        return self._resolve(keyframe_id, np.eye(4))

    def state(self) -> Arrays:
        """All entries, and the parents of culled keyframes, as arrays."""
        entries, parents = self._store[: self._size], list(self._parent.values())
        return {
            "timestamps_s": entries["timestamp_s"].copy(),
            "keyframe_ids": entries["keyframe_id"].copy(),
            "T_keyframe_camera": entries["T_keyframe_camera"].copy(),
            "information": entries["information"].copy(),
            "culled_ids": np.array(list(self._parent), np.int64),
            "heir_ids": np.array([parent for parent, _ in parents], np.int64),
            "T_heir_culled": _stacked([T for _, T in parents]),
        }

    def restore(self, state: Arrays) -> None:
        """Become the history of a state. Raises ValueError for keyframes in a circle."""
        self._size, size = 0, len(state["timestamps_s"])
        self._counts.clear()
        if len(state["information"]) != size:  # of a file that was written without
            state = {**state, "information": np.broadcast_to(UNKNOWN, (size, 6, 6))}
        entries = np.zeros(size, ENTRY)
        columns = ("timestamps_s", "keyframe_ids", "T_keyframe_camera", "information")
        for name, column in zip(ENTRY.names or (), columns, strict=True):
            entries[name] = state[column]
        self.extend(entries)
        parents = zip(state["heir_ids"].tolist(), state["T_heir_culled"], strict=True)
        self._parent = dict(zip(state["culled_ids"].tolist(), parents, strict=True))
        TopologicalSorter({k: (parent,) for k, (parent, _) in self._parent.items()}).prepare()

    def _owner(self, keyframe_id: int) -> int:
        """The keyframe that replaces one, or NO_KEYFRAME."""
        while keyframe_id in self._parent:
            keyframe_id, _ = self._parent[keyframe_id]
        return keyframe_id

    def _resolve(self, keyframe_id: int, T: Array) -> tuple[int, Array]:
        """The keyframe that replaces one, and poses T (..., 4, 4) relative to it."""
        while keyframe_id in self._parent:
            keyframe_id, T_parent_keyframe = self._parent[keyframe_id]
            T = T_parent_keyframe @ T
        return keyframe_id, T


def _stacked(poses: list[Array]) -> Array:
    return np.array(poses, float).reshape(-1, 4, 4)
