"""Dense maps against the truth of rendered rooms: depth, surface, labels, time.

    python benchmarks/dense.py runs/bench/dense [--rooms office] [--out runs/bench/dense.json]

Rooms of 150 frames with a Kinect's noise, poses by the system. Depth of the keyframes before and
after fusion, what each Step brings, and the normalised squared error (nees) of the variance that
is stated, which should be 1; then the cloud and Open3D's TSDF of the same keyframes and poses
against the true surface. Coverage and outliers (beyond 5 cm) are shares of the pixels that have a
truth; "<5cm" means without outliers.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.dense_surface import (
    VOXEL_M,
    Truth,
    label_errors,
    open3d_points,
    read_truth,
    surface,
    surface_errors,
)
from graph.geometry import inverse
from graph.ply import read_ply
from mapping.backprojection import back_project, surface_normals
from mapping.dense import DenseConfig, DenseKeyframe, neighbours
from mapping.fusion import Fused, fuse, stated
from mapping.inverse_depth import InverseDepthMap, from_sensor
from mapping.regularisation import regularise
from mapping.warping import View
from semantics.segmenter_table import SegmenterOptions
from slam.dense_input import MappedRun, load, open_run
from slam.dense_keyframes import dense_config
from slam.dense_options import MapOptions
from slam.dense_run import map_run
from slam.rendering.sequence import RenderConfig, render_sequence
from slam.run_options import RunOptions
from slam.runner import run

OUTLIER_M = 0.05
ROOMS, FRAMES = "office,living_room", 150
ROUNDS = 6
PATCHES = 0.2
ALL_STEPS = "Steps 3, 4, 5, honest variance"
Map = InverseDepthMap


# --- depth -----------------------------------------------------------------------------------


def depth_errors(maps: list[Map], truths: list[Truth], where: list[NDArray]) -> dict[str, float]:
    """Errors over the pixels that are known, have a truth and are in ``where``."""
    errors, chi2, known = [], [], []
    for given, truth, mask in zip(maps, truths, where, strict=True):
        possible = np.isfinite(truth.depth_m) & mask
        error = given.depth_m() - truth.depth_m
        seen = possible & np.isfinite(error)
        errors.append(error[seen])
        rho, variance = given.rho.numpy()[seen], given.variance.numpy()[seen]
        chi2.append((rho - 1 / truth.depth_m[seen]) ** 2 / variance)
        known.append(seen.sum() / possible.sum())
    e, c = np.concatenate(errors), np.concatenate(chi2)
    inlier = np.abs(e) < OUTLIER_M
    return {
        "rmse_mm": 1e3 * float(np.sqrt(np.mean(e**2))),
        "rmse_inliers_mm": 1e3 * float(np.sqrt(np.mean(e[inlier] ** 2))),
        "median_mm": 1e3 * float(np.median(np.abs(e))),
        "coverage": float(np.mean(known)),
        "outlier_share": float(np.mean(~inlier)),
        "chi2": float(np.mean(c)),
        "chi2_inliers": float(np.mean(c[inlier])),
    }


class Steps:
    """The Steps on all keyframes of a run, one by one or left out."""

    def __init__(self, run: MappedRun, config: DenseConfig, lost: float = 0.0) -> None:
        """``lost`` is a share of each keyframe's depth that the sensor does not give."""
        self.camera = run.camera
        loaded = [load(run, k)[0] for k in run.keyframes]
        self.keyframes: list[DenseKeyframe] = [without_patches(k, lost) for k in loaded]
        self.raw = [from_sensor(k.depth_m, run.camera, config.noise) for k in self.keyframes]
        self.images = [
            torch.from_numpy(np.ascontiguousarray(cv2.blur(k.rgb, (3, 3)).transpose(2, 0, 1)))
            for k in self.keyframes
        ]

    def fused(self, maps: list[Map], count: int = 6, colours: bool = True) -> list[Fused]:
        """Step 4 with so many neighbours."""
        index = {k.id: i for i, k in enumerate(self.keyframes)}
        results = []
        for i, own in enumerate(self.keyframes):
            window = [k for k in self.keyframes[max(i - 6, 0) : i + 7] if k is not own]
            T_own_world = inverse(own.T_world_camera)
            views = [
                View(
                    maps[index[k.id]],
                    T_own_world @ k.T_world_camera,
                    self.images[index[k.id]].float() if colours else None,
                )
                for k in neighbours(own, window, count)
            ]
            results.append(fuse(maps[i], views, self.camera, self.images[i].float()))
        return results


