"""Frames that are segmented though they are no keyframes.

The map needs no keyframe where it is known already; labels need views of it, and what walks in is
found by masks. So a frame is segmented as well where the image has moved on since the last one that
was, or some time has passed. Map and graph do not change by it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, no_ids
from bmask_slam.graph.files.array_file import split_rows
from bmask_slam.graph.geometry import inverse
from bmask_slam.labelling.awaited_masks import kept_depth
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.keyframe import Keyframe

FIRST_LABEL_VIEW = 1 << 40
"""Label views are numbered from here on, so that no keyframe has the same number."""
MAX_VIEWS = 200
"""Label views that are kept: their masks come late, and vote on landmarks that are made later."""
MAX_RESENT = 20
"""Messages of label views that a new process of the map gets again."""
MIN_COMMON = 10
"""An image has moved on if it has fewer landmarks in common with the other."""
_NEVER = -np.inf
_NO_DEPTH = np.zeros((0, 0), np.float32)


def described(number: int) -> str:
    """What has this number: a keyframe or a label view."""
    if number < FIRST_LABEL_VIEW:
        return f"keyframe {number}"
    return f"label view {number - FIRST_LABEL_VIEW}"


def forget_old_views(journal: dict[int, Any], newest: Any) -> None:
    """Drop what concerns label views, but the last of it, from messages that may be sent again.

    In a known room no keyframe comes, after which the map would be saved and they be dropped. With
    depth images and masks they would fill the memory; labels do without.
    """
    if not _concerns_view(newest):
        return
    numbers = [number for number, message in journal.items() if _concerns_view(message)]
    for number in numbers[:-MAX_RESENT]:
        del journal[number]


def _concerns_view(message: Any) -> bool:
    number = message.number if isinstance(message, LabelView) else 0
    return bool(getattr(message, "keyframe_id", number) >= FIRST_LABEL_VIEW)


@dataclass(frozen=True)
class LabelViewConfig:
    """When a frame that is no keyframe is segmented.

    ``min_interval_s`` after the last segmented frame at the earliest, if since then the image has
    moved by ``moved_share`` of its width, and ``max_interval_s`` after it in any case. With a
    ``max_interval_s`` of 0 keyframes alone are segmented.
    """

    min_interval_s: float = 0.2
    max_interval_s: float = 1.0
    moved_share: float = 0.05

    def __post_init__(self) -> None:
        if self.min_interval_s < 0 or self.max_interval_s < 0 or self.moved_share < 0:
            raise ValueError("min_interval_s, max_interval_s and moved_share must not be negative")


@dataclass(frozen=True, eq=False)
class LabelView:
    """A frame that is segmented and is no keyframe.

    Attributes:
        number: in place of a keyframe's id.
        timestamp_s: of the frame.
        parent_id, T_parent_camera: a keyframe, and the frame's pose (4, 4) relative to it.
        image_pixels, landmark_ids: (N, 2) as detected, and (N,), of the landmarks that it shows.
        depth_m: (h, w) its ``kept_depth``, until it waits for its masks.
    """

    number: int
    timestamp_s: float
    parent_id: int
    T_parent_camera: Array
    image_pixels: Array
    landmark_ids: Ints
    depth_m: Floats

    @classmethod
    def of(cls, number: int, frame: Frame, tracked: Tracked, parent: Keyframe) -> LabelView:
        """A frame at the pose that it was tracked at."""
        return cls(
            number,
            frame.timestamp_s,
            parent.id,
            inverse(parent.T_world_camera) @ tracked.T_world_camera,
            tracked.features.image_pixels[tracked.keypoints],
            tracked.landmark_ids,
            kept_depth(frame.depth_m),
        )


class LabelViews(dict[int, LabelView]):
    """The last label views, by their numbers, without depths."""

    def add(self, view: LabelView) -> None:
        """Add one, without its depth; the oldest is dropped if there are too many."""
        self[view.number] = replace(view, depth_m=_NO_DEPTH)
        if len(self) > MAX_VIEWS:
            del self[next(iter(self))]

    def state(self) -> Arrays:
        """All of them, as named arrays."""
        views = list(self.values())
        return {
            "numbers": np.array(list(self), np.int64),
            "stamps_s": np.array([v.timestamp_s for v in views], float),
            "parents": np.array([v.parent_id for v in views], np.int64),
            "T_parent_camera": np.array([v.T_parent_camera for v in views], float).ravel(),
            "sizes": np.array([len(v.landmark_ids) for v in views], np.int64),
            "pixels": np.concatenate([np.zeros((0, 2)), *(v.image_pixels for v in views)]),
            "landmark_ids": np.concatenate([no_ids(), *(v.landmark_ids for v in views)]),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state; there is nothing yet."""
        poses = state["T_parent_camera"].reshape(-1, 4, 4)
        rows = (split_rows(state[name], state["sizes"]) for name in ("pixels", "landmark_ids"))
        scalars = (state[name].tolist() for name in ("numbers", "stamps_s", "parents"))
        for number, stamp_s, parent_id, T, pixels, ids in zip(*scalars, poses, *rows, strict=True):
            self.add(LabelView(number, stamp_s, parent_id, T, pixels, ids, _NO_DEPTH))


class LabelViewDecision:
    """Decides which frames are label views, by the last frame that was segmented."""

    def __init__(self, config: LabelViewConfig, width: int) -> None:
        self.config, self._width = config, width
        self.forget()

    def forget(self) -> None:
        """Nothing was segmented yet."""
        self.segmented(_NEVER, no_ids(), np.zeros((0, 2)))

    def segmented(self, timestamp_s: float, landmark_ids: Ints, image_pixels: Array) -> None:
        """A frame is segmented that has landmarks (N,) at pixels (N, 2)."""
        self._last_s, self._ids, self._pixels = timestamp_s, landmark_ids, image_pixels

    def decide(self, timestamp_s: float, tracked: Tracked) -> bool:
        """Whether a tracked frame is to be segmented, which it then is."""
        config, since_s = self.config, timestamp_s - self._last_s
        off = config.max_interval_s == 0 or not tracked.status.by_image
        if off or since_s < config.min_interval_s:
            return False
        pixels = tracked.features.image_pixels[tracked.keypoints]
        if since_s < config.max_interval_s and not self._has_moved(tracked.landmark_ids, pixels):
            return False
        self.segmented(timestamp_s, tracked.landmark_ids, pixels)
        return True

    def _has_moved(self, landmark_ids: Ints, pixels: Array) -> bool:
        _, now, then = np.intersect1d(landmark_ids, self._ids, return_indices=True)
        if len(now) < MIN_COMMON:
            return True
        moved_px = np.linalg.norm(pixels[now] - self._pixels[then], axis=1)
        return bool(np.median(moved_px) >= self.config.moved_share * self._width)

    def state(self) -> Arrays:
        """The last frame that was segmented, as named arrays."""
        return {
            "last_s": np.array(self._last_s),
            "landmark_ids": self._ids,
            "pixels": self._pixels,
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self.segmented(float(state["last_s"]), state["landmark_ids"], state["pixels"])
