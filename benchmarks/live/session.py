"""A long session of the live loop: latency and memory over time.

    python -m benchmarks.live.session SEQUENCE [--minutes 30] [--hz 30]

A rendered sequence is played forward and backward with the stamps of a camera of that rate, without
pauses. Memory is that of each process's own (anonymous) pages, at the end of each
sixth of the session.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bmask_slam.evaluation import evaluate_trajectory
from bmask_slam.graph.trajectory import Trajectory, nearest_indices
from bmask_slam.live.health import Health
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.play import PlayOptions, play
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system_config import SystemConfig

PARTS = 6


def own_mb(pid: int | str) -> float:
    """Anonymous resident memory of a process in MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024


class Tour(MeasuredSource):
    """A sequence played forward and backward, as a source that waits for the loop."""

    name = "tour"
    waits = True

    def __init__(self, sequence: Sequence, frames: int, hz: float, watch: Callable[[int], None]):
        self.camera = sequence.camera
        self.groundtruth: Trajectory | None = None
        self.counts = SourceCounts()
        self.shown: list[tuple[float, int]] = []
        self._sequence, self._frames, self._hz, self._watch = sequence, frames, hz, watch

    def frames(self) -> Iterator[Frame]:
        """Each frame with the stamp that a camera of this rate would give it."""
        there = np.arange(len(self._sequence))
        tour = np.r_[there, there[-2:0:-1]]
        for k in range(self._frames):
            index = int(tour[k % len(tour)])
            self.shown.append((k / self._hz, index))
            self._watch(k)
            yield replace(self._sequence.load(index), index=k, timestamp_s=k / self._hz)

    def close(self) -> None:
        """Nothing to close."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--hz", type=float, default=30.0)
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.sequence)
    frames = int(60 * arguments.minutes * arguments.hz)
    config = SystemConfig()
    semantics = replace(config.semantics, segmenter=SegmenterOptions("none"))
    config = replace(config, semantics=semantics)
    part = frames // PARTS
    rows: list[tuple[Health, float, float, list[float]]] = []
    with LiveSlam(sequence.camera, config, LiveOptions()) as slam:

        def watch(k: int) -> None:
            if (k + 1) % part == 0:
                latencies_ms = slam._meter.latencies_ms[-part:]
                memory = own_mb("self"), own_mb(slam.processes()["map"])
                rows.append((slam.health(), *memory, list(latencies_ms)))

        tour = Tour(sequence, frames, arguments.hz, watch)
        begin_s = time.monotonic()
        play(slam, tour, PlayOptions(realtime=False, quiet=True))
        wall_s = time.monotonic() - begin_s
        trajectory, lost = slam.trajectory(), slam.health().lost_frames
    titles = ("minutes", "median ms", "95 % ms", "tracking MB", "map MB", "keyframes", "landmarks")
    print("".join(f"{title:>13}" for title in titles))
    for number, (health, here, there, latencies_ms) in enumerate(rows, 1):
        median, high = np.percentile(latencies_ms, (50, 95))
        minutes = number * arguments.minutes / PARTS
        cells = (f"{minutes:.0f}", f"{median:.1f}", f"{high:.1f}", f"{here:.0f}", f"{there:.0f}")
        print("".join(f"{cell:>13}" for cell in (*cells, health.keyframes, health.landmarks)))
    assert sequence.groundtruth is not None
    stamps_s, indices = np.array(tour.shown).T
    truth, when_s = sequence.groundtruth, sequence.timestamps_s[indices.astype(int)]
    nearest = nearest_indices(truth.timestamps_s, when_s)
    reference = Trajectory(stamps_s, truth.poses_world_camera[nearest])
    ate_m = evaluate_trajectory(trajectory, reference).value("ate_rmse")
    print(f"{frames} frames in {wall_s:.0f} s, {lost} lost, ATE {1e3 * ate_m:.1f} mm")


if __name__ == "__main__":
    main()
