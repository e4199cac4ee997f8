"""What the last keyframes, or frames, saw of space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graph.array_file import Arrays
from graph.geometry import Array
from slam.depth_regions import MovingSpace
from slam.landmarks import Mask
from slam.mapper import Mapper
from slam.static_check import DepthView


@dataclass(frozen=True, eq=False)
class RememberedView:
    """The depth that a frame saw, and when; ``view`` is without what moved, ``seen`` with it.

    Its pose is ``T_keyframe_camera`` (4, 4) from a keyframe, which is mostly itself.
    """

    keyframe_id: int
    timestamp_s: float
    view: DepthView
    seen: DepthView
    T_keyframe_camera: Array


class PosedView(NamedTuple):
    """A remembered view, ``T_world_camera`` (4, 4)."""

    keyframe_id: int
    timestamp_s: float
    view: DepthView
    seen: DepthView
    T_world_camera: Array


THINNED = 2
"""Of a view that is remembered every second pixel each way is kept."""


class ViewMemory:
    """The depth of the last ``count`` keyframes, or frames, at least ``interval_s`` apart."""

    def __init__(self, count: int, interval_s: float) -> None:
        self.count, self.interval_s = count, interval_s
        self.views: list[RememberedView] = []

    def add(
        self,
        keyframe_id: int,
        timestamp_s: float,
        view: DepthView,
        moving: MovingSpace | None = None,
        T_keyframe_camera: Array | None = None,
    ) -> None:
        """Remember what a keyframe saw, or a frame at a pose (4, 4) from it; of what moved nothing.

        It is not remembered if the last is too recent.
        """
        if self.views and abs(timestamp_s - self.views[-1].timestamp_s) < self.interval_s:
            return
        seen = view.thinned(THINNED)
        told = seen.thinned(1)
        if moving is not None:
            _forget(told, moving.covers(told.nearest_m, told.step))
        pose = np.eye(4) if T_keyframe_camera is None else T_keyframe_camera
        self.views.append(RememberedView(keyframe_id, timestamp_s, told, seen, pose))
        del self.views[: -self.count]

    def posed(self, segment: int, mapper: Mapper) -> list[PosedView]:
        """What is remembered of a map segment, with poses as optimised since."""
        found = []
        for kept in self.views:
            heir_id, T_heir_keyframe = mapper.history.heir(kept.keyframe_id)
            heir = mapper.world.keyframes.get(heir_id)
            if heir is not None and heir.segment == segment:
                pose = heir.T_world_camera @ T_heir_keyframe @ kept.T_keyframe_camera
                when = kept.keyframe_id, kept.timestamp_s
                found.append(PosedView(*when, kept.view, kept.seen, pose))
        return found

    def forget_space(self, keyframe_id: int, covered: Mask) -> None:
        """A keyframe's view says nothing about space where something (H, W) moved."""
        for kept in self._of(keyframe_id):
            _forget(kept.view, _thinned_to(kept.view, covered))

    def recall_space(self, keyframe_id: int, covered: Mask) -> None:
        """A keyframe's view says all it saw where something (H, W) stood after all."""
        for kept in self._of(keyframe_id):
            where = _thinned_to(kept.view, covered)
            kept.view.nearest_m[where] = kept.seen.nearest_m[where]
            kept.view.farthest_m[where] = kept.seen.farthest_m[where]

    def clear(self) -> None:
        """Forget all: another recording."""
        self.views = []

    def state(self) -> Arrays:
        """All views as named arrays."""
        views = [(v.view, v.seen) for v in self.views]
        near = [[v.nearest_m, s.nearest_m] for v, s in views]
        far = [[v.farthest_m, s.farthest_m] for v, s in views]
        return {
            "keyframe_ids": np.array([v.keyframe_id for v in self.views], np.int64),
            "timestamps_s": np.array([v.timestamp_s for v in self.views], float),
            "T_keyframe_camera": np.array([v.T_keyframe_camera for v in self.views], float).ravel(),
            "step": np.array([v.view.step for v in self.views], np.int64),
            "shape": np.array([n[0].shape for n in near[:1]], np.int64).ravel(),
            "nearest_m": np.array(near, np.float32).ravel(),
            "farthest_m": np.array(far, np.float32).ravel(),
        }

    def restore(self, state: Arrays) -> None:
        """Become the memory of a state."""
        ids, shape = state["keyframe_ids"].tolist(), state["shape"].tolist() or [0, 0]
        depths = (state[k].reshape(len(ids), 2, *shape) for k in ("nearest_m", "farthest_m"))
        stamps_s, steps = state["timestamps_s"].tolist(), state["step"].tolist()
        poses = state["T_keyframe_camera"].reshape(len(ids), 4, 4).copy()
        self.views = []
        for i, t, n, f, s, T in zip(ids, stamps_s, *depths, steps, poses, strict=True):
            view, seen = (DepthView(n[k].copy(), f[k].copy(), s) for k in (0, 1))
            self.views.append(RememberedView(i, t, view, seen, T))

    def _of(self, keyframe_id: int) -> list[RememberedView]:
        return [kept for kept in self.views if kept.keyframe_id == keyframe_id]


def _thinned_to(view: DepthView, mask: Mask) -> Mask:
    """A mask (H, W) at a view's pixels."""
    height, width = view.nearest_m.shape
    return mask[:: view.step, :: view.step][:height, :width]


def _forget(view: DepthView, where: Mask) -> None:
    """Let a view say nothing at some of its pixels (h, w)."""
    view.nearest_m[where] = view.farthest_m[where] = 0.0
