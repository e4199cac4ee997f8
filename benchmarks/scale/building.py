"""A rendered building of three storeys: is the cost flat, and is no room taken for another?

    python -m benchmarks.scale.building [--work runs/bench/building] [--fps 30] [--width 640]

The building is rendered once (20 000 frames of 640x480 take an hour and 15 GB of disk; fewer and
smaller ones are a thinner version of the same walk) and run with `--segmenter none`, loops closed
and not. A closed loop is wrong if its measurement is further than ``WRONG_M`` from the truth; rooms
that look alike are 3.2 m and more apart. Times are of this machine; what counts is that they stay.
The next day, the first ``NEXT_DAY_FRAMES`` frames go on with the map of the first (`--continue`).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.suite.recorded_run import RecordingSystem, recorded
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.trajectory import associate_stamps, read_tum
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.run_folder.reader import Run
from bmask_slam.system_config import SystemConfig

PARTS, NEXT_DAY_FRAMES = 10, 300
WRONG_M = 1.0
COLUMNS = (
    *("frames", "path_m", "keyframes", "landmarks", "in_graph", "factors"),
    *("frame_ms", "p95_ms", "update_ms", "p95_ms", "rss_mb"),
)


def sequence_of(work: Path, fps: float, width: int) -> Path:
    """The rendered building, made where it is not there yet."""
    folder = work / f"building-{fps:g}hz-{width}"
    if not folder.is_dir():
        height = width * 3 // 4
        render_sequence(RenderConfig("building", fps=fps, width=width, height=height), folder)
    return folder


def options_of(sequence: Path, out: Path, closed: bool = True) -> RunOptions:
    """The default options of a run but for the segmenter and perhaps loops."""
    settings = ("semantics.segmenter.name=none", f"loops.enabled={str(closed).lower()}")
    config = resolve(SystemConfig, None, settings)
    return RunOptions(sequence, config, out=out, overwrite=True, quiet=True)


def table(out: Path, rows: list[dict[str, float]], walked_m: Array) -> str:
    """Sizes at the end of each part of the sequence, and times within it."""
    frames = Run(out).frames
    total_ms = np.nansum(list(frames.stage_ms.values()), axis=0)
    at = np.array([row["frame"] for row in rows])
    lines = ["".join(f"{name:>10}" for name in COLUMNS)]
    ends = np.linspace(0, len(frames), PARTS + 1).astype(int)
    for begin, end in pairwise(ends.tolist()):
        part = [row for row, frame in zip(rows, at, strict=True) if begin <= frame < end]
        updates = np.array([row["update_ms"] for row in part])
        last = part[-1]
        values = (
            *(end, walked_m[end - 1], last["keyframes"], last["landmarks"]),
            *(last["graph_landmarks"], last["factors"]),
            *(np.median(total_ms[begin:end]), np.percentile(total_ms[begin:end], 95)),
            *(np.median(updates), np.percentile(updates, 95), last["rss_mb"]),
        )
        lines.append("".join(f"{value:10.0f}" for value in values))
    return "\n".join(lines)


def loop_errors_m(system: RecordingSystem, out: Path, sequence: Path) -> Array:
    """How far what each closed loop measured is from the truth, (N,) in metres."""
    frames, truth = Run(out).frames, read_tum(sequence / "groundtruth.txt")
    is_keyframe = frames.keyframe_ids >= 0
    stamps = frames.timestamps_s[is_keyframe]
    rows, matched = associate_stamps(stamps, truth.timestamps_s)
    ids = frames.keyframe_ids[is_keyframe][rows].tolist()
    poses = dict(zip(ids, truth.poses_world_camera[matched], strict=True))
    errors_m = [
        np.linalg.norm((inverse(poses[k.keyframe_a]) @ poses[k.keyframe_b] - k.T_a_b)[:3, 3])
        for k in system.mapper.smoother.relative_poses("loop")
    ]
    return np.array(errors_m)


def next_day(sequence: Path, before: Path) -> str:
    """What became of the begin of the walk in the map of a run, as text."""
    out, begin_s = before.with_name(f"{before.name}-next-day"), time.perf_counter()
    run(replace(options_of(sequence, out), map=before, max_frames=NEXT_DAY_FRAMES))
    passed_s = time.perf_counter() - begin_s
    frames, metrics = Run(out).frames, Run(out).metrics
    located = int(np.argmax(frames.segment == 0))
    return (
        f"the next day: in the old map from frame {located} on, {NEXT_DAY_FRAMES} frames in "
        f"{passed_s:.0f} s with the map's reading and writing, "
        f"ATE {1e3 * metrics['ate_rmse'].value:.0f} mm"
    )


def main() -> None:
    """Render, run with and without loops, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--work", type=Path, default=Path("runs/bench/building"))
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--width", type=int, default=640)
    arguments = parser.parse_args()
    sequence = sequence_of(arguments.work, arguments.fps, arguments.width)
    positions = read_tum(sequence / "groundtruth.txt").positions_world
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    walked_m = np.r_[0.0, np.cumsum(steps_m)]
    print(f"{len(positions)} frames, {walked_m[-1]:.0f} m")
    for closed in (True, False):
        out = sequence.with_name(f"{sequence.name}-{'closed' if closed else 'open'}")
        system = recorded(options_of(sequence, out, closed))
        metrics = Run(out).metrics
        ate_m = metrics["ate_rmse"].value
        errors_m = loop_errors_m(system, out, sequence)
        size_mb = sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 1e6
        print(f"\nloops {'closed' if closed else 'not closed'}")
        print(table(out, system.rows, walked_m))
        print(
            f"tracked {100 * metrics['tracked_share'].value:.2f} %, "
            f"ATE {1e3 * ate_m:.0f} mm ({100 * ate_m / walked_m[-1]:.3f} % of the path), "
            f"loops {len(errors_m)}, wrong ones {np.count_nonzero(errors_m > WRONG_M)}, "
            f"run folder {size_mb:.0f} MB",
            flush=True,
        )
        if closed:
            print(next_day(sequence, out), flush=True)


if __name__ == "__main__":
    main()
