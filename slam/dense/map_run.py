"""One call that makes a dense map of a run, from keyframes to pictures."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.dense.assembly import Progress, fuse_run, open_map
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.fusion import FusionCounts
from bmask_slam.dense.options import MapOptions
from bmask_slam.dense.products import FusedMap, Products, write_clouds, write_dense_mesh


@dataclass(frozen=True, eq=False)
class MapSummary:
    """How mapping ended.

    Attributes:
        folder: RUN/dense.
        counts: of keyframes.
        products: files, points and labels.
        products_s: time that these took.
    """

    folder: Path
    counts: FusionCounts
    products: Products
    products_s: float


def map_run(options: MapOptions, progress: Progress = lambda done, total: None) -> MapSummary:
    """Fuse what is not finished, then write the products.

    Raises:
        InputError: as for ``open_map`` and ``fuse_run``.
    """
    opened = open_map(options)
    counts = fuse_run(opened, progress)
    started_s = time.perf_counter()
    products = write_clouds(FusedMap.of(opened))
    if options.mesh:
        products.files.extend(write_dense_mesh(opened.run, opened.folder, options.voxel_m))
    summary = MapSummary(opened.folder.path, counts, products, time.perf_counter() - started_s)
    write_summary(opened.folder, summary)
    return summary


def write_summary(folder: DenseFolder, summary: MapSummary) -> None:
    """Write dense.json."""
    folder.write_text("dense.json", json.dumps(_rows(summary), indent=1) + "\n")


def _rows(summary: MapSummary) -> dict[str, object]:
    counts, products = summary.counts, summary.products
    return {
        "keyframes_fused": counts.fused,
        "keyframes_reused": counts.reused,
        "keyframes_left_out": counts.left_out,
        "fuse_ms_median": float(np.median(counts.fuse_ms)) if counts.fuse_ms else None,
        "points": products.points,
        "label_shares": products.label_shares,
        "products_s": round(summary.products_s, 3),
    }


def format_summary(summary: MapSummary) -> str:
    """A few lines for the command line."""
    counts, products = summary.counts, summary.products
    lines = [f"keyframes   {counts.fused} fused, {counts.reused} were finished"]
    if counts.left_out:
        lines[0] += f", {len(counts.left_out)} left out"
    if counts.fuse_ms:
        lines.append(f"fusion      {np.median(counts.fuse_ms):.0f} ms a keyframe (median)")
    lines.append(f"points      {products.points}")
    things = sorted(products.label_shares.items(), key=lambda item: -item[1])
    if len(things) > 1:
        lines.append("labels      " + ", ".join(f"{n} {100 * s:.1f} %" for n, s in things[:8]))
    lines.append(f"products    {', '.join(p.name for p in products.files)}")
    return "\n".join([*lines, f"Folder      {summary.folder}"])
