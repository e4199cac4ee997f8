"""The state of the live loop as numbers by name, for a monitoring program."""

from __future__ import annotations

import json
import time
from array import array
from collections import deque
from dataclasses import asdict, dataclass, field

import numpy as np

from bmask_slam.live.sources.source import SourceCounts
from bmask_slam.live.system import LiveSystem
from bmask_slam.tracking.results import FrameResult, TrackingStatus

WINDOW = 120
"""Number of last frames of which rates and latencies are computed."""


@dataclass(frozen=True)
class Health:
    """The state of the live loop; rates and latencies are those of the last ``WINDOW`` frames.

    Attributes:
        status: tracking status of the last frame.
        frames: tracked so far.
        frames_per_second: rate of the last frames.
        latency_ms_median, latency_ms_p95: from handing a frame in to its result.
        keyframes, landmarks, loops_closed: in the map.
        submaps: in the dense map.
        surface_frames: in its surface besides keyframes.
        keyframes_waiting: for the map's process.
        masks_waiting: images that wait for the segmenter's process.
        submaps_waiting: keyframes that wait for the dense map's process.
        frames_dropped: by the source, because tracking was busy.
        frames_refused: that were broken, or not later than the one before.
        masks_dropped: images that the segmenter skipped.
        submaps_dropped: keyframes that the dense map skipped.
        surface_frames_dropped: that were due for the surface while it was behind.
        unwritten: how often something could not be written, as on a full disk.
        lost_frames: without a pose.
        lost_episodes: how often tracking was lost.
        map_deaths, segmenter_deaths, dense_deaths: how often these processes died or hung and were
            started again.
        workstation: "connected", "away" while it cannot be reached, "" for none.
        workstation_losses: how often it was lost.
        workstation_sent_bytes, workstation_received_bytes: what went there and came from there.
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
    surface_frames: int = 0
    keyframes_waiting: int = 0
    masks_waiting: int = 0
    submaps_waiting: int = 0
    frames_dropped: int = 0
    frames_refused: int = 0
    masks_dropped: int = 0
    submaps_dropped: int = 0
    surface_frames_dropped: int = 0
    unwritten: int = 0
    lost_frames: int = 0
    lost_episodes: int = 0
    map_deaths: int = 0
    segmenter_deaths: int = 0
    dense_deaths: int = 0
    workstation: str = ""
    workstation_losses: int = 0
    workstation_sent_bytes: int = 0
    workstation_received_bytes: int = 0
    source: dict[str, int] = field(default_factory=dict)

    def as_json(self) -> str:
        """The contents of health.json, which another program may poll."""
        return json.dumps(asdict(self), indent=1) + "\n"

    def line(self) -> str:
        """A summary in one line, for the console."""
        waiting = f"{self.keyframes_waiting} keyframes and {self.masks_waiting} masks waiting"
        if self.submaps or self.submaps_waiting:
            waiting += f", {self.submaps} submaps, {self.submaps_waiting} waiting"
        if self.submaps_dropped:
            waiting += f" and {self.submaps_dropped} dropped"
        full = ", DISK FULL" if self.unwritten else ""
        full += ", WORKSTATION AWAY" if self.workstation == "away" else ""
        return (
            f"{self.status}{full}, {self.frames_per_second:.0f} frames/s, "
            f"{self.latency_ms_median:.0f} ms, {self.keyframes} keyframes, {waiting}, "
            f"{self.frames_dropped} frames dropped"
        )


class FrameMeter:
    """Counts frames and measures their latencies.

    Attributes:
        frames: tracked.
        refused: frames that ``check_frame`` refused.
        lost_frames, lost_episodes, status: as in ``Health``.
        latencies_ms: of all frames.
    """

    def __init__(self) -> None:
        self.frames = self.refused = self.lost_frames = self.lost_episodes = 0
        self.status = ""
        self.latencies_ms: array[float] = array("d")
        self._ends_s: deque[float] = deque(maxlen=WINDOW)

    def count(self, result: FrameResult, latency_ms: float) -> None:
        """Count a frame."""
        is_lost = result.status is TrackingStatus.LOST
        self.lost_episodes += is_lost and self.status != TrackingStatus.LOST.value
        self.lost_frames += is_lost
        self.frames += 1
        self.status = result.status.value
        self.latencies_ms.append(latency_ms)
        self._ends_s.append(time.monotonic())

    def percentiles_ms(self, last: int | None = None) -> tuple[float, float]:
        """Median and 95th percentile of the latencies, of all frames or only the ``last`` ones."""
        chosen = self.latencies_ms if last is None else self.latencies_ms[-last:]
        if not chosen:
            return 0.0, 0.0
        median, high = np.percentile(chosen, (50, 95))
        return float(median), float(high)

    @property
    def frames_per_second(self) -> float:
        """Rate of the last ``WINDOW`` frames."""
        if len(self._ends_s) < 2:
            return 0.0
        return (len(self._ends_s) - 1) / max(self._ends_s[-1] - self._ends_s[0], 1e-9)


def measure_health(
    system: LiveSystem, meter: FrameMeter, source: SourceCounts, dropped: int, unwritten: int
) -> Health:
    """The state of the live loop.

    Args:
        source: what the source counted.
        dropped: frames that the source dropped.
        unwritten: frames and files of the run folder that could not be written.
    """
    median_ms, p95_ms = meter.percentiles_ms(WINDOW)
    segmenter, remote, dense = system.segmenter, system.remote, system.dense
    return Health(
        status=meter.status,
        frames=meter.frames,
        frames_per_second=meter.frames_per_second,
        latency_ms_median=median_ms,
        latency_ms_p95=p95_ms,
        keyframes=len(remote.world.keyframes),
        landmarks=int(remote.world.landmarks.in_map.sum()),
        loops_closed=remote.loops_closed,
        submaps=len(dense.submaps) if dense else 0,
        surface_frames=dense.frames.integrated if dense else 0,
        keyframes_waiting=remote.pending,
        masks_waiting=segmenter.waiting if segmenter else 0,
        submaps_waiting=dense.waiting if dense else 0,
        frames_dropped=dropped,
        frames_refused=meter.refused,
        masks_dropped=segmenter.dropped if segmenter else 0,
        submaps_dropped=dense.dropped if dense else 0,
        surface_frames_dropped=dense.frames.dropped if dense else 0,
        unwritten=unwritten + (dense.unwritten + dense.frames.unwritten if dense else 0),
        lost_frames=meter.lost_frames,
        lost_episodes=meter.lost_episodes,
        map_deaths=remote.worker.crashes,
        segmenter_deaths=segmenter.worker.crashes if segmenter else 0,
        dense_deaths=dense.worker.crashes if dense else 0,
        **remote.worker.workstation_health(),
        source=asdict(source),
    )
