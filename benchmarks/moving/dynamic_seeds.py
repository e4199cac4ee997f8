"""What people who walk do to the trajectory, over several rooms full of people and several runs.

    python -m benchmarks.moving.dynamic_seeds [--sequences runs/bench] [--seeds 6,7,8] [--repeats 3]

The scenes are those of dynamic.py, masks are the light network's. Any change of the keypoints moves
an ATE by a tenth or more, so each is run several times, with keypoints spread over a grid whose
cells are a pixel or two wider or narrower.
"both" (labels and geometry) is compared with the same camera path without people and with
"nothing": mean of the logarithms of the ratios of all runs to the mean of the other side in the
same room, and its standard error; "worst" and "least" are of the rooms.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import torch

from benchmarks.moving.dynamic import SCENES, VARIANTS, rendered
from benchmarks.moving.no_harm import ate_m, other_keypoints
from benchmarks.pages import table
from bmask_slam.graph.arrays import Array
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter

Job = tuple[Path, str, int]
"""Sequence, name of the variant, number of the repeat."""


def measured_mm(job: Job) -> float:
    """ATE of one run."""
    sequence, variant, repeat = job
    torch.set_num_threads(1)
    labels, geometry = VARIANTS[variant]
    settings = [
        f"moving_objects.labels={labels}",
        f"moving_objects.geometry={geometry}",
        other_keypoints(repeat),
    ]
    segmenter = make_segmenter(SegmenterOptions("light" if labels else "none"), sequence)
    return 1e3 * ate_m(sequence, segmenter, settings)


def ratio(above: Array, below: Array) -> tuple[float, float, Array]:
    """Ratio of ATEs (seeds, repeats): mean, relative standard error, and each seed's (seeds,)."""
    logs = np.log(above) - np.log(below).mean(axis=1, keepdims=True)
    spread = np.stack([np.log(above).var(axis=1, ddof=1), np.log(below).var(axis=1, ddof=1)])
    error = np.sqrt(spread.sum(axis=0).sum() / above.shape[1]) / len(above)
    return float(np.exp(logs.mean())), float(error), np.exp(logs.mean(axis=1))


def report(ates_mm: dict[tuple[str, str], Array]) -> str:
    """The table in Markdown, of ATEs (seeds, repeats) by scene and variant."""
    clean = ates_mm["nobody", "nothing"]
    rows = []
    for scene in SCENES:
        nothing, both = ates_mm[scene, "nothing"], ates_mm[scene, "both"]
        cells = [f"{values.mean():.2f}" for values in (nothing, both)]
        mean, error, seeds = ratio(both, clean)
        cells += [f"{mean:.2f} ± {mean * error:.2f}", f"{seeds.max():.2f}"]
        mean, error, seeds = ratio(nothing, both)
        cells += [f"{mean:.1f} ± {mean * error:.1f}", f"{seeds.min():.1f}"]
        rows.append((scene, *cells))
    header = (
        "scene",
        "nothing mm",
        "both mm",
        "both, x clean",
        "worst",
        "nothing, x both",
        "least",
    )
    return table(header, rows)


def main(argv: Sequence[str] | None = None) -> None:
    """Render what is not there, run all, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sequences", type=Path, default=Path("runs/bench"))
    parser.add_argument("--seeds", default="6,7,8", help="separated by commas")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args(argv)
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    variants = list(itertools.product(SCENES, ("nothing", "both")))
    jobs: list[Job] = [
        (rendered(arguments.sequences, scene, seed), variant, repeat)
        for scene, variant in variants
        for seed in seeds
        for repeat in range(arguments.repeats)
    ]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        errors_mm = np.array(list(pool.map(measured_mm, jobs)))
    shape = (len(variants), len(seeds), arguments.repeats)
    print(report(dict(zip(variants, errors_mm.reshape(shape), strict=True))))


if __name__ == "__main__":
    main()
