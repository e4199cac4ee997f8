"""Finding recordings, ground truth and trajectories in the user's data folders."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.comparison.experiment.experiment import Experiment, SequenceSource
from bmask_slam.datasets.catalogue import read_catalogue

ENVIRONMENT = "BMASK_SLAM_DATA"
DEFAULT = Path("data")
TRUTH = "groundtruth.txt"
PREFIXES = ("", "rgbd_dataset_", "rgbd_bonn_")  # of the folders in the archives


@dataclass(frozen=True)
class SequenceLocation:
    """Where a sequence was found.

    Attributes:
        folder: of the images; None if they were not found.
        reference: its ground truth; None if it was not found.
        problem: why there are no images, and the cure; "" if there are.
    """

    folder: Path | None
    reference: Path | None
    problem: str = ""


def data_folders(given: Iterable[Path] = ()) -> tuple[Path, ...]:
    """The given folders, those of the environment variable BMASK_SLAM_DATA, and ``data``."""
    named = os.environ.get(ENVIRONMENT, "").split(os.pathsep)
    return tuple(dict.fromkeys([*given, *(Path(name) for name in named if name), DEFAULT]))


def locate_sequence(
    source: SequenceSource,
    experiment: Experiment,
    folders: Iterable[Path],
    trajectories: list[Path],
) -> SequenceLocation:
    """Look for a sequence that is not rendered, and for its ground truth.

    The truth is the source's own, the folder's, or ``NAME-groundtruth.txt`` in a data folder or
    beside one of the ``trajectories``.
    """
    roots = [experiment.file.parent, *folders]
    found = [p for root in roots for p in _candidate_folders(root, source.folder) if p.is_dir()]
    lists = ("rgb.txt", "associations.txt")
    folder = next((p for p in found if any((p / name).is_file() for name in lists)), None)
    near = [path.parent for path in trajectories]
    truths = [source.reference] if source.reference else list(_truths(source, found, roots, near))
    reference = next((p for p in truths if p.is_file()), None)
    if folder is not None:
        return SequenceLocation(folder, reference)
    return SequenceLocation(None, reference, _problem(source, found))


def find_file(name: str, experiment: Experiment, folders: Iterable[Path]) -> Path | None:
    """A file by its path relative to the experiment's file or a data folder."""
    candidates = (root / name for root in (experiment.file.parent, *folders))
    return next((path for path in candidates if path.is_file()), None)


def _candidate_folders(root: Path, name: str) -> Iterator[Path]:
    """Paths for ``tum/freiburg1_xyz``: as given, by its last part, and with archives' prefixes."""
    path = Path(name)
    for prefix in PREFIXES:
        yield root / path.with_name(prefix + path.name)
        yield root / (prefix + path.name)


def _truths(
    source: SequenceSource, found: list[Path], roots: list[Path], near: list[Path]
) -> Iterator[Path]:
    yield from (folder / TRUTH for folder in found)
    last = Path(source.folder).name
    names = dict.fromkeys([source.name, last, last.replace("freiburg", "fr")])
    for root in (*roots, *near):
        yield from (root / f"{name}{mark}{TRUTH}" for name in names for mark in "-_")
    yield from (folder / TRUTH for folder in near)


def _problem(source: SequenceSource, found: list[Path]) -> str:
    if found:
        return f"{found[0]}: holds no rgb.txt; restore it or give the folder of the images"
    cure = f"{source.folder}: not found; give DIR by --data, where DIR/{source.folder} lies"
    if source.folder in read_catalogue():
        cure += f", or bmask-slam download {source.folder} --to DIR"
    return cure
