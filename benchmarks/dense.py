"""Dense maps against the truth of rendered rooms: depth, surface, labels, time.

    bmask-slam render office --frames 150 --true-depth --out office && bmask-slam run office
    python benchmarks/dense.py office runs/office [--out runs/bench/dense-office.json]

Depth of the keyframes before and after fusion, what each Step brings, how honest the variance
is; then the cloud and Open3D's TSDF of the same keyframes and poses on the true surface.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from graph.geometry import Array, inverse, transform
from graph.metrics import align
from graph.ply import read_ply
from mapping.backprojection import back_project, surface_normals
from mapping.dense import DenseConfig, DenseKeyframe, neighbours
from mapping.fusion import Fused, fuse, stated
from mapping.inverse_depth import InverseDepthMap, from_sensor
from mapping.mesh import integrated
from mapping.regularisation import regularise
from mapping.submaps import nearest_a_voxel
from mapping.warping import View
from semantics.segmenter import CocoSegmenter
from semantics.segmenter_table import SegmenterOptions
from slam.dense_input import MappedRun, image_name, load, open_run
from slam.dense_mapping import MapOptions, dense_config
from slam.dense_run import map_run

OUTLIER_M = 0.05
F_SCORE_M = 0.01
VOXEL_M = 0.01
Map = InverseDepthMap


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """What a keyframe really sees: depth (H, W) and its pose in the estimate's world."""

    depth_m: NDArray[np.float32]
    T_world_camera: Array


def read_truth(run: MappedRun) -> list[Truth]:
    """True depth and poses of the keyframes, aligned to the estimate as a whole."""
    assert run.sequence.groundtruth is not None
    poses = run.sequence.groundtruth.poses_world_camera
    true = np.stack([poses[k.frame_index] for k in run.keyframes])
    mine = np.stack([k.T_world_camera for k in run.keyframes])
    T_mine_true = align(true[:, :3, 3], mine[:, :3, 3]).T_reference_estimate
    if len(mine) < 3:
        T_mine_true = mine[0] @ inverse(true[0])
    found = []
    for keyframe, T in zip(run.keyframes, true, strict=True):
        name = run.sequence.pairs.depth_files[keyframe.frame_index].name
        stored = cv2.imread(str(run.sequence.folder / "depth_true" / name), cv2.IMREAD_UNCHANGED)
        depth_m = (stored / run.camera.depth_scale).astype(np.float32)
        found.append(Truth(np.where(stored > 0, depth_m, np.nan), T_mine_true @ T))
    return found


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

    def __init__(self, run: MappedRun, config: DenseConfig) -> None:
        self.camera = run.camera
        self.keyframes: list[DenseKeyframe] = [load(run, k)[0] for k in run.keyframes]
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
        "Steps 3, 4, 5, honest variance": [stated(m, f) for m, f in zip(step5, step4, strict=True)],
        "without 3": [regularise(f.map) for f in without3],
        "without 4": [regularise(m) for m in step3],
        "two neighbours": [regularise(f.map) for f in two],
        "holes filled by the paper's 2": [
            regularise(f.map, 2) for f in steps.fused([regularise(m, 2) for m in steps.raw])
        ],
    }


# --- surface ---------------------------------------------------------------------------------


def surface(truths: list[Truth], run: MappedRun, max_depth_m: float = 5.0) -> dict[str, Any]:
    """Points and normals of the true surface that the keyframes see, and their labels."""
    points, normals, labels = [], [], []
    file = run.sequence.folder / "annotations.json"
    segmenter = CocoSegmenter(file) if file.is_file() else None
    for truth, keyframe in zip(truths, run.keyframes, strict=True):
        rho = torch.from_numpy(1 / truth.depth_m)
        grid = back_project(InverseDepthMap(rho, rho), run.camera)
        normal = surface_normals(grid)
        keep = (torch.isfinite(normal).all(-1) & (rho > 1 / max_depth_m)).numpy()
        image = np.zeros(truth.depth_m.shape, np.uint16)
        if segmenter is not None:
            rgb = np.zeros((*image.shape, 3), np.uint8)
            for instance in reversed(segmenter.segment(rgb, image_name(run, keyframe))):
                image[instance.mask] = instance.label
        labels.append(image[keep])
        points.append(transform(truth.T_world_camera, grid.numpy()[keep].astype(float)))
        normals.append(normal.numpy()[keep] @ truth.T_world_camera[:3, :3].T)
    p, n, label = (np.concatenate(a) for a in (points, normals, labels))
    kept = nearest_a_voxel(p.astype(np.float32), np.zeros(len(p), np.float32), VOXEL_M / 2)
    return {"points": p[kept], "normals": n[kept], "labels": label[kept]}


def surface_errors(points: Array, true: dict[str, Any]) -> dict[str, float]:
    """Distance to the true surface along its normal, and the F-score at 1 cm."""
    distance, index = cKDTree(true["points"]).query(points, workers=1)
    offset = points - true["points"][index]
    along = np.abs(np.einsum("ij,ij->i", offset, true["normals"][index]))
    near = distance < 3 * VOXEL_M
    error = np.where(near, along, distance)
    precision = float(np.mean(error < F_SCORE_M))
    thin = true["points"][
        nearest_a_voxel(
            true["points"].astype(np.float32), np.zeros(len(true["points"]), np.float32), VOXEL_M
        )
    ]
    back, index = cKDTree(points).query(thin, workers=1)
    recall = float(np.mean(back < F_SCORE_M))
    return {
        "points": len(points),
        "mean_distance_mm": 1e3 * float(np.mean(error)),
        "precision": precision,
        "recall": recall,
        "f_score": 2 * precision * recall / max(precision + recall, 1e-9),
    }


