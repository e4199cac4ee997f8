"""How the live loop is doing: what a monitor asks for, as numbers by name."""

from __future__ import annotations

import json
import time
from collections import deque
from dataclasses import asdict, dataclass, field

import numpy as np

from bmask_slam.tracking.results import FrameResult, TrackingStatus

WINDOW = 120
"""Frames over which rates and delays are taken."""


@dataclass(frozen=True)
class Health:
    """The state of the loop over the last frames.

    Attributes:
        status: of the last frame.
        frames: tracked so far. frames_per_second: of the last frames.
        latency_ms_median, latency_ms_p95: from handing a frame in until its result.
        keyframes, landmarks, loops_closed: in the map.
        submaps: in the dense map.
        keyframes_waiting: for the map's process. masks_waiting: for the segmenter's.
        submaps_waiting: for the dense map's.
        frames_dropped: by the source, since tracking was busy.
        frames_refused: that were broken, or not later than the one before.
        masks_dropped: keyframes that were passed over by the segmenter.
        submaps_dropped: keyframes that were passed over by the dense map.
        unwritten: how often a full disk kept something from being written.
        lost_frames: without a pose. lost_episodes: how often tracking was lost.
        map_deaths, segmenter_deaths, dense_deaths: of their processes, which were started again.
        source: what the source counted, by name.
    """

    status: str = ""
    frames: int = 0
    frames_per_second: float = 0.0
    latency_ms_median: float = 0.0
    latency_ms_p95: float = 0.0
    keyframes: int = 0
    landmarks: int = 0
    loops_closed: int = 0
    submaps: int = 0
    keyframes_waiting: int = 0
    masks_waiting: int = 0
    submaps_waiting: int = 0
    frames_dropped: int = 0
    frames_refused: int = 0
    masks_dropped: int = 0
    submaps_dropped: int = 0
    unwritten: int = 0
    lost_frames: int = 0
    lost_episodes: int = 0
    map_deaths: int = 0
    segmenter_deaths: int = 0
    dense_deaths: int = 0
    source: dict[str, int] = field(default_factory=dict)

    def as_json(self) -> str:
        """For a file that another program polls."""
        return json.dumps(asdict(self), indent=1) + "\n"

    def line(self) -> str:
        """For a person."""
        waiting = f"{self.keyframes_waiting} keyframes and {self.masks_waiting} masks waiting"
        if self.submaps or self.submaps_waiting:
            waiting += f", {self.submaps} submaps, {self.submaps_waiting} waiting"
        if self.submaps_dropped:
            waiting += f" and {self.submaps_dropped} dropped"
        full = ", DISK FULL" if self.unwritten else ""
        return (
            f"{self.status}{full}, {self.frames_per_second:.0f} frames/s, "
            f"{self.latency_ms_median:.0f} ms, {self.keyframes} keyframes, {waiting}, "
            f"{self.frames_dropped} frames dropped"
        )


class FrameMeter:
    """Counts frames as their results come."""

    def __init__(self) -> None:
        self.frames = self.lost_frames = self.lost_episodes = 0
        self.status = ""
        self.latencies_ms: list[float] = []
        self._ends_s: deque[float] = deque(maxlen=WINDOW)

    def count(self, result: FrameResult, latency_ms: float) -> None:
        """One more frame, and how long it took."""
        is_lost = result.status is TrackingStatus.LOST
        self.lost_episodes += is_lost and self.status != TrackingStatus.LOST.value
        self.lost_frames += is_lost
        self.frames += 1
        self.status = result.status.value
        self.latencies_ms.append(latency_ms)
        self._ends_s.append(time.monotonic())

    def percentiles_ms(self, last: int | None = None) -> tuple[float, float]:
        """Median and 95th percentile of the latency, of all frames or the last ones."""
        chosen = self.latencies_ms if last is None else self.latencies_ms[-last:]
        if not chosen:
            return 0.0, 0.0
        median, high = np.percentile(chosen, (50, 95))
        return float(median), float(high)

    @property
    def frames_per_second(self) -> float:
        """Of the last frames."""
        if len(self._ends_s) < 2:
            return 0.0
        return (len(self._ends_s) - 1) / max(self._ends_s[-1] - self._ends_s[0], 1e-9)
