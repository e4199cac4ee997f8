"""A run that also writes how the map and the graph grow: one line a keyframe in growth.csv.

    python -m benchmarks.suite.recorded_run SEQUENCE --out RUN

Nothing that is recorded changes the estimate: trajectory.txt is that of ``bmask-slam run
--segmenter none``.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

from benchmarks.machine import resident_mb
from bmask_slam.config.configuration import resolve
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult

COLUMNS = ("frame", "keyframes", "landmarks", "graph_landmarks", "factors", "update_ms", "rss_mb")


class RecordingSystem(SlamSystem):
    """The system, with a row of COLUMNS for every keyframe in ``rows``."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.rows: list[dict[str, float]] = []

    def process(self, frame: Frame, features: Any = None) -> FrameResult:
        """A frame as ever; then look at the graph."""
        result = super().process(frame, features)
        if result.keyframe_id is not None:
            graph, map_now = self.mapper.smoother.estimate(), self.statistics()
            update_ms = map_now["isam2_update_ms"]
            assert isinstance(update_ms, list)
            self.rows.append(
                {
                    "frame": frame.index,
                    "keyframes": len(graph.keyframe_ids),
                    "landmarks": int(map_now["landmarks"]),
                    "graph_landmarks": len(graph.landmark_ids),
                    "factors": graph.factors,
                    "update_ms": round(update_ms[-1], 3),
                    "rss_mb": round(resident_mb(), 1),
                }
            )
        return result


def recorded(options: RunOptions) -> RecordingSystem:
    """The system of a run; the last one, if the run begins anew with the camera that it found."""
    systems: list[RecordingSystem] = []

    def make_system(*given: Any) -> RecordingSystem:
        systems.append(RecordingSystem(*given))
        return systems[-1]

    run(options, make_system)
    return systems[-1]


def main() -> None:
    """Parse, run, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    config = resolve(SystemConfig, None, ("semantics.segmenter.name=none",))
    options = RunOptions(arguments.sequence, config, out=arguments.out, overwrite=True, quiet=True)
    system = recorded(options)
    with (arguments.out / "growth.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(system.rows)


if __name__ == "__main__":
    main()
