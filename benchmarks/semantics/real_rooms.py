"""Labels and objects of real rooms against truth that was written by eye.

    python -m benchmarks.semantics.real_rooms [--out runs/bench/rooms] [--runs DIR ...] [--verbose]

The truth (tests/data/*_truth.json; each says how it was made) has positions in the frame of the
recording's reference trajectory, so it judges any run: a run is aligned by the poses of all its
frames. A landmark counts if a point of the truth is within the file's tolerance; its label is right
if it is one of that point's, be it a thing of COCO or a surface of NYU40. An object is right if it
is of the class of a true one, its centre within half the true one's largest extent (10 cm to 50 cm)
of the true centre, its largest extent within a factor of 3 of the true one's; one to one. Doubtful
things (a booklet on a wall as a book) count neither as right nor as wrong. The calibration error
(ECE) is that of labelled landmarks in ten bins of probability. Surfaces are what the network that
gives every pixel a class says that landmarks lie on.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from benchmarks.pages import table
from benchmarks.paths import SHARED
from benchmarks.semantics.labels import calibration_error
from benchmarks.semantics.room_truth import read_truth
from benchmarks.suite.measure import call
from bmask_slam.comparison.jobs.truth_figures import truth_from_world
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.files.reading import read_table
from bmask_slam.graph.geometry import transform
from bmask_slam.graph.trajectory import associate, read_tum
from bmask_slam.run_folder.reader import Run
from bmask_slam.run_folder.semantic_files import LABELS, SavedObject
from bmask_slam.sequences.cameras import read_camera

ROOMS = ("redkitchen", "bonn_crowd", "tum_fr1_rpy")
UNKNOWN = ("unknown", "background")
CENTRE_M, EXTENT_FACTOR = (0.1, 0.5), 3.0
PEOPLE = "person"
HEADER = (
    "room", "landmarks at points", "labelled", "of them right", "ECE", "on things: labelled right",
    "surfaces known", "of them right", "objects", "right", "precision", "true", "recall", "persons",
)  # fmt: skip


@dataclass(frozen=True)
class Labels:
    """Of the landmarks at points of the truth.

    Attributes:
        count, labelled: of all; decided: of the labelled ones, those that are not doubtful.
        right: of those, the right ones. ece: their calibration error.
        things, things_right: landmarks on things of COCO; those of them with the right label.
        surfaces, surfaces_right: landmarks of which it is said what they lie on, where the truth
            knows that; the right ones of them.
        wrong: number by (what it is, label).
    """

    count: int
    labelled: int
    decided: int
    right: int
    ece: float
    things: int
    things_right: int
    surfaces: int
    surfaces_right: int
    wrong: Counter[tuple[str, str]]


@dataclass(frozen=True)
class Objects:
    """Objects: reported ones that are not doubtful, right ones, true ones, persons; with names."""

    reported: int
    right: int
    true: int
    persons: int
    lines: tuple[str, ...]


def main() -> None:
    """Run the rooms by default options, unless runs are given, and print a table of both."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/bench/rooms"))
    parser.add_argument("--runs", type=Path, nargs="*", help="of these recordings, instead")
    parser.add_argument("--set", action="append", default=[], metavar="A.B=C")
    parser.add_argument("--verbose", action="store_true", help="each object and wrong label")
    arguments = parser.parse_args()
    runs = arguments.runs or [run_room(name, arguments.out, arguments.set) for name in ROOMS]
    rows = []
    for path in runs:
        run = Run(path)
        assert run.sequence is not None
        name = run.sequence.name
        truth = read_truth(name, read_camera(run.path / "camera.yaml"))
        T_truth_world = aligned(run, SHARED / name)
        labels = score_labels(run, truth, T_truth_world)
        objects = score_objects(run.objects, truth, T_truth_world)
        rows.append(row(name, labels, objects))
        if arguments.verbose:
            print("\n".join(objects.lines))
            print(*(f"{n:5} {a} is no {b}" for (a, b), n in labels.wrong.most_common()), sep="\n")
    print(table(HEADER, rows))


def run_room(name: str, out: Path, settings: Sequence[str]) -> Path:
    """Make a run of a recording; returns its folder."""
    options = [f"--set={text}" for text in settings]
    where = [str(SHARED / name), "--out", str(out / name), "--overwrite", "--quiet"]
    call(["-m", "bmask_slam", "run", *where, *options])
    return out / name


def aligned(run: Run, folder: Path) -> Array:
    """T_truth_world (4, 4) by the poses of all frames."""
    estimate, truth = associate(run.trajectory, read_tum(folder / "groundtruth.txt"))
    return truth_from_world(estimate.poses_world_camera, truth.poses_world_camera)