def open3d_points(run: MappedRun, steps: Steps) -> tuple[Array, float]:
    """Open3D's TSDF of the sensor's depth, and its milliseconds a keyframe."""
    views = [(k.depth_m, k.rgb, k.T_world_camera) for k in steps.keyframes]
    integrated(views[:1], run.camera, VOXEL_M, 4.0)
    started_s = time.process_time()
    volume = integrated(views, run.camera, VOXEL_M, 4.0)
    elapsed_ms = 1e3 * (time.process_time() - started_s) / len(views)
    cloud = volume.extract_point_cloud(weight_threshold=1.0)
    return cloud.point.positions.numpy().astype(float), elapsed_ms


def label_errors(cloud: dict[str, Any], true: dict[str, Any]) -> dict[str, float]:
    """Accuracy of the labels of points within 2 cm of the true surface, and the mean IoU."""
    points = np.stack([cloud[c] for c in "xyz"], axis=1).astype(float)
    distance, index = cKDTree(true["points"]).query(points, workers=1)
    near = distance < 0.02
    mine, real = cloud["label"][near].astype(int), true["labels"][index[near]].astype(int)
    classes = np.unique(real)
    ious = [np.sum((mine == c) & (real == c)) / np.sum((mine == c) | (real == c)) for c in classes]
    return {"accuracy": float(np.mean(mine == real)), "mean_iou": float(np.mean(ious))}


# --- time ------------------------------------------------------------------------------------


def step_times_ms(steps: Steps, run: MappedRun, config: DenseConfig) -> dict[str, float]:
    """Least processor time of each Step on one keyframe in the middle."""
    i = len(steps.keyframes) // 2
    step3 = [regularise(m) for m in steps.raw]
    single = _Single(steps, step3, i)
    fused = single.fuse()
    return {
        "sensor": _ms(lambda: from_sensor(steps.keyframes[i].depth_m, run.camera, config.noise)),
        "Step 3": _ms(lambda: regularise(steps.raw[i])),
        "Step 4": _ms(single.fuse),
        "Step 5": _ms(lambda: stated(regularise(fused.map), fused)),
        "Step 6": _ms(lambda: surface_normals(back_project(fused.map, run.camera))),
    }


class _Single:
    """Step 4 of one keyframe, all its input made."""

    def __init__(self, steps: Steps, maps: list[Map], i: int) -> None:
        own = steps.keyframes[i]
        index = {k.id: n for n, k in enumerate(steps.keyframes)}
        window = [k for k in steps.keyframes[max(i - 6, 0) : i + 7] if k is not own]
        T = inverse(own.T_world_camera)
        self._own, self._image, self._camera = maps[i], steps.images[i].float(), steps.camera
        self._views = [
            View(maps[index[k.id]], T @ k.T_world_camera, steps.images[index[k.id]].float())
            for k in neighbours(own, window, 6)
        ]

    def fuse(self) -> Fused:
        return fuse(self._own, self._views, self._camera, self._image)


def _ms(work: Callable[[], Any], repeats: int = 5) -> float:
    work()
    times = []
    for _ in range(repeats):
        started_s = time.process_time()
        work()
        times.append(time.process_time() - started_s)
    return 1e3 * min(times)


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
    points, tsdf_ms = open3d_points(run, steps)
    mine = np.stack([cloud[c] for c in "xyz"], axis=1).astype(float)
    return {
        "keyframes": len(run.keyframes),
        "depth": depth,
        "depth_where_measured": shared,
        "ms": {**times, "total": sum(times.values()), "open3d_tsdf": tsdf_ms},
        "surface": {"cloud": surface_errors(mine, true), "tsdf": surface_errors(points, true)},
        "labels": label_errors(cloud, true),
    }


def lines(result: dict[str, Any]) -> Iterator[str]:
    """The result as text."""
    for kind in ("depth", "depth_where_measured"):
        rows = result[kind]
        yield kind
        yield "  " + " " * 32 + "".join(f"{name:>16}" for name in rows["sensor"])
        for name, row in rows.items():
            yield f"  {name:32}" + "".join(f"{value:16.4f}" for value in row.values())
        before, after = rows["sensor"], rows["Steps 3, 4, 5, honest variance"]
        for name in ("rmse_mm", "coverage", "outlier_share"):
            yield f"  after / before, {name}: {after[name] / before[name]:.3f}"
    for name in ("ms", "labels"):
        yield f"{name}: " + ", ".join(f"{k} {v:.4g}" for k, v in result[name].items())
    for name, row in result["surface"].items():
        yield f"{name}: " + ", ".join(f"{k} {v:.4g}" for k, v in row.items())


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, help="also write the figures as JSON")
    args = parser.parse_args()
    options = MapOptions(args.run, args.sequence, SegmenterOptions("truth"), voxel_m=VOXEL_M)
    result = measure(open_run(args.run, args.sequence), options)
    print("\n".join(lines(result)))
    if args.out is not None:
        args.out.write_text(json.dumps(result, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
