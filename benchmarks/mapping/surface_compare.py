"""The surface of a run beside Open3D's TSDF volume of the same frames and poses.

    python -m benchmarks.mapping.surface_compare [RUN[=true] ...] [--work DIR]

Without RUN it renders two rooms with different seeds, and runs them, the kitchen and Bonn by
default options, where these are not in DIR yet; ``make bench`` does that.

Open3D integrates all tracked frames at 1 cm with its default truncation of 8 voxels, and shows what
at least three frames saw; "with masks" means that the run's own segmenter cuts what can move out of
every frame. Each method runs in a process of its own, for its time and memory.

Flat patches: balls of 10 cm around places where a keyframe's depth is flat; rms of the vertices
about their own plane, median and 90th percentile, and the median angle of their normals to it.
Ghosts: vertices that more frames see through than see. Coverage: share of the fused keyframes'
points with a vertex within 2 cm. With =true, a rendered room: distance of the vertices to
the true surface, and the share of that which has a vertex within 2 and 5 cm.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from benchmarks.mapping.dense_surface import (
    VOXEL_M,
    distances_m,
    read_truth,
    surface,
    thinned,
)
from benchmarks.mapping.open3d_tsdf import DepthView, integrated
from benchmarks.pages import table
from benchmarks.paths import SHARED
from benchmarks.suite.measure import call, in_own_process, render
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.keyframe_input import load_keyframe, undistort_images
from bmask_slam.dense.map_run import map_run, open_fusion
from bmask_slam.dense.options import MapOptions
from bmask_slam.dense.saved_map import MappedRun, open_run
from bmask_slam.dense.surface import tracked_frames
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.mapping.products.surface_labels import dilate
from bmask_slam.runtime.memory import peak_rss_mb

TRUNCATION_VOXELS, MIN_FRAMES = 8.0, 3.0
PATCHES, PATCH_M, FLAT = 400, 0.1, (0.002, 0.004)
"""A keyframe's patch is flat if its rms is below 2 mm and 4 mm a square metre of depth."""
GHOST_STEP, GHOST_SAMPLE = 3, 40_000
RENDERED = {
    "office": ("office-300", ("--frames", "300", "--true-depth")),
    "living_room": ("living_room-3", ("--frames", "200", "--seed", "3", "--true-depth")),
}
REAL = {"redkitchen": "600", "bonn_crowd": "280"}
"""Real sequences, and how many of their frames."""


def ours(run: Path, out: Path) -> None:
    """The mesh by ``bmask-slam map --mesh``, from nothing."""
    shutil.rmtree(run / "dense", ignore_errors=True)
    summary = map_run(MapOptions(run, mesh=True))
    _save(summary.folder / "mesh.ply", out)


def open3d(run: Path, out: Path, masks: bool = False) -> None:
    """Open3D's mesh of all tracked frames."""
    views = _views(open_run(run), run if masks else None)
    volume = integrated(views, open_run(run).camera, VOXEL_M, TRUNCATION_VOXELS)
    mesh = volume.extract_triangle_mesh(weight_threshold=MIN_FRAMES).to_legacy()
    mesh.compute_vertex_normals()
    load_open3d().io.write_triangle_mesh(str(out.with_suffix(".ply")), mesh)
    _save(out.with_suffix(".ply"), out)


def open3d_masked(run: Path, out: Path) -> None:
    """The same with the segmenter's masks in every frame."""
    open3d(run, out, True)


METHODS: dict[str, Callable[[Path, Path], None]] = {
    "this": ours,
    "Open3D": open3d,
    "Open3D, masks": open3d_masked,
}


def _views(run: MappedRun, masked: Path | None) -> Iterator[DepthView]:
    fusion = open_fusion(MapOptions(masked)) if masked else None
    for index, T in tracked_frames(run):
        frame = run.sequence.load(index)
        rgb, depth_m = undistort_images(frame, run.camera)
        if fusion is not None:
            found = fusion.segmenter.segment(frame.rgb, frame.name)
            numbers = np.zeros(0, np.int64), np.zeros((0, 2))
            labelled = fusion._fusion.label_pixels(found, *numbers)
            depth_m = np.where(dilate(labelled.excluded), np.float32(np.nan), depth_m)
        yield DepthView(depth_m, rgb, T)


def _save(path: Path, out: Path) -> None:
    mesh = load_open3d().io.read_triangle_mesh(str(path))
    columns = {"v": mesh.vertices, "n": mesh.vertex_normals, "c": mesh.vertex_colors}
    arrays: dict[str, Any] = {n: np.asarray(values, np.float32) for n, values in columns.items()}
    np.savez(out, t=np.asarray(mesh.triangles), **arrays)


