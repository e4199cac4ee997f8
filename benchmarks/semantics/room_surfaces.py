"""What surfaces of real rooms are called, against truth that was written by eye.

    python -m benchmarks.semantics.room_surfaces RUN ...

Runs of the recordings of ``real_rooms``, whose points of truth name the classes of NYU40 that are
right for them. Landmarks within the truth's tolerance of a point count, and, after
``bmask-slam map RUN``, the point of the dense cloud that is nearest to each; there the names of
things are right too where they are true. Unknown is no answer.
"""

from __future__ import annotations

import argparse
import csv
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from benchmarks.pages import table
from benchmarks.paths import SHARED
from benchmarks.semantics.labels import calibration_error
from benchmarks.semantics.real_rooms import UNKNOWN, aligned, share
from benchmarks.semantics.room_truth import read_truth
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import transform
from bmask_slam.run_folder.reader import Run
from bmask_slam.sequences.cameras import read_camera

HEADER = ("room", "of", "at points", "known", "of them right", "ECE")


def surfaces_of_landmarks(run: Run) -> tuple[list[str], Array]:
    """Names N and probabilities (N,) of what the landmarks lie on."""
    with (run.path / "labels.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = [row["surface"] for row in rows]
    return names, np.array([float(row["surface_probability"]) for row in rows])


def score(
    points: Array, names: list[str], p: Array, truth: dict[str, Any], things: bool
) -> tuple[list[str], Counter[tuple[str, str]]]:
    """Four columns of the table, and the wrong answers by (what it is, answer).

    ``points`` (N, 3) are in the truth's frame; with ``things`` their names count too.
    """
    places = np.array([point[:3] for point in truth["points"]])
    kinds = [point[6] for point in truth["points"]]
    sure, correct, wrong = [], [], Counter[tuple[str, str]]()
    count = 0
    distance_m, nearest = KDTree(places).query(points, distance_upper_bound=truth["tolerance_m"])
    near = np.flatnonzero(np.isfinite(distance_m))
    if things:  # of a cloud, the nearest point to each place
        best = near[np.lexsort((distance_m[near], nearest[near]))]
        near = best[np.unique(nearest[best], return_index=True)[1]]
    for k in near.tolist():
        kind = truth["kinds"][kinds[nearest[k]]]
        right = set(kind["surfaces"]) | (set(kind["things"]) if things else set())
        if not right or (things and names[k] in kind["doubtful"]):
            continue
        count += 1
        if names[k] not in UNKNOWN:
            sure.append(float(p[k]))
            correct.append(names[k] in right)
            wrong[kinds[nearest[k]], names[k]] += not correct[-1]
    ece = calibration_error(np.array(sure), np.array(correct, float))[0] if sure else np.nan
    columns = [str(count), share(len(sure), count), share(sum(correct), len(sure)), f"{ece:.3f}"]
    return columns, Counter({pair: n for pair, n in wrong.items() if n})


def main() -> None:
    """Print a table of the runs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--verbose", action="store_true", help="each wrong answer")
    arguments = parser.parse_args()
    rows = []
    for path in arguments.runs:
        run = Run(path)
        assert run.sequence is not None
        name = run.sequence.name
        truth = read_truth(name, read_camera(run.path / "camera.yaml"))
        T_truth_world = aligned(run, SHARED / name)
        landmarks = transform(T_truth_world, run.landmarks.points_world)
        parts = [("landmarks", *score(landmarks, *surfaces_of_landmarks(run), truth, False))]
        if (path / "dense" / "cloud.ply").is_file():
            cloud = run.dense_cloud
            points = transform(T_truth_world, cloud.points_world)
            names, p = cloud.labels.tolist(), cloud.probabilities
            parts.append(("dense cloud", *score(points, names, p, truth, True)))
        for what, columns, wrong in parts:
            rows.append((name, what, *columns))
            if arguments.verbose:
                print(*(f"{n:5} {a} is no {b}" for (a, b), n in wrong.most_common()), sep="\n")
    print(table(HEADER, rows))


if __name__ == "__main__":
    main()
