"""The live loop for an hour at a camera's rate: latency, memory, descriptors and map over time.

    python -m benchmarks.live.soak SEQUENCE... [--minutes 60] [--hz 30] [--wait] [--picture F]
        [--table F]

Each sequence is played forward and backward, one after the other and again from the first, in real
time: what there is no time for is dropped. Between two of another place tracking is lost, and a
map segment begins or the place is recognised, so that the map grows in the first round. All of them
have one camera. Memory is that of each process's own (anonymous) pages.

Processor time tells a loop that does too much from a machine that is too slow: a drop counts as the
machine's where all cores were taken and other programs had a part of them. ``--wait`` drops
nothing: the source waits for the loop, and the curves show the growth on any machine.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.live.session import PARTS, Rounds
from benchmarks.machine import own_mb
from bmask_slam.config.configuration import resolve
from bmask_slam.live.health import Health
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.play import PlayOptions, play
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.system_config import SystemConfig

SAMPLES = 120
"""Points of the curves."""
TICKS = os.sysconf("SC_CLK_TCK")
BUSY, OTHERS = 0.9, 0.05
"""Shares of the machine: it is full from the first on; others matter from the second on."""


@dataclass(frozen=True)
class Sample:
    """The state at a moment.

    Times are of the frames since the sample before; ``tracking_cpu_ms`` and ``map_cpu_ms`` are
    processor time a frame of the thread that tracks and of the map's process. ``busy`` and
    ``others`` are the shares of the machine that all programs and other programs took.
    """

    minutes: float
    latency_ms_median: float
    latency_ms_99: float
    tracking_cpu_ms: float
    map_cpu_ms: float
    busy: float
    others: float
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
    ("processor, ms/frame", ("tracking_cpu_ms", "map_cpu_ms")),
    ("of the machine", ("busy", "others")),
    ("memory, MB", ("tracking_mb", "map_mb")),
    ("keyframes", ("keyframes",)),
    ("dropped, lost", ("dropped", "lost")),
)
COLUMNS = {
    "minutes": ".1f",
    "latency_ms_median": ".1f",
    "latency_ms_99": ".1f",
    "tracking_cpu_ms": ".1f",
    "map_cpu_ms": ".1f",
    "others": ".0%",
    "tracking_mb": ".0f",
    "map_mb": ".0f",
    "keyframes": "d",
    "landmarks": "d",
    "dropped": "d",
    "lost": "d",
}
"""Of the printed table."""
CURVES = (
    *("latency_ms_median", "tracking_cpu_ms", "map_cpu_ms", "tracking_mb", "map_mb"),
    *("tracking_descriptors", "map_descriptors", "keyframes", "landmarks"),
)
"""Whose slope is printed."""


def descriptors(pid: int | str) -> int:
    """Number of open descriptors of a process."""
    return len(os.listdir(f"/proc/{pid}/fd"))


@dataclass(frozen=True)
class ProcessorTime:
    """Processor time so far in seconds; ``idle`` and ``all`` are of all cores together."""

    tracking: float
    map: float
    own: float
    idle: float
    all: float

    @classmethod
    def now(cls, tracking_clock: int, map_pid: int) -> ProcessorTime:
        """Of the thread with this clock, of a process, of both processes and of the machine."""
        fields = Path(f"/proc/{map_pid}/stat").read_text().rpartition(")")[2].split()
        map_s = (int(fields[11]) + int(fields[12])) / TICKS
        ticks = [int(n) for n in Path("/proc/stat").read_text().split("\n")[0].split()[1:9]]
        own_s = map_s + time.process_time()
        tracking_s = time.clock_gettime(tracking_clock)
        return cls(tracking_s, map_s, own_s, (ticks[3] + ticks[4]) / TICKS, sum(ticks) / TICKS)

    def since(self, before: ProcessorTime, frames: int) -> tuple[float, float, float, float]:
        """Milliseconds a frame of tracking and map, and shares of all and of other programs.

        A map's process that was started again counts from its start.
        """
        of_map = self.map - before.map if self.map >= before.map else self.map
        whole = max(self.all - before.all, 1e-9)
        busy = 1 - (self.idle - before.idle) / whole
        others = busy - (self.own - before.own) / whole
        per_frame = 1e3 * (self.tracking - before.tracking) / frames, 1e3 * of_map / frames
        return *per_frame, busy, max(others, 0.0)


class Sampler:
    """Notes the state of a live loop at equal intervals of its frames.

    Attributes:
        samples: so far.
    """

    def __init__(self, slam: LiveSlam, every: int, hz: float) -> None:
        """To be made in the thread that tracks; ``every`` so many frames of the source."""
        self.samples: list[Sample] = []
        self._slam, self._every, self._hz = slam, every, hz
        self._frames = self._seen = 0
        ident = threading.get_ident()
        self._clock = time.pthread_getcpuclockid(ident)
        self._before = self._now()

    def _now(self) -> ProcessorTime:
        return ProcessorTime.now(self._clock, self._slam.processes()["map"])

    def watch(self) -> None:
        """Count a frame of the source; take a sample if it is due and frames were tracked."""
        self._frames += 1
        latencies_ms = self._slam._meter.latencies_ms[self._seen :]
        if self._frames < self._every * (len(self.samples) + 1) or not latencies_ms:
            return
        self._seen += len(latencies_ms)
        median, high = np.percentile(latencies_ms, (50, 99))
        pid, health, now = self._slam.processes()["map"], self._slam.health(), self._now()
        self.samples.append(
            Sample(
                self._frames / self._hz / 60,
                float(median),
                float(high),
                *now.since(self._before, len(latencies_ms)),
                *(own_mb("self"), own_mb(pid)),
                *(descriptors("self"), descriptors(pid), len(os.listdir("/proc/self/task"))),
                *(health.keyframes, health.landmarks, health.frames_dropped, health.lost_frames),
            )
        )
        self._before = now


def print_table(samples: list[Sample]) -> None:
    """Some of the samples, and how each curve changes in the second half."""
    print(" ".join(f"{name.replace('latency_ms', 'ms'):>15}" for name in COLUMNS))
    for index in np.unique(np.linspace(0, len(samples) - 1, PARTS + 1).round().astype(int)):
        cells = (format(getattr(samples[index], name), how) for name, how in COLUMNS.items())
        print(" ".join(f"{cell:>15}" for cell in cells))
    later = samples[len(samples) // 2 :]
    minutes = np.array([s.minutes for s in later])
    for name in CURVES:
        values = np.array([getattr(s, name) for s in later], float)
        slope = np.polyfit(minutes, values, 1)[0] if len(later) > 1 else 0.0
        print(f"second half, {name}: {values.mean():.1f}, {60 * slope:+.1f} an hour")


def dropped_by_machine(samples: list[Sample]) -> int:
    """Frames dropped while all cores were taken and other programs had a part of them."""
    dropped = np.diff([0, *(s.dropped for s in samples)])
    slow = [s.busy >= BUSY and s.others >= OTHERS for s in samples]
    return int(dropped[slow].sum())


def draw(samples: list[Sample], path: Path) -> None:
    """The curves over time, one panel a quantity."""
    figure = Figure(figsize=(7.0, 9.5), dpi=120, layout="constrained")
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
    parser.add_argument("--wait", action="store_true", help="the source waits: no frame is dropped")
    parser.add_argument("--segmenter", default="none")
    parser.add_argument("--picture", type=Path, help="the curves, .png or .svg")
    parser.add_argument("--table", type=Path, help="all samples, .csv")
    arguments = parser.parse_args()
    sequences = [open_sequence(path) for path in arguments.sequences]
    chosen = f"semantics.segmenter.name={arguments.segmenter}"
    config = resolve(SystemConfig, None, (chosen,))
    frames, begin_s = int(60 * arguments.minutes * arguments.hz), time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        options = LiveOptions(Path(scratch) / "run")
        with LiveSlam(sequences[0].camera, config, options) as slam:
            sampler = Sampler(slam, max(frames // SAMPLES, 1), arguments.hz)
            given = frames, arguments.hz, arguments.wait, sampler.watch
            play(slam, Rounds(sequences, *given), PlayOptions(not arguments.wait, quiet=True))
            health, wall_s = slam.health(), time.monotonic() - begin_s
    report(sampler.samples, health, wall_s)
    if arguments.picture:
        draw(sampler.samples, arguments.picture)
    if arguments.table:
        with arguments.table.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(asdict(sampler.samples[0])))
            writer.writeheader()
            writer.writerows(map(asdict, sampler.samples))


def report(samples: list[Sample], health: Health, wall_s: float) -> None:
    """Print what happened."""
    print_table(samples)
    counts = f"{health.frames} tracked, {health.frames_dropped} dropped, {health.lost_frames} lost"
    print(f"{counts}, {health.map_deaths} crashes, in {wall_s:.0f} s")
    print(
        f"{dropped_by_machine(samples)} of the dropped while other programs kept the machine full"
    )


if __name__ == "__main__":
    main()
