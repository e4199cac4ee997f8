"""The surface of a live run that grows on the way, beside that of ``map`` and of keyframes alone.

    python -m benchmarks.live.growing_surface SEQUENCE [--frames N] [--work DIR] [--truth]

The sequence is played without a dense map, with one of keyframes alone, and with frames between
them. Complete: share of the vertices that ``map`` makes of all tracked frames of
that run which have a vertex within 2 cm; of a rendered room (--truth) of the true surface. Flat
patches, normals and ghosts are those of `benchmarks.mapping.surface_compare`.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.mapping.dense_surface import read_truth, surface
from benchmarks.mapping.surface_compare import (
    coverage,
    flat_patches,
    ghosts,
    patch_errors,
    table_of,
    truth_errors,
)
from benchmarks.suite.measure import in_own_process
from bmask_slam.config.configuration import resolve
from bmask_slam.dense.growing.frames import FrameOptions
from bmask_slam.dense.map_run import map_run
from bmask_slam.dense.options import MapOptions
from bmask_slam.dense.saved_map import open_run
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.play import PlayOptions, play
from bmask_slam.live.sources.opening import SourceOptions, open_source
from bmask_slam.system_config import SystemConfig

WAYS = {"no dense map": None, "keyframes": 0.0, "frames too": 5.0}
"""Frames a second between keyframes."""
SEGMENTER = ["semantics.segmenter.name=none"]
WITHIN_M = 0.02


def live(
    sequence: str, frames: int, out: Path, per_s: float | None, realtime: bool
) -> dict[str, float]:
    """A live run; processor time of tracking for each frame, and how the surface grew."""
    options = LiveOptions(
        out, True, images=Path(sequence), dense=per_s is not None, straightens=True
    )
    if per_s is not None:
        options = replace(options, surface_frames=FrameOptions(per_s))
    source = open_source(sequence, SourceOptions(realtime=realtime, max_frames=frames))
    with LiveSlam(source.camera, resolve(SystemConfig, None, SEGMENTER), options) as slam:
        begin_s, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF)
        play(slam, source, PlayOptions(realtime, quiet=True))
        after, played_s = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter() - begin_s
        used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        health, dense = slam.health(), slam._system.dense
        dense_s = 0.0 if dense is None else dense.worker._worker.processor_s
    source.close()
    ended_s = time.perf_counter() - begin_s - played_s
    row = {"frames": health.frames, "cpu ms a frame": 1e3 * used_s / health.frames}
    row |= {"latency ms": health.latency_ms_median, "95 %": health.latency_ms_p95}
    row |= {"played s": played_s, "dense cpu s": dense_s}
    row |= {"keyframes by then": health.submaps, "frames by then": health.surface_frames}
    row |= {"in the end": 0 if slam.dense is None else slam.dense.frames}
    return row | {"dropped": health.surface_frames_dropped, "finish s": ended_s}


def cloud(run: Path) -> dict[str, NDArray]:
    """Vertices and normals of a dense map."""
    columns = read_ply(run / "dense" / "cloud.ply")
    return {
        key: np.stack([columns[f"{prefix}{axis}"] for axis in "xyz"], axis=1)
        for key, prefix in (("v", ""), ("n", "n"))
    }


def quality(path: Path, truth: bool) -> Iterator[tuple[str, dict[str, float]]]:
    """Measures of a live run's surface, and of that which ``map`` makes of the same run."""
    run, found = open_run(path), {"live": cloud(path)}
    map_run(MapOptions(path))
    found["map"] = cloud(path)
    patches, true = flat_patches(run), surface(read_truth(run), run) if truth else None
    for name, mesh in found.items():
        row = patch_errors(mesh, patches) | {"ghosts %": 100 * ghosts(mesh, run)}
        row["complete %"] = 100 * coverage(mesh, found["map"]["v"][::5].astype(float), WITHIN_M)
        if true is not None:
            row |= truth_errors(mesh, true)
        yield name, row


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", help="folder of a recording")
    parser.add_argument("--frames", type=int, default=300, help="how many (default: 300)")
    parser.add_argument("--work", type=Path, default=Path("runs/bench/growing"), help="for runs")
    parser.add_argument("--truth", action="store_true", help="a room rendered with --true-depth")
    parser.add_argument("--repeat", type=int, default=2, help="live runs of each (default: 2)")
    text = "play it at its own speed; else it waits for the maps, and little is dropped"
    parser.add_argument("--realtime", action="store_true", help=text)
    parser.add_argument("--ways", default=";".join(WAYS), help="which (default: %(default)s)")
    parser.add_argument("--costs", action="store_true", help="the surfaces are not compared")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    rows: dict[str, dict[str, float]] = {}
    surfaces: dict[str, dict[str, float]] = {}
    for name in args.ways.split(";"):
        per_s = WAYS[name]
        for k in range(args.repeat):
            out = args.work / f"{Path(args.sequence).name}-{name.replace(' ', '-')}-{k}"
            rows[f"{name}, {k}"] = in_own_process(
                live, args.sequence, args.frames, out, per_s, args.realtime
            )
        if per_s is not None and not args.costs:
            surfaces |= {f"{name}, {what}": row for what, row in quality(out, args.truth)}
    title = Path(args.sequence).name
    print(*(table_of(title, found) for found in (rows, surfaces) if found), sep="\n")


if __name__ == "__main__":
    main()
