"""The live loop compared with the offline run on the same frames.

    python -m benchmarks.live.speed [SEQUENCE] [--segmenter light] [--repeats 3] [--max-frames N]

Realtime: frames come at the rate of their stamps, and are dropped if tracking is busy.
Flat out: the next frame comes when the one before is tracked, its features computed ahead. Latency
is the time from the arrival of a frame to its pose. Medians over the repeats.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.paths import KITCHEN
from benchmarks.suite.measure import call

NAME = 24
COLUMNS = (
    ("ate_rmse", "ATE cm", 100.0),
    ("tracked_share", "tracked %", 100.0),
    ("frames_dropped", "dropped", 1.0),
    ("frames_per_second", "frames/s", 1.0),
    ("latency_ms_median", "latency ms", 1.0),
    ("latency_ms_p95", "95 %", 1.0),
    ("keyframes", "keyframes", 1.0),
    ("loops_closed", "loops", 1.0),
)


def measured(command: list[str], out: Path) -> dict[str, float]:
    """The metrics of one command, run in a process of its own."""
    call(["-m", "bmask_slam", *command, "--quiet", "--overwrite", "--out", str(out)])
    return {row["name"]: row["value"] for row in json.loads((out / "metrics.json").read_text())}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path, nargs="?", default=KITCHEN)
    parser.add_argument("--segmenter", default="light")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--max-frames", type=int)
    arguments = parser.parse_args()
    common = [str(arguments.sequence)]
    if arguments.max_frames:
        common += ["--max-frames", str(arguments.max_frames)]
    without, masks = ["--segmenter", "none"], ["--segmenter", arguments.segmenter]
    variants = {
        "offline": ["run", *common, *without],
        "flat out": ["live", *common, *without],
        "realtime": ["live", *common, "--realtime", *without],
        f"realtime, {arguments.segmenter}": ["live", *common, "--realtime", *masks],
        f"realtime, {arguments.segmenter}, dense": ["live", *common, "--realtime", *masks, "--map"],
    }
    print(f"{'':{NAME}}" + "".join(f"{title:>12}" for _, title, _ in COLUMNS))
    with tempfile.TemporaryDirectory() as scratch:
        runs: dict[str, list[dict[str, float]]] = {name: [] for name in variants}
        for _ in range(arguments.repeats):  # interleaved, since the speed of the machine varies
            for name, command in variants.items():
                runs[name].append(measured(command, Path(scratch) / "run"))
    for name, found in runs.items():
        cells = []
        for key, _, scale in COLUMNS:
            values = [scale * run[key] for run in found if key in run]
            cells.append(f"{np.median(values):12.2f}" if values else f"{'':12}")
        print(f"{name:{NAME}}" + "".join(cells))


if __name__ == "__main__":
    main()
