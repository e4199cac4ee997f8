"""What tracked frames that are no keyframes observe, kept for the last adjustment of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints
from bmask_slam.graph.files.array_file import split_rows

MAX_FRAMES = 2000
"""About 10 MB; of a longer run every second, fourth, ... frame is kept."""


@dataclass(frozen=True, eq=False)
class FrameView:
    """What one frame observes.

    Attributes:
        timestamp_s: its stamp.
        landmark_ids: (N,) inliers of tracking.
        measurements: (N, 3) u_left, v, u_right in undistorted pixels; u_right NaN without depth.
        sigmas_px: (N, 3) standard deviations of u, v and disparity.
    """

    timestamp_s: float
    landmark_ids: Ints
    measurements: Floats
    sigmas_px: Floats


class FrameObservations:
    """The views of at most ``MAX_FRAMES`` frames, evenly spread over a run."""

    def __init__(self) -> None:
        self._views: list[FrameView] = []
        self._offered, self._every = 0, 1

    @property
    def views(self) -> list[FrameView]:
        """In the order of their stamps."""
        return self._views

    def append(
        self, timestamp_s: float, landmark_ids: Ints, measurements: Array, sigmas_px: Array
    ) -> None:
        """Add a frame's view: columns of ``FrameView``. It is copied."""
        self._offered += 1
        if self._offered % self._every:
            return
        columns = measurements.astype(np.float32), sigmas_px.astype(np.float32)
        self._views.append(FrameView(timestamp_s, landmark_ids.copy(), *columns))
        if len(self._views) > MAX_FRAMES:
            self._every *= 2
            del self._views[::2]

    def clear(self) -> None:
        """Forget all frames."""
        self.__init__()  # type: ignore[misc]

    def state(self) -> Arrays:
        """All views as arrays."""
        views, none = self._views, np.zeros((0, 3), np.float32)
        return {
            "timestamps_s": np.array([view.timestamp_s for view in views], float),
            "counts": np.array([len(view.landmark_ids) for view in views], np.int64),
            "landmark_ids": np.concatenate(
                [none[:, 0].astype(np.int64), *(view.landmark_ids for view in views)]
            ),
            "measurements": np.concatenate([none, *(view.measurements for view in views)]),
            "sigmas_px": np.concatenate([none, *(view.sigmas_px for view in views)]),
            "kept": np.array([self._offered, self._every]),
        }

    def restore(self, state: Arrays) -> None:
        """Become what a state was made of. Raises ValueError for lengths that do not agree."""
        names = "landmark_ids", "measurements", "sigmas_px"
        columns = (split_rows(state[name], state["counts"]) for name in names)
        stamps = state["timestamps_s"].tolist()
        self._views = [FrameView(*view) for view in zip(stamps, *columns, strict=True)]
        self._offered, self._every = (max(int(n), 1) for n in state["kept"])
