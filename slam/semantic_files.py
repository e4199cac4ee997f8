"""What a run says about the things in its map, as files, and read back."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graph.errors import InputError, finite_number
from graph.geometry import Array
from slam.landmark_cloud import LandmarkCloud
from slam.landmarks import Ints

LABELS = "labels.csv"
SEMANTIC_FILES = (LABELS,)
_COLUMNS = ("id", "label", "probability", "entropy", "views")


@dataclass(frozen=True, eq=False)
class LabelTable:
    """The labels of a run's landmarks, in the order of landmarks.ply.

    Attributes:
        ids: (N,) of the landmarks.
        labels: N class names, "unknown" for what is on no known object.
        probability: (N,) of the label.
        entropy: (N,) of the distribution over all labels, in nats.
        views: (N,) keyframes that said something.
    """

    ids: Ints
    labels: tuple[str, ...]
    probability: Array
    entropy: Array
    views: Ints


def write_labels(path: Path, cloud: LandmarkCloud) -> None:
    """Write a line a landmark."""
    assert cloud.labels is not None
    names, found = cloud.labels.names, cloud.labels.estimates
    rows = zip(
        cloud.ids.tolist(),
        [names.of_thing(label) for label in found.labels.tolist()],
        [f"{p:.5f}" for p in found.probability.tolist()],
        [f"{h:.5f}" for h in found.entropy.tolist()],
        found.views.tolist(),
        strict=True,
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        writer.writerows(rows)


def read_labels(run: Path) -> LabelTable:
    """The label table of a run folder.

    Raises:
        InputError: no such file, other columns, or a value that is no number.
    """
    path = run / LABELS
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a run that had a segmenter")
    with path.open(encoding="utf-8", newline="") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    if tuple(header) != _COLUMNS or any(len(row) != len(_COLUMNS) for row in rows):
        raise InputError(f"{path}: needs the columns {', '.join(_COLUMNS)}; run again")
    numbers = [
        [finite_number(row[k], f"{path}: line {n}") for k in (0, 2, 3, 4)]
        for n, row in enumerate(rows, 2)
    ]
    ids, probability, entropy, views = np.array(numbers, float).reshape(-1, 4).T
    names = tuple(row[1] for row in rows)
    return LabelTable(ids.astype(np.int64), names, probability, entropy, views.astype(np.int64))