def without_patches(keyframe: DenseKeyframe, lost: float) -> DenseKeyframe:
    """A keyframe without a share of its depth, lost in patches of its own, as on glossy surfaces.

    The patches are 20 to 60 pixels wide: where smooth noise is low.
    """
    if not lost:
        return keyframe
    noise = np.random.default_rng([keyframe.id, 7]).standard_normal(keyframe.depth_m.shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 12)
    patches = smooth < np.quantile(smooth, lost)
    depth_m = np.where(patches, np.float32(np.nan), keyframe.depth_m)
    return dataclasses.replace(keyframe, depth_m=depth_m)


def patchy(run: MappedRun, truths: list[Truth], config: DenseConfig) -> dict[str, Any]:
    """Depth before and after all Steps with a sensor that loses PATCHES of every image."""
    steps = Steps(run, config, PATCHES)
    fused = steps.fused([regularise(m) for m in steps.raw])
    final = [stated(regularise(f.map), f) for f in fused]
    everywhere = [np.ones(t.depth_m.shape, bool) for t in truths]
    return {
        "sensor": depth_errors(steps.raw, truths, everywhere),
        ALL_STEPS: depth_errors(final, truths, everywhere),
    }


def ablation(steps: Steps) -> dict[str, list[Map]]:
    """Maps of every keyframe after each Step, and with Steps left out."""
    step3 = [regularise(m) for m in steps.raw]
    step4 = steps.fused(step3)
    step5 = [regularise(f.map) for f in step4]
    without3 = steps.fused(steps.raw)
    two = steps.fused(step3, 2)
    return {
        "sensor": steps.raw,
        "Step 3": step3,
        "Steps 3, 4": [f.map for f in step4],
        "Steps 3, 4, 5": step5,
        ALL_STEPS: [stated(m, f) for m, f in zip(step5, step4, strict=True)],
        "without 3": [regularise(f.map) for f in without3],
        "without 4": [regularise(m) for m in step3],
        "two neighbours": [regularise(f.map) for f in two],
        "holes filled by the paper's 2": [
            regularise(f.map, 2) for f in steps.fused([regularise(m, 2) for m in steps.raw])
        ],
    }


# --- time ------------------------------------------------------------------------------------


def step_times_ms(steps: Steps, run: MappedRun, config: DenseConfig) -> dict[str, Any]:
    """Least times of a keyframe in the middle: Steps one by one and together, and Open3D's TSDF.

    "processor" is processor time on one thread, "wall" what the clock says on two. They take
    turns, ROUNDS times, since a busy machine is now slower, now faster.
    """
    single = _Single(steps, run, config)
    works = single.works()
    together: dict[str, Callable[[], Any]] = {
        "all Steps": single.all_steps,
        "TSDF": lambda: open3d_points(run, steps.keyframes),
    }
    processor = dict.fromkeys([*works, *together], np.inf)
    wall, threads = dict.fromkeys(together, np.inf), torch.get_num_threads()
    for _ in range(ROUNDS):
        for name, work in {**works, **together}.items():
            torch.set_num_threads(1)
            processor[name] = min(processor[name], _took_ms(work, time.process_time))
            torch.set_num_threads(2)
            if name in together:
                wall[name] = min(wall[name], _took_ms(work, time.perf_counter))
    torch.set_num_threads(threads)
    for times in (processor, wall):
        times["TSDF"] /= len(steps.keyframes)
    return {"processor": processor, "wall": wall, "load": os.getloadavg()[0]}


