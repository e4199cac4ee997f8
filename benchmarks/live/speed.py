"""The offline run and the live loop on the same frames: time, and what they cost in accuracy.

    python -m benchmarks.live.speed [SEQUENCE] [--segmenter light] [--repeats 3] [--max-frames N]
    python -m benchmarks.live.speed [SEQUENCE] --before FOLDER

Realtime: frames come at the rate of their stamps, and are dropped if tracking is busy.
Flat out: the next frame comes when the one before is tracked, its features computed ahead. Latency
is the time from the arrival of a frame to its pose. Medians over the repeats, which are
interleaved, since the speed of the machine varies.

"ms a frame" is of features and tracking; "/ ORB" its ratio to what OpenCV's ORB takes alone, 1000
keypoints found and described, on frames of the sequence, just after the run. "whole/s" are the
frames of the sequence over the time of the whole command, from the start of Python to its end, and
"CPU ms" the processor time of that, in all its processes, over them.

With ``--before`` the offline run of this code beside that of other code, which Python finds in
FOLDER (``make typing`` in its checkout makes one: build/typing).
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.machine import features_ms
from benchmarks.paths import KITCHEN, ROOT
from bmask_slam.run_folder.reader import Run

NAME = 28
COLUMNS = (
    ("ate_rmse", "ATE cm", 100.0),
    ("tracked_share", "tracked %", 100.0),
    ("frames_dropped", "dropped", 1.0),
    ("frames_per_second", "frames/s", 1.0),
    ("whole_per_second", "whole/s", 1.0),
    ("cpu_ms", "CPU ms", 1.0),
    ("tracking_ms_median", "ms a frame", 1.0),
    ("tracking_ms_p95", "95 %", 1.0),
    ("per_orb", "/ ORB", 1.0),
    ("latency_ms_median", "latency ms", 1.0),
    ("latency_ms_p95", "95 %", 1.0),
    ("keyframes", "keyframes", 1.0),
)
ORB_KEYPOINTS = 1000  # ORB-SLAM2's number of keypoints for TUM's sequences


def measured(command: list[str], out: Path, before: Path | None = None) -> dict[str, float]:
    """The metrics of one command, run in a process of its own, and what it cost."""
    environment = dict(os.environ)
    if before is not None:
        environment["PYTHONPATH"] = str(before.resolve())
    options = ["--quiet", "--overwrite", "--out", str(out)]
    start_s, used_s = time.perf_counter(), _children_s()
    done = subprocess.run(
        [sys.executable, "-m", "bmask_slam", *command, *options],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    wall_s, cpu_s = time.perf_counter() - start_s, _children_s() - used_s
    if done.returncode:
        raise SystemExit(f"error: {' '.join(command)} failed:\n{done.stderr.strip()[-2000:]}")
    found = {name: metric.value for name, metric in Run(out).metrics.items()}
    frames = len(Run(out).frames)
    found |= {"whole_per_second": frames / wall_s, "cpu_ms": 1e3 * cpu_s / frames}
    found["per_orb"] = found["tracking_ms_median"] / features_ms(
        cv2.ORB_create(ORB_KEYPOINTS), Path(command[1])
    )
    return found


def _children_s() -> float:
    """Processor time of all processes that were started and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def repeats_of(
    parser: argparse.ArgumentParser,
) -> tuple[argparse.Namespace, dict[str, Path | None]]:
    """The arguments, with ``--repeats`` and ``--core``, on which all runs are then, and the codes.

    These by what is put behind a name: that of ``--before``, if given, and this one, which is None.
    """
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--core", type=int)
    parser.add_argument("--before", type=Path, metavar="FOLDER")
    given = parser.parse_args()
    if given.core is not None:
        os.sched_setaffinity(0, {given.core})
    return given, {"": None} if given.before is None else {", before": given.before, "": None}


def variants_of(
    common: list[str], segmenter: str, before: Path | None
) -> dict[str, tuple[list[str], Path | None]]:
    """Commands by name, each with the folder of the code that it runs if that is not this one."""
    without, masks = ["--segmenter", "none"], ["--segmenter", segmenter]
    if before is not None:
        kinds = {"offline": without, f"offline, {segmenter}": masks}
        return {
            f"{name}{when}": (["run", *common, *kind], code)
            for name, kind in kinds.items()
            for when, code in ((", before", before), ("", None))
        }
    live = ["live", *common, "--realtime"]
    commands = {
        "offline": ["run", *common, *without],
        "flat out": ["live", *common, *without],
        "realtime": [*live, *without],
        f"realtime, {segmenter}": [*live, *masks],
        f"realtime, {segmenter}, dense": [*live, *masks, "--map"],
    }
    return {name: (command, None) for name, command in commands.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequence", type=Path, nargs="?", default=KITCHEN)
    parser.add_argument("--segmenter", default="light")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--before", type=Path, metavar="FOLDER")
    arguments = parser.parse_args()
    common = [str(arguments.sequence.resolve())]
    if arguments.max_frames:
        common += ["--max-frames", str(arguments.max_frames)]
    variants = variants_of(common, arguments.segmenter, arguments.before)
    with tempfile.TemporaryDirectory() as scratch:
        runs: dict[str, list[dict[str, float]]] = {name: [] for name in variants}
        for _ in range(arguments.repeats):
            for name, (command, code) in variants.items():
                runs[name].append(measured(command, Path(scratch) / "run", code))
    used = [c for c in COLUMNS if any(c[0] in run for found in runs.values() for run in found)]
    print(f"{'':{NAME}}" + "".join(f"{title:>11}" for _, title, _ in used))
    for name, found in runs.items():
        cells = []
        for key, _, scale in used:
            values = [scale * run[key] for run in found if key in run]
            cells.append(f"{np.median(values):11.2f}" if values else f"{'':11}")
        print(f"{name:{NAME}}" + "".join(cells))


if __name__ == "__main__":
    main()
