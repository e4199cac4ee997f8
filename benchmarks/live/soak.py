"""The live loop for an hour at a camera's rate: latency, memory, descriptors and map over time.

    python -m benchmarks.live.soak SEQUENCE... [--minutes 60] [--hz 30] [--picture F] [--table F]

Each sequence is played forward and backward, one after the other and again from the first, in real
time: what there is no time for is dropped. Between two of another place tracking is lost, and a
map segment begins or the place is recognised, so that the map grows. All of them have one camera.
Memory is that of each process's own (anonymous) pages.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.live.session import PARTS, own_mb
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.play import PlayOptions, play
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts, paced
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.sequences import Sequence, open_sequence
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig

SAMPLES = 120
"""Points of the curves."""


@dataclass(frozen=True)
class Sample:
    """The state at a moment; latencies are of the frames since the sample before."""

    minutes: float
    latency_ms_median: float
    latency_ms_99: float
    tracking_mb: float
    map_mb: float
    tracking_descriptors: int
    map_descriptors: int
    threads: int
    keyframes: int
    landmarks: int
    dropped: int
    lost: int


PANELS = (
    ("latency, ms", ("latency_ms_median", "latency_ms_99")),
    ("memory, MB", ("tracking_mb", "map_mb")),
    ("descriptors", ("tracking_descriptors", "map_descriptors")),
    ("keyframes", ("keyframes",)),
)


class Rounds(MeasuredSource):
    """Sequences that are played forward and backward again and again, at the rate of a camera."""

    name = "rounds"
    waits = False

    def __init__(
        self, sequences: list[Sequence], frames: int, hz: float, watch: Callable[[], None]
    ):
        self.camera = sequences[0].camera
        self.groundtruth: Trajectory | None = None
        self.counts = SourceCounts()
        self._sequences, self._frames, self._hz, self._watch = sequences, frames, hz, watch

    def frames(self) -> Iterator[Frame]:
        """Each frame when it is due, with the stamp that the camera would give it."""
        return paced(self._unpaced())

    def close(self) -> None:
        """Nothing to close."""

    def _unpaced(self) -> Iterator[Frame]:
        order = []
        for sequence in self._sequences:
            there = range(len(sequence))
            order += [(sequence, index) for index in (*there, *reversed(there))]
        for k in range(self._frames):
            sequence, index = order[k % len(order)]
            self._watch()
            yield replace(sequence.load(index), index=k, timestamp_s=k / self._hz)


def descriptors(pid: int | str) -> int:
    """Number of open descriptors of a process."""
    return len(os.listdir(f"/proc/{pid}/fd"))


class Sampler:
    """Notes the state of a live loop at equal intervals.

    Attributes:
        samples: so far.
    """

    def __init__(self, slam: LiveSlam, every_s: float) -> None:
        self.samples: list[Sample] = []
        self._slam, self._every_s, self._seen = slam, every_s, 0
        self._begin_s = time.monotonic()

    def watch(self) -> None:
        """Take a sample if it is due and there are frames for it."""
        elapsed_s = time.monotonic() - self._begin_s
        latencies_ms = self._slam._meter.latencies_ms[self._seen :]
        if elapsed_s < self._every_s * (len(self.samples) + 1) or not latencies_ms:
            return
        self._seen += len(latencies_ms)
        median, high = np.percentile(latencies_ms, (50, 99))
        pid, health = self._slam.processes()["map"], self._slam.health()
        self.samples.append(
            Sample(
                elapsed_s / 60,
                float(median),
                float(high),
                *(own_mb("self"), own_mb(pid)),
                *(descriptors("self"), descriptors(pid), len(os.listdir("/proc/self/task"))),
                *(health.keyframes, health.landmarks, health.frames_dropped, health.lost_frames),
            )
        )


def print_table(samples: list[Sample]) -> None:
    """Some of the samples, and how memory and descriptors change in the second half."""
    titles = ("minutes", "median ms", "99 % ms", "tracking MB", "map MB", "descriptors", "threads")
    print(
        "".join(f"{title:>13}" for title in (*titles, "keyframes", "landmarks", "dropped", "lost"))
    )
    for index in np.unique(np.linspace(0, len(samples) - 1, PARTS + 1).round().astype(int)):
        s = samples[index]
        cells: tuple[object, ...] = (f"{s.minutes:.1f}", f"{s.latency_ms_median:.1f}")
        cells += (f"{s.latency_ms_99:.1f}", f"{s.tracking_mb:.0f}", f"{s.map_mb:.0f}")
        cells += (f"{s.tracking_descriptors} + {s.map_descriptors}", s.threads)
        cells += (s.keyframes, s.landmarks, s.dropped, s.lost)
        print("".join(f"{cell:>13}" for cell in cells))
    later = samples[len(samples) // 2 :]
    minutes = np.array([s.minutes for s in later])
    for name in ("tracking_mb", "map_mb", "tracking_descriptors", "map_descriptors"):
        values = np.array([getattr(s, name) for s in later], float)
        slope = np.polyfit(minutes, values, 1)[0] if len(later) > 1 else 0.0
        print(f"second half, {name}: {60 * slope:+.1f} an hour")


def draw(samples: list[Sample], path: Path) -> None:
    """The curves over time, one panel a quantity."""
    figure = Figure(figsize=(7.0, 7.5), dpi=120, layout="constrained")
    for axes, (title, names) in zip(figure.subplots(len(PANELS), sharex=True), PANELS, strict=True):
        for name in names:
            axes.plot([s.minutes for s in samples], [getattr(s, name) for s in samples], label=name)
        axes.set_ylabel(title)
        axes.set_ylim(bottom=0)
        axes.legend(fontsize="small")
    axes.set_xlabel("minutes")
    figure.savefig(path)


def main() -> None:
    """Print the table, and write picture and samples where they are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--hz", type=float, default=30.0)
    parser.add_argument("--segmenter", default="none")
    parser.add_argument("--picture", type=Path, help="the curves, .png or .svg")
    parser.add_argument("--table", type=Path, help="all samples, .csv")
    arguments = parser.parse_args()
    sequences = [open_sequence(path) for path in arguments.sequences]
    config = SystemConfig()
    chosen = SegmenterOptions(arguments.segmenter)
    config = replace(config, semantics=replace(config.semantics, segmenter=chosen))
    frames = int(60 * arguments.minutes * arguments.hz)
    with tempfile.TemporaryDirectory() as scratch:
        options = LiveOptions(Path(scratch) / "run")
        with LiveSlam(sequences[0].camera, config, options) as slam:
            sampler = Sampler(slam, 60 * arguments.minutes / SAMPLES)
            rounds = Rounds(sequences, frames, arguments.hz, sampler.watch)
            play(slam, rounds, PlayOptions(realtime=True, quiet=True))
            health = slam.health()
    print_table(sampler.samples)
    shares = f"{health.frames_dropped} dropped, {health.lost_frames} lost"
    print(f"{frames} frames: {health.frames} tracked, {shares}, {health.map_deaths} crashes")
    if arguments.picture:
        draw(sampler.samples, arguments.picture)
    if arguments.table:
        with arguments.table.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(asdict(sampler.samples[0])))
            writer.writeheader()
            writer.writerows(map(asdict, sampler.samples))


if __name__ == "__main__":
    main()
