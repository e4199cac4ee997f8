"""What tracked frames that are no keyframes observe, kept for the last adjustment of a run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Arrays, Floats, Ints
from bmask_slam.graph.files.array_file import split_rows

MAX_FRAMES = 2000
"""About 12 MB; of a longer run every second, fourth, ... frame is kept."""


@dataclass(frozen=True, eq=False)
class FrameView:
    """What one frame observes.

    Attributes:
        timestamp_s: its stamp.
        landmark_ids: (N,) inliers of tracking.
        columns: (N, 8) the keypoints' pixels, places in the image as it is (px), depth in metres
            (NaN without), and standard deviations of u, v and disparity (px).
    """

    timestamp_s: float
    landmark_ids: Ints
    columns: Floats

    def features(self, bf_px_m: float) -> Features:
        """The keypoints, without what they look like."""
        count, values = len(self.columns), self.columns.astype(float)
        return Features(
            pixels=values[:, :2],
            image_pixels=values[:, 2:4],
            descriptors=np.zeros((count, 0), np.uint64),
            scales=np.ones(count),
            angles_rad=np.zeros(count),
            depth_m=values[:, 4],
            disparity_px=bf_px_m / values[:, 4],
            sigmas_px=values[:, 5:],
            colours=np.zeros((count, 0), np.uint8),
            gray=np.zeros((0, 0), np.uint8),
        )

    def seen_as(self, features: Features) -> FrameView:
        """The same landmarks, observed by these features (N)."""
        return replace(self, columns=_columns(features))


class FrameObservations:
    """The views of at most ``MAX_FRAMES`` frames, evenly spread over a run.

    Attributes:
        views: in the order of their stamps.
    """

    def __init__(self) -> None:
        self.views: list[FrameView] = []
        self._offered, self._every = 0, 1

    def append(
        self, timestamp_s: float, features: Features, keypoints: Ints, landmark_ids: Ints
    ) -> None:
        """Add a frame whose ``keypoints`` (N,) observe landmarks (N,)."""
        self._offered += 1
        if self._offered % self._every:
            return
        columns = _columns(features)[keypoints]
        self.views.append(FrameView(timestamp_s, landmark_ids.copy(), columns))
        if len(self.views) > MAX_FRAMES:
            self._every *= 2
            del self.views[::2]

    def clear(self) -> None:
        """Forget all frames."""
        self.views, self._offered, self._every = [], 0, 1

    def state(self) -> Arrays:
        """All views as arrays."""
        ids, columns = np.zeros(0, np.int64), np.zeros((0, 8), np.float32)
        return {
            "timestamps_s": np.array([view.timestamp_s for view in self.views], float),
            "counts": np.array([len(view.landmark_ids) for view in self.views], np.int64),
            "landmark_ids": np.concatenate([ids, *(view.landmark_ids for view in self.views)]),
            "columns": np.concatenate([columns, *(view.columns for view in self.views)]),
            "kept": np.array([self._offered, self._every]),
        }

    def restore(self, state: Arrays) -> None:
        """Become what a state was made of. Raises ValueError for lengths that do not agree."""
        parts = (split_rows(state[name], state["counts"]) for name in ("landmark_ids", "columns"))
        stamps = state["timestamps_s"].tolist()
        self.views = [FrameView(*view) for view in zip(stamps, *parts, strict=True)]
        self._offered, self._every = int(state["kept"][0]), max(int(state["kept"][1]), 1)


def _columns(features: Features) -> Floats:
    parts = features.pixels, features.image_pixels, features.depth_m, features.sigmas_px
    return np.column_stack(parts).astype(np.float32)
