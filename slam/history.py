"""Poses of ordinary frames, kept relative to their reference keyframes and composed at the end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graph.array_file import Arrays
from graph.geometry import Array, inverse
from graph.trajectory import Trajectory
from slam.world_map import WorldMap


@dataclass(frozen=True)
class HistoryEntry:
    """A frame's stamp and its pose as seen from its reference keyframe."""

    timestamp_s: float
    keyframe_id: int
    T_keyframe_camera: Array


class FrameHistory:
    """One entry a tracked frame; a keyframe that is culled hands its frames to another."""

    def __init__(self) -> None:
        self._entries: list[HistoryEntry] = []
        self._parent: dict[int, tuple[int, Array]] = {}

    @property
    def heirs(self) -> dict[int, tuple[int, Array]]:
        """Of every culled keyframe the one that took its frames, and T_heir_culled."""
        return self._parent

    def append(
        self, timestamp_s: float, keyframe_id: int, T_world_keyframe: Array, T_world_camera: Array
    ) -> None:
        """Remember a frame's pose as seen from a keyframe whose current pose is given."""
        T_keyframe_camera = inverse(T_world_keyframe) @ T_world_camera
        self._entries.append(HistoryEntry(timestamp_s, keyframe_id, T_keyframe_camera))

    def since(self, count: int) -> list[HistoryEntry]:
        """What was appended after the first ``count`` frames."""
        return self._entries[count:]

    def extend(self, entries: list[HistoryEntry]) -> None:
        """Append what another history holds of the frames that follow."""
        self._entries += entries

    def hand_over(self, keyframe_id: int, parent_id: int, T_parent_keyframe: Array) -> None:
        """A keyframe leaves the map: its frames follow the parent from now on."""
        self._parent[keyframe_id] = (parent_id, T_parent_keyframe)

    def trajectories(self, world: WorldMap) -> dict[int, Trajectory]:
        """Every tracked frame, by map segment, from the keyframes' current poses."""
        stamps: dict[int, list[float]] = {}
        poses: dict[int, list[Array]] = {}
        for entry in self._entries:
            keyframe_id, T = self._resolve(entry.keyframe_id, entry.T_keyframe_camera)
            keyframe = world.keyframes[keyframe_id]
            stamps.setdefault(keyframe.segment, []).append(entry.timestamp_s)
            poses.setdefault(keyframe.segment, []).append(keyframe.T_world_camera @ T)
        return {
            segment: Trajectory(np.array(stamps[segment]), np.array(poses[segment]))
            for segment in sorted(stamps)
        }

    def heir(self, keyframe_id: int) -> tuple[int, Array]:
        """The keyframe that stands for one now, and T_heir_keyframe; itself if it has no heir."""
        return self._resolve(keyframe_id, np.eye(4))

    def state(self) -> Arrays:
        """All entries, and who inherited whose frames, as arrays."""
        entries, heirs = self._entries, list(self._parent.values())
        return {
            "timestamps_s": np.array([entry.timestamp_s for entry in entries], float),
            "keyframe_ids": np.array([entry.keyframe_id for entry in entries], np.int64),
            "T_keyframe_camera": _stacked([entry.T_keyframe_camera for entry in entries]),
            "culled_ids": np.array(list(self._parent), np.int64),
            "heir_ids": np.array([heir for heir, _ in heirs], np.int64),
            "T_heir_culled": _stacked([T for _, T in heirs]),
        }

    def restore(self, state: Arrays) -> None:
        """Become the history of a state."""
        columns = [state[name] for name in ("timestamps_s", "keyframe_ids", "T_keyframe_camera")]
        rows = zip(columns[0].tolist(), columns[1].tolist(), columns[2], strict=True)
        self._entries = [HistoryEntry(stamp_s, keyframe_id, T) for stamp_s, keyframe_id, T in rows]
        heirs = zip(state["heir_ids"].tolist(), state["T_heir_culled"], strict=True)
        self._parent = dict(zip(state["culled_ids"].tolist(), heirs, strict=True))

    def _resolve(self, keyframe_id: int, T: Array) -> tuple[int, Array]:
        while keyframe_id in self._parent:
            keyframe_id, T_parent_keyframe = self._parent[keyframe_id]
            T = T_parent_keyframe @ T
        return keyframe_id, T


def _stacked(poses: list[Array]) -> Array:
    return np.array(poses, float).reshape(-1, 4, 4)