def _took_ms(work: Callable[[], Any], clock: Callable[[], float]) -> float:
    started_s = clock()
    work()
    return 1e3 * (clock() - started_s)


class _Single:
    """The Steps of the keyframe in the middle, their input made."""

    def __init__(self, steps: Steps, run: MappedRun, config: DenseConfig) -> None:
        i = len(steps.keyframes) // 2
        own = steps.keyframes[i]
        index = {k.id: n for n, k in enumerate(steps.keyframes)}
        window = [k for k in steps.keyframes[max(i - 6, 0) : i + 7] if k is not own]
        T = inverse(own.T_world_camera)
        maps = [regularise(m) for m in steps.raw]
        self._depth_m, self._camera, self._noise = own.depth_m, run.camera, config.noise
        self._image = steps.images[i].float()
        self._views = [
            View(maps[index[k.id]], T @ k.T_world_camera, steps.images[index[k.id]].float())
            for k in neighbours(own, window, 6)
        ]

    def works(self) -> dict[str, Callable[[], Any]]:
        """Each Step alone."""
        raw = self._sensor()
        step3 = regularise(raw)
        step4 = self._fused(step3)
        step5 = stated(regularise(step4.map), step4)
        return {
            "sensor": self._sensor,
            "Step 3": lambda: regularise(raw),
            "Step 4": lambda: self._fused(step3),
            "Step 5": lambda: stated(regularise(step4.map), step4),
            "Step 6": lambda: self._points(step5),
        }

    def all_steps(self) -> Any:
        """From the sensor's depth to points and normals."""
        fused = self._fused(regularise(self._sensor()))
        return self._points(stated(regularise(fused.map), fused))

    def _sensor(self) -> Map:
        return from_sensor(self._depth_m, self._camera, self._noise)

    def _fused(self, own: Map) -> Fused:
        return fuse(own, self._views, self._camera, self._image)

    def _points(self, given: Map) -> Any:
        return back_project(given, self._camera), surface_normals(given, self._camera)


# --- report ----------------------------------------------------------------------------------


def measure(run: MappedRun, options: MapOptions) -> dict[str, Any]:
    """Everything, as plain data."""
    truths, config = read_truth(run), dense_config(options)
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
    mine = np.stack([cloud[c] for c in "xyz"], axis=1).astype(float)
    return {
        "keyframes": len(run.keyframes),
        "depth": depth,
        "depth_where_measured": shared,
        "depth_of_a_patchy_sensor": patchy(run, truths, config),
        "ms": times,
        "surface": {"cloud": surface_errors(mine, true), "tsdf": surface_errors(points, true)},
        "labels": label_errors(cloud, true),
    }


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
            f"  after / before: rmse {rmse:.3f}, coverage {coverage:.3f} (at most "
            f"{1 / before['coverage']:.3f}), outliers {outliers:.3f}; nees {after['chi2']:.3f}\n"
        )
    surfaces = result["surface"]
    yield f"{'against the true surface':32}" + "".join(f"{n:>17}" for n in surfaces["cloud"])
    for name, row in surfaces.items():
        yield f"  {name:30}" + "".join(f"{value:17.4g}" for value in row.values())
    yield "labels: " + ", ".join(f"{k} {v:.4f}" for k, v in result["labels"].items())
    ms = result["ms"]
    yield f"ms a 640x480 keyframe, least of {ROUNDS}; load of the machine {ms['load']:.1f}"
    for title, times in (
        ("processor time, one thread", ms["processor"]),
        ("on the clock, two threads", ms["wall"]),
    ):
        yield f"  {title}: " + ", ".join(f"{k} {v:.0f}" for k, v in times.items())
        yield f"    all Steps in {times['all Steps'] / times['TSDF']:.2f} times the TSDF's"
    yield ""


DEPTHS = {
    "depth": "depth, every pixel",
    "depth_where_measured": "depth, where the sensor has any",
    "depth_of_a_patchy_sensor": "depth, a fifth of it lost",
}


def prepared(root: Path, room: str) -> tuple[Path, Path]:
    """The sequence of a room and its run under a folder, made if they are not there."""
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