def run_method(method: str, run: Path, out: Path) -> dict[str, float]:
    """Make a mesh; wall and processor time of this process in s, its memory in MB."""
    started_s = time.perf_counter()
    METHODS[method](run, out)
    wall_s, used = time.perf_counter() - started_s, resource.getrusage(resource.RUSAGE_SELF)
    return {"wall s": wall_s, "cpu s": used.ru_utime + used.ru_stime, "MB": peak_rss_mb()}


def flat_patches(run: MappedRun) -> list[tuple[Array, Array]]:
    """Centres (3,) and normals (3,) of flat places that keyframes measured, in the world."""
    rng, found = np.random.default_rng(0), []
    keyframes = run.keyframes
    for keyframe in keyframes:
        depth_m = load_keyframe(run, keyframe)[0].depth_m
        for _ in range(20 * PATCHES // len(keyframes)):
            v, u = (int(rng.integers(40, size - 40)) for size in depth_m.shape)
            z = float(depth_m[v, u])
            reach = int(np.nan_to_num(PATCH_M * run.camera.fx / z)) // 2
            if not 4 <= reach < 40:
                continue
            rows, columns = np.mgrid[v - reach : v + reach + 1 : 2, u - reach : u + reach + 1 : 2]
            points = run.camera.backproject(
                np.stack([columns, rows], -1).astype(float), depth_m[rows, columns].astype(float)
            ).reshape(-1, 3)
            if not np.isfinite(points).all():
                continue
            rms, normal = _plane(points)
            if rms < FLAT[0] + FLAT[1] * z**2:
                T = keyframe.T_world_camera
                centre = transform(T, points.mean(axis=0)[None])[0]
                found.append((centre, T[:3, :3] @ normal))
    order = rng.permutation(len(found))[:PATCHES]
    return [found[k] for k in order.tolist()]


def _plane(points: Array) -> tuple[float, Array]:
    """Rms of points (N, 3) about their plane, and its normal."""
    _, s, vt = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    return float(s[2] / np.sqrt(len(points))), np.asarray(vt[2])


def patch_errors(mesh: dict[str, NDArray], patches: list[tuple[Array, Array]]) -> dict[str, float]:
    """Rms in mm and normals in degrees of a mesh's vertices on flat patches."""
    tree, rms_mm, angles = cKDTree(mesh["v"]), [], []
    for centre, _ in patches:
        near = tree.query_ball_point(centre, PATCH_M / 2)
        if len(near) < 20:
            continue
        rms, normal = _plane(mesh["v"][near].astype(float))
        rms_mm.append(1e3 * rms)
        cosine = np.abs(mesh["n"][near] @ normal).clip(0, 1)
        angles.append(float(np.degrees(np.median(np.arccos(cosine)))))
    return {
        "flat mm": float(np.median(rms_mm)),
        "90 % mm": float(np.quantile(rms_mm, 0.9)),
        "normals deg": float(np.median(angles)),
    }


def ghosts(mesh: dict[str, NDArray], run: MappedRun) -> float:
    """Share of vertices that more frames see through than see."""
    step = max(len(mesh["v"]) // GHOST_SAMPLE, 1)
    points = mesh["v"][::step].astype(float)
    seen, through = np.zeros(len(points)), np.zeros(len(points))
    for index, T in tracked_frames(run)[::GHOST_STEP]:
        depth_m = undistort_images(run.sequence.load(index), run.camera)[1]
        local = transform(inverse(T), points)
        front = local[:, 2] > 0.3
        pixels = np.zeros((len(points), 2), np.int64)
        pixels[front] = np.rint(run.camera.project(local[front])).astype(np.int64)
        inside = front & (
            (pixels >= 2) & (pixels < (run.camera.width - 2, run.camera.height - 2))
        ).all(1)
        least = cv2.erode(np.nan_to_num(depth_m), np.ones((5, 5), np.uint8))
        u, v = pixels[inside].T
        z, rows = local[inside, 2], np.flatnonzero(inside)
        through[rows] += least[v, u] > z + 0.1 + 0.03 * z
        seen[rows] += np.abs(depth_m[v, u] - z) < 0.05 + 0.01 * z
    return float(np.mean((through > seen) & (through >= 3)))


def components(mesh: dict[str, NDArray]) -> int:
    """Connected components of the triangles."""
    (a, b, c), count = mesh["t"].T, len(mesh["v"])
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    graph = coo_matrix((np.ones(len(ends[0]), np.int8), ends), (count, count))
    labels = connected_components(graph, directed=False)[1]
    return len(np.unique(labels[a]))


def fused_points(run: MappedRun) -> Array:
    """Points of the fused keyframes, two centimetres apart."""
    folder, parts = DenseFolder.open(run.path), []
    for keyframe in run.keyframes:
        if not folder.is_done(keyframe.id):
            continue
        depth_m = folder.fused(keyframe.id).depth_m()[::4, ::4].astype(float)
        v, u = np.mgrid[: run.camera.height : 4, : run.camera.width : 4].astype(float)
        known = np.isfinite(depth_m) & (depth_m < 5)
        points = run.camera.backproject(np.stack([u, v], -1)[known], depth_m[known])
        parts.append(transform(keyframe.T_world_camera, points))
    return thinned(np.concatenate(parts), 2 * VOXEL_M)


def coverage(mesh: dict[str, NDArray], points: Array, limit_m: float) -> float:
    """Share of points (N, 3) with a vertex within a limit."""
    return float(np.mean(cKDTree(mesh["v"]).query(points)[0] < limit_m))


def truth_errors(mesh: dict[str, NDArray], true: dict[str, Any]) -> dict[str, float]:
    """Distance of the vertices to the true surface in mm, along its normal where they are near."""
    error, points = distances_m(mesh["v"], true), thinned(true["points"], VOXEL_M)
    return {
        "mean mm": 1e3 * float(error.mean()),
        "95 % mm": 1e3 * float(np.quantile(error, 0.95)),
        "> 2 cm %": 100 * float((error > 0.02).mean()),
        "complete 2 cm %": 100 * coverage(mesh, points, 0.02),
        "complete 5 cm %": 100 * coverage(mesh, points, 0.05),
    }


def measure(
    run_path: Path, out: Path, methods: list[str], truth: bool
) -> dict[str, dict[str, float]]:
    """All measures of all methods."""
    run, rows = open_run(run_path), {}
    true = surface(read_truth(run), run) if truth else None
    patches, points = flat_patches(run), None
    for name in methods:
        file = out / f"{run_path.name}-{name.replace(', ', '-')}.npz"
        used = in_own_process(run_method, name, run_path, file)
        mesh = dict(np.load(file))
        points = fused_points(run) if points is None else points
        row = patch_errors(mesh, patches)
        row["ghosts %"] = 100 * ghosts(mesh, run)
        row["coverage %"] = 100 * coverage(mesh, points, 2 * VOXEL_M)
        row["components"] = components(mesh)
        if true is not None:
            row |= truth_errors(mesh, true)
        rows[name] = row | used
        shown = {k: round(v, 3) for k, v in rows[name].items()}
        print(run_path.name, name, shown, file=sys.stderr, flush=True)
    return rows


def table_of(title: str, rows: dict[str, dict[str, float]]) -> str:
    """The rows as Markdown."""
    names = list(next(iter(rows.values())))
    cells = ((method, *(f"{row[n]:.4g}" for n in names)) for method, row in rows.items())
    return f"{table((title, *names), cells)}\n"


def runs_of(work: Path) -> list[str]:
    """The runs to compare, made where they are missing, as the command line would name them."""
    found = []
    for name, (folder, options) in RENDERED.items():
        render(work / folder, name, options)
        found.append(f"{_run(work / folder, work, '300')}=true")
    return [str(_run(SHARED / name, work, most)) for name, most in REAL.items()] + found


def _run(sequence: Path, work: Path, most: str) -> Path:
    out = work / "surfaces" / sequence.name
    if not (out / "map").exists():
        command = ["-m", "bmask_slam", "run", str(sequence), "--max-frames", most]
        call([*command, "--out", str(out), "--overwrite", "--quiet"])
    return out


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="*", help="run folders; NAME=true for rendered rooms")
    parser.add_argument("--work", type=Path, default=Path("runs/bench"), help="for runs and meshes")
    parser.add_argument("--methods", default=";".join(METHODS), help="which (default: %(default)s)")
    args = parser.parse_args()
    out = args.work / "surfaces" / "meshes"
    out.mkdir(parents=True, exist_ok=True)
    for given in args.runs or runs_of(args.work):
        path, _, true = given.partition("=")
        rows = measure(Path(path), out, args.methods.split(";"), bool(true))
        print(table_of(Path(path).name, rows), flush=True)


if __name__ == "__main__":
    main()
