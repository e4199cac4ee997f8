"""Poses of ordinary frames, kept relative to their reference keyframes and composed at the end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graph.geometry import Array, inverse
from graph.trajectory import Trajectory
from slam.world_map import WorldMap


@dataclass(frozen=True)
class _Entry:
    timestamp_s: float
    keyframe_id: int
    T_keyframe_camera: Array


class FrameHistory:
    """One entry a tracked frame; a keyframe that is culled hands its frames to another."""

    def __init__(self) -> None:
        self._entries: list[_Entry] = []
        self._parent: dict[int, tuple[int, Array]] = {}

    def append(
        self, timestamp_s: float, keyframe_id: int, T_world_keyframe: Array, T_world_camera: Array
    ) -> None:
        """Remember a frame's pose as seen from a keyframe whose current pose is given."""
        T_keyframe_camera = inverse(T_world_keyframe) @ T_world_camera
        self._entries.append(_Entry(timestamp_s, keyframe_id, T_keyframe_camera))

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

    def _resolve(self, keyframe_id: int, T: Array) -> tuple[int, Array]:
        while keyframe_id in self._parent:
            keyframe_id, T_parent_keyframe = self._parent[keyframe_id]
            T = T_parent_keyframe @ T
        return keyframe_id, T
