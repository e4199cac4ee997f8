"""The depth views of the last keyframes, or frames, with their poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Mask
from bmask_slam.moving.depth_segments import MovingSpace
from bmask_slam.moving.free_space_check import DepthView
from bmask_slam.world.map_editor import MapReader


@dataclass(frozen=True, eq=False)
class BufferedView:
    """The depth view of a frame: ``full`` as recorded, ``view`` without moving parts.

    Its pose is ``T_keyframe_camera`` (4, 4) relative to a keyframe, which is mostly itself.
    """

    keyframe_id: int
    timestamp_s: float
    view: DepthView
    full: DepthView
    T_keyframe_camera: Array


class PosedView(NamedTuple):
    """A buffered view with its pose ``T_world_camera`` (4, 4)."""

    keyframe_id: int
    timestamp_s: float
    view: DepthView
    full: DepthView
    T_world_camera: Array


THINNED = 2
"""Every second pixel of a view in each direction is kept."""


class DepthViewBuffer:
    """Depth views of the last ``count`` keyframes, or frames, at least ``interval_s`` apart."""

    def __init__(self, count: int, interval_s: float) -> None:
        self.count, self.interval_s = count, interval_s
        self.views: list[BufferedView] = []

    def add(
        self,
        keyframe_id: int,
        timestamp_s: float,
        view: DepthView,
        moving: MovingSpace | None = None,
        T_keyframe_camera: Array | None = None,
    ) -> None:
        """Add the view of a keyframe, or of a frame at a pose (4, 4) relative to it.

        Where something moved the view is cleared. Nothing is added if the last view is too recent.
        """
        if self.views and abs(timestamp_s - self.views[-1].timestamp_s) < self.interval_s:
            return
        full = view.thinned(THINNED)
        thin = full.thinned(1)
        if moving is not None:
            _clear(thin, moving.covers(thin.nearest_m, thin.step))
        pose = np.eye(4) if T_keyframe_camera is None else T_keyframe_camera
        self.views.append(BufferedView(keyframe_id, timestamp_s, thin, full, pose))
        del self.views[: -self.count]

    def posed(self, segment: int, map_reader: MapReader) -> list[PosedView]:
        """The views of a map segment, at their present poses."""
        found = []
        for kept in self.views:
            parent_id, T_parent_keyframe = map_reader.history.parent(kept.keyframe_id)
            parent = map_reader.world.keyframes.get(parent_id)
            if parent is not None and parent.segment == segment:
                pose = parent.T_world_camera @ T_parent_keyframe @ kept.T_keyframe_camera
                found.append(
                    PosedView(kept.keyframe_id, kept.timestamp_s, kept.view, kept.full, pose)
                )
        return found

    def clear_depth(self, keyframe_id: int, covered: Mask) -> None:
        """Clear a keyframe's view where a mask (H, W) shows something that moved."""
        for kept in self._of(keyframe_id):
            _clear(kept.view, _thinned_to(kept.view, covered))

    def restore_depth(self, keyframe_id: int, covered: Mask) -> None:
        """Restore a keyframe's view where a mask (H, W) shows something static."""
        for kept in self._of(keyframe_id):
            where = _thinned_to(kept.view, covered)
            kept.view.nearest_m[where] = kept.full.nearest_m[where]
            kept.view.farthest_m[where] = kept.full.farthest_m[where]

    def clear(self) -> None:
        """Remove all views: another recording begins."""
        self.views = []

    def state(self) -> Arrays:
        """All views as named arrays; of ``view`` only where it is not cleared."""
        views = self.views
        speak = [(v.view.nearest_m != 0) | (v.view.farthest_m != 0) for v in views]
        return {
            "keyframe_ids": np.array([v.keyframe_id for v in views], np.int64),
            "timestamps_s": np.array([v.timestamp_s for v in views], float),
            "T_keyframe_camera": np.array([v.T_keyframe_camera for v in views], float).ravel(),
            "step": np.array([v.view.step for v in views], np.int64),
            "shape": np.array([s.shape for s in speak[:1]], np.int64).ravel(),
            "speak": np.packbits(np.array(speak, bool)),
            "nearest_m": np.array([v.full.nearest_m for v in views], np.float32).ravel(),
            "farthest_m": np.array([v.full.farthest_m for v in views], np.float32).ravel(),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        ids = state["keyframe_ids"].tolist()
        size = len(ids), *(state["shape"].tolist() or [0, 0])
        stamps_s, steps = state["timestamps_s"].tolist(), state["step"].tolist()
        poses = state["T_keyframe_camera"].reshape(len(ids), 4, 4).copy()
        if not 0 <= math.prod(size) <= 8 * state["speak"].size:
            raise ValueError(f"fewer bits than {size}")
        known_pixels = np.unpackbits(state["speak"], count=np.prod(size)).reshape(size).astype(bool)
        depths = (state[name].reshape(size) for name in ("nearest_m", "farthest_m"))
        self.views = []
        for i, stamp_s, T, step, known, near, far in zip(
            ids, stamps_s, poses, steps, known_pixels, *depths, strict=True
        ):
            full = DepthView(near.copy(), far.copy(), step)
            view = full.thinned(1)
            _clear(view, ~known)
            self.views.append(BufferedView(i, stamp_s, view, full, T))

    def _of(self, keyframe_id: int) -> list[BufferedView]:
        return [kept for kept in self.views if kept.keyframe_id == keyframe_id]


def _thinned_to(view: DepthView, mask: Mask) -> Mask:
    """A mask (H, W) at a view's pixels."""
    height, width = view.nearest_m.shape
    return mask[:: view.step, :: view.step][:height, :width]


def _clear(view: DepthView, where: Mask) -> None:
    """Clear a view at some of its pixels (h, w)."""
    view.nearest_m[where] = view.farthest_m[where] = 0.0
