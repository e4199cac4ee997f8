"""A long session of the live loop: latency and memory over time.

    python -m benchmarks.live.session SEQUENCE [--minutes 30] [--hz 30] [--segmenter none]

A sequence is played forward and backward with the stamps of a camera of that rate, without
pauses. Memory is that of each process's own (anonymous) pages, at the end of each
sixth of the session.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count, cycle, islice
from pathlib import Path

import numpy as np

from benchmarks.machine import own_mb
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import evaluate_trajectory
from bmask_slam.graph.trajectory import Trajectory, nearest_indices
from bmask_slam.live.health import Health
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.play import PlayOptions, play
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts, paced
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system_config import SystemConfig

PARTS = 6


Watch = Callable[[], None]
"""Called before each frame."""


class Rounds(MeasuredSource):
    """Sequences that are played forward and backward again and again, at the rate of a camera.

    Attributes:
        order: a round: each frame's sequence, and its index there.
    """

    name = "rounds"

    def __init__(
        self, sequences: list[Sequence], frames: int, hz: float, waits: bool, watch: Watch
    ):
        self.waits = waits
        self.camera = sequences[0].camera
        self.groundtruth: Trajectory | None = None
        self.counts = SourceCounts()
        self.order: list[tuple[Sequence, int]] = []
        for sequence in sequences:
            there = range(len(sequence))
            self.order += [(sequence, index) for index in (*there, *reversed(there))]
        self._frames, self._hz, self._watch = frames, hz, watch

    def frames(self) -> Iterator[Frame]:
        """Each frame when it is due, with the stamp that the camera would give it."""
        return self._unpaced() if self.waits else paced(self._unpaced())

    def close(self) -> None:
        """Nothing to close."""

    def _unpaced(self) -> Iterator[Frame]:
        for k, (sequence, index) in enumerate(islice(cycle(self.order), self._frames)):
            self._watch()
            yield replace(sequence.load(index), index=k, timestamp_s=k / self._hz)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--hz", type=float, default=30.0)
    parser.add_argument("--segmenter", default="none")
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.sequence)
    frames = int(60 * arguments.minutes * arguments.hz)
    config = resolve(SystemConfig, None, (f"semantics.segmenter.name={arguments.segmenter}",))
    part = frames // PARTS
    rows: list[tuple[Health, float, float, list[float]]] = []
    number = count(1)
    with LiveSlam(sequence.camera, config, LiveOptions()) as slam:

        def watch() -> None:
            if next(number) % part == 0:
                latencies_ms = slam._meter.latencies_ms[-part:]
                memory = own_mb("self"), own_mb(slam.processes()["map"])
                rows.append((slam.health(), *memory, list(latencies_ms)))

        rounds = Rounds([sequence], frames, arguments.hz, True, watch)
        begin_s = time.monotonic()
        play(slam, rounds, PlayOptions(realtime=False, quiet=True))
        wall_s = time.monotonic() - begin_s
        trajectory, lost = slam.trajectory(), slam.health().lost_frames
    titles = ("minutes", "median ms", "95 % ms", "tracking MB", "map MB", "keyframes", "landmarks")
    print("".join(f"{title:>13}" for title in titles))
    for done, (health, here, there, latencies_ms) in enumerate(rows, 1):
        median, high = np.percentile(latencies_ms, (50, 95))
        minutes = done * arguments.minutes / PARTS
        cells = (f"{minutes:.0f}", f"{median:.1f}", f"{high:.1f}", f"{here:.0f}", f"{there:.0f}")
        print("".join(f"{cell:>13}" for cell in (*cells, health.keyframes, health.landmarks)))
    assert sequence.groundtruth is not None
    indices = [index for _, index in islice(cycle(rounds.order), frames)]
    truth, when_s = sequence.groundtruth, sequence.timestamps_s[indices]
    nearest = nearest_indices(truth.timestamps_s, when_s)
    reference = Trajectory(np.arange(frames) / arguments.hz, truth.poses_world_camera[nearest])
    ate_m = evaluate_trajectory(trajectory, reference).value("ate_rmse")
    print(f"{frames} frames in {wall_s:.0f} s, {lost} lost, ATE {1e3 * ate_m:.1f} mm")


if __name__ == "__main__":
    main()