def score_labels(run: Run, truth: dict[str, Any], T_truth_world: Array) -> Labels:
    """Compare the labels of landmarks with the points of the truth."""
    found, kinds = run.landmarks, truth["kinds"]
    assert found.labels is not None
    assert found.probabilities is not None
    points = transform(T_truth_world, found.points_world)
    places = np.array([point[:3] for point in truth["points"]])
    distance_m, nearest = KDTree(places).query(points, distance_upper_bound=truth["tolerance_m"])
    near = np.flatnonzero(np.isfinite(distance_m))
    sure, correct, wrong = [], [], Counter[tuple[str, str]]()
    labelled = things = things_right = 0
    for k in near.tolist():
        kind, label = truth["points"][nearest[k]][6], str(found.labels[k])
        true, known = kinds[kind], label not in UNKNOWN
        right = label in true["things"] or label in true["surfaces"]
        things += bool(true["things"])
        things_right += bool(true["things"]) and right
        labelled += known
        if known and label not in true["doubtful"]:
            sure.append(found.probabilities[k])
            correct.append(right)
            wrong[kind, label] += not right
    surfaces = surfaces_right = 0
    columns = read_table(run.path / LABELS, ("label",), "run again")
    for k in near.tolist():
        true = kinds[truth["points"][nearest[k]][6]]
        told = columns["surface"][k] if "surface" in columns else UNKNOWN[0]
        if told not in UNKNOWN and true["surfaces"]:
            surfaces += 1
            surfaces_right += told in true["surfaces"]
    ece = calibration_error(np.array(sure), np.array(correct, float))[0] if sure else np.nan
    wrong = Counter({pair: n for pair, n in wrong.items() if n})
    counts = (len(near), labelled, len(sure), sum(correct))
    return Labels(*counts, ece, things, things_right, surfaces, surfaces_right, wrong)


def score_objects(
    found: Sequence[SavedObject], truth: dict[str, Any], T_truth_world: Array
) -> Objects:
    """Match objects to true ones of their class, one to one, nearest first."""
    known = [o for o in found if o.label not in UNKNOWN]
    true = truth["objects"]
    cost = np.full((len(known), len(true)), np.inf)
    for a, o in enumerate(known):
        centre = transform(T_truth_world, o.box.T_world_box[:3, 3])
        for b, t in enumerate(true):
            largest_m = max(t["size_m"])
            apart_m = float(np.linalg.norm(centre - t["centre_m"]))
            ratio = float(o.box.size_m.max()) / largest_m
            near = apart_m <= np.clip(0.5 * largest_m, *CENTRE_M)
            alike = 1 / EXTENT_FACTOR <= ratio <= EXTENT_FACTOR
            if o.label in t["labels"] and near and alike:
                cost[a, b] = apart_m + (0.0 if t["required"] else 1.0)
    rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e3))
    pairs = {a: b for a, b in zip(rows.tolist(), columns.tolist(), strict=True) if cost[a, b] < 1e3}
    right = sum(true[b]["required"] for b in pairs.values())
    missed = [t["name"] for b, t in enumerate(true) if t["required"] and b not in pairs.values()]
    lines = []
    for a, o in enumerate(known):
        told = true[pairs[a]]["name"] if a in pairs else "WRONG"
        place = transform(T_truth_world, o.box.T_world_box[:3, 3]).round(2).tolist()
        size, views = o.box.size_m.round(2).tolist(), len(o.keyframes)
        lines.append(f"{o.label} {o.id} ({o.probability:.2f}, {views}) {place} {size}: {told}")
    lines.append(f"missed: {', '.join(missed)}")
    doubtful = sum(not true[b]["required"] for b in pairs.values())
    persons = sum(o.label == PEOPLE for o in known)
    required = sum(t["required"] for t in true)
    return Objects(len(known) - doubtful, right, required, persons, tuple(lines))


def row(name: str, labels: Labels, objects: Objects) -> tuple[str, ...]:
    """A row of the table."""
    on_things = f"{share(labels.things_right, labels.things)} of {labels.things}"
    return (
        name, str(labels.count), share(labels.labelled, labels.count),
        share(labels.right, labels.decided), f"{labels.ece:.3f}", on_things,
        share(labels.surfaces, labels.count), share(labels.surfaces_right, labels.surfaces),
        str(objects.reported), str(objects.right), share(objects.right, objects.reported),
        str(objects.true), share(objects.right, objects.true), str(objects.persons),
    )  # fmt: skip


def share(part: int, whole: int) -> str:
    """A share in per cent."""
    return f"{100 * part / whole:.0f} %" if whole else "-"


if __name__ == "__main__":
    main()
