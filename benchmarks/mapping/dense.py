"""Dense maps against the truth of rendered rooms: depth, surface, labels, time.

    python -m benchmarks.mapping.dense DIR [--rooms office] [--out dense.json]

Rooms of 150 frames with a Kinect's noise, poses by the system. Depth of the keyframes before and
after fusion, the effect of each Step, and the normalised squared error (nees) of the stated
variance, which should be 1; then the cloud and Open3D's TSDF of the same keyframes and poses
against the true surface. Coverage and outliers (beyond 5 cm) are shares of the pixels that have a
truth; "<5cm" means without outliers. A Kinect's noise leaves few holes, so that coverage can grow
little there: what fusion fills shows where a fifth of every image is lost.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.mapping.dense_depth import ALL_STEPS, Steps, ablation, depth_errors, patchy
from benchmarks.mapping.dense_surface import (
    VOXEL_M,
    label_errors,
    open3d_points,
    read_truth,
    surface,
    surface_errors,
)
from benchmarks.mapping.dense_time import ROUNDS, step_times_ms
from bmask_slam.dense.map_run import map_run
from bmask_slam.dense.options import MapOptions, fusion_config
from bmask_slam.dense.saved_map import MappedRun, open_run
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.offline.options import RunOptions
from bmask_slam.offline.runner import run
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter

ROOMS, FRAMES = "office,living_room", 150


def measure(run: MappedRun, options: MapOptions) -> dict[str, Any]:
    """All measurements, as plain data."""
    truths, config = read_truth(run), fusion_config(options)
    steps = Steps(run, config)
    maps = ablation(steps)
    everywhere = [np.ones(t.depth_m.shape, bool) for t in truths]
    measured = [m.known.numpy() for m in steps.raw]
    depth = {name: depth_errors(m, truths, everywhere) for name, m in maps.items()}
    shared = {name: depth_errors(m, truths, measured) for name, m in maps.items()}
    times = step_times_ms(steps, run, config)
    summary = map_run(options)
    cloud = read_ply(summary.folder / "cloud.ply")
    true = surface(truths, run)
    points = open3d_points(run, steps.keyframes)
    cloud_points = np.stack([cloud[c] for c in "xyz"], axis=1).astype(float)
    return {
        "keyframes": len(run.keyframes),
        "depth": depth,
        "depth_where_measured": shared,
        "depth_of_a_patchy_sensor": patchy(run, truths, config),
        "ms": times,
        "surface": {
            "cloud": surface_errors(cloud_points, true),
            "tsdf": surface_errors(points, true),
        },
        "labels": {
            "truth": label_errors(cloud, true),
            "light network": network_labels(options, true),
        },
    }


def network_labels(options: MapOptions, true: dict[str, Any]) -> dict[str, float]:
    """Errors of the labels where the masks are the light network's, in a copy of the run."""
    sequence, copy = options.sequence, options.run.with_name(f"{options.run.name}-light")
    assert sequence is not None
    shutil.copytree(options.run, copy, dirs_exist_ok=True, ignore=shutil.ignore_patterns("dense"))
    light = SegmenterOptions("light")
    summary = map_run(dataclasses.replace(options, run=copy, masks=light, plan=False))
    true_labels = make_segmenter(SegmenterOptions("truth"), sequence).labels
    names = json.loads((summary.folder / "legend.json").read_text())  # things, then surfaces
    numbers = np.array([true_labels.number(name) for name in names])
    cloud = read_ply(summary.folder / "cloud.ply")
    return label_errors({**cloud, "label": numbers[cloud["label"]]}, true)


HEADINGS = ("rmse mm", "rmse <5cm", "median", "coverage", "outliers", "nees", "nees <5cm")


def lines(result: dict[str, Any]) -> Iterator[str]:
    """The result as text."""
    for kind, title in DEPTHS.items():
        rows = result[kind]
        yield f"{title:32}" + "".join(f"{name:>11}" for name in HEADINGS)
        for name, row in rows.items():
            yield f"  {name:30}" + "".join(f"{value:11.4f}" for value in row.values())
        before, after = rows["sensor"], rows[ALL_STEPS]
        rmse, coverage, outliers = (
            after[name] / before[name] for name in ("rmse_mm", "coverage", "outlier_share")
        )
        yield (
            f"  after / before: rmse {rmse:.3f}, coverage {coverage:.3f} (every pixel would be "
            f"{1 / before['coverage']:.3f}), outliers {outliers:.3f}; nees {after['chi2']:.3f}\n"
        )
    surfaces = result["surface"]
    yield f"{'against the true surface':32}" + "".join(f"{n:>17}" for n in surfaces["cloud"])
    for name, row in surfaces.items():
        yield f"  {name:30}" + "".join(f"{value:17.4g}" for value in row.values())
    for masks, row in result["labels"].items():
        errors = ", ".join(f"{k} {v:.4f}" for k, v in row.items())
        yield f"labels, masks of the {masks}: {errors}"
    yield from time_lines(result["ms"])


def time_lines(ms: dict[str, Any]) -> Iterator[str]:
    """The times as text."""
    yield f"ms a 640x480 keyframe, least of {ROUNDS}; load of the machine {ms['load']:.1f}"
    for title, times in (
        ("processor time, one thread", ms["processor"]),
        ("on the clock, two threads", ms["wall"]),
    ):
        if not times:
            yield f"  {title}: not measured, others use the machine"
            continue
        yield f"  {title}: " + ", ".join(f"{k} {v:.0f}" for k, v in times.items())
        yield f"    all Steps in {times['all Steps'] / times['TSDF']:.2f} times the TSDF's"
    yield ""


DEPTHS = {
    "depth": "depth, every pixel",
    "depth_where_measured": "depth, where the sensor has any",
    "depth_of_a_patchy_sensor": "depth, a fifth of it lost",
}


def prepared(root: Path, room: str) -> tuple[Path, Path]:
    """The sequence of a room and its run under a folder, made if they do not exist."""
    sequence, run_folder = root / room, root / f"{room}-run"
    if not sequence.is_dir():
        render_sequence(RenderConfig(room, frames=FRAMES, true_depth=True), sequence)
    if not run_folder.is_dir():
        run(RunOptions(sequence, out=run_folder, quiet=True))
    return sequence, run_folder


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path, help="folder of rooms and runs; made where missing")
    parser.add_argument("--rooms", default=ROOMS, help="which (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="also write the figures as JSON")
    args = parser.parse_args()
    results = {}
    for room in args.rooms.split(","):
        sequence, run_folder = prepared(args.root, room)
        truth = SegmenterOptions("truth")
        options = MapOptions(run_folder, sequence, truth, voxel_m=VOXEL_M, plan=True)
        mapped = open_run(run_folder, sequence)
        results[room] = measure(mapped, options)
        print(f"{room}: {len(mapped.sequence)} frames, {len(mapped.keyframes)} keyframes")
        print("\n".join(lines(results[room])), flush=True)
    if args.out is not None:
        args.out.write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
