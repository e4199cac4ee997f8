"""What the map keeps of a room that is seen again and again.

    python -m benchmarks.loops.revisits ../shared/data/redkitchen [--passes 8]

A recording is played forward and backward, so that every second pass has the images of the first
one. A map that is used again needs few keyframes and landmarks from the second pass on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.live.session import Rounds
from benchmarks.machine import own_mb
from benchmarks.pages import table
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Ints
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

TITLES = ("pass", "keyframes made", "kept in the end", "landmarks in the map",
          "a frame observes", "of the first pass", "of this pass", "update ms", "MB")  # fmt: skip


class Played:
    """What a system has made of the passes so far."""

    def __init__(self, system: SlamSystem) -> None:
        self.system = system
        self.ends: list[tuple[int, int]] = [(0, 0)]  # next keyframe, next landmark
        self.rows: list[list[str]] = []

    def end_pass(self, observed: list[Ints], first_update: int) -> None:
        """Add a row; ``observed`` are the landmarks of each frame as long as these were tracked."""
        world = self.system.map.world
        ids, frames = np.concatenate(observed), len(observed)
        first = self.ends[1][1] if len(self.ends) > 1 else len(world.landmarks)
        made = world.next_keyframe_id - self.ends[-1][0]
        updates_ms = self.system.mapper.update_ms[first_update:] or [0.0]  # of no new keyframe
        high_ms = np.percentile(updates_ms, 95)
        old, new = (ids < first).sum() / frames, (ids >= self.ends[-1][1]).sum() / frames
        cells = [len(self.ends), made, world.landmarks.in_map.sum(), len(ids) / frames, old, new]
        self.rows.append([f"{cell:.0f}" for cell in (*cells, high_ms, own_mb("self"))])
        self.ends.append((world.next_keyframe_id, len(world.landmarks)))

    def lines(self) -> list[list[str]]:
        """The rows with the number of keyframes that are still there."""
        kept = np.array(list(self.system.map.world.keyframes))
        bounds = [end for end, _ in self.ends]
        numbers = np.histogram(kept, bounds)[0]
        rows = zip(self.rows, numbers, strict=True)
        return [[*row[:2], str(number), *row[2:]] for row, number in rows]


def play(sequence: Sequence, passes: int, settings: list[str]) -> Played:
    """Let a system see a sequence so many times, without a segmenter."""
    config = resolve(SystemConfig, None, ("semantics.segmenter.name=none", *settings))
    system, count = SlamSystem(sequence.camera, config), len(sequence)
    played, observed, first_update = Played(system), [], 0
    source = Rounds([sequence], passes * count, 30.0, True, lambda: None)
    for number, frame in enumerate(source.frames(), 1):
        system.process(frame)
        observed += [view.landmark_ids for view in system.frame_observations.views[-1:]]
        if number % count == 0:
            played.end_pass(observed, first_update)
            observed, first_update = [], len(system.mapper.update_ms)
    return played


def main() -> None:
    """Print a row for each pass."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--passes", type=int, default=8)
    parser.add_argument("--set", dest="settings", action="append", default=[])
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.sequence)
    print(table(TITLES, play(sequence, arguments.passes, arguments.settings).lines()))


if __name__ == "__main__":
    main()
