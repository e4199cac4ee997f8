"""Finding recordings, ground truth and trajectories in the folders where a user keeps them."""

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
class Site:
    """Where a sequence was found.

    Attributes:
        folder: with images; None without.
        reference: its ground truth; None without.
        problem: why there are no images and what to do; "" where there are.
    """

    folder: Path | None
    reference: Path | None
    problem: str = ""


def data_folders(given: Iterable[Path] = ()) -> tuple[Path, ...]:
    """The given folders, those of the environment variable BMASK_SLAM_DATA, and ``data``."""
    named = os.environ.get(ENVIRONMENT, "").split(os.pathsep)
    return tuple(dict.fromkeys([*given, *(Path(name) for name in named if name), DEFAULT]))


def find_site(
    source: SequenceSource,
    experiment: Experiment,
    folders: Iterable[Path],
    trajectories: list[Path],
) -> Site:
    """Look for a sequence that is not rendered, and for its ground truth.

    The truth is the source's own, the folder's, or ``NAME-groundtruth.txt`` in a data folder or
    beside one of the ``trajectories``.
    """
    roots = [experiment.file.parent, *folders]
    found = [p for root in roots for p in _places(root, source.folder) if p.is_dir()]
    with_images = (p for p in found if (p / "rgb.txt").is_file() or _associated(p))
    folder = next(with_images, None)
    beside = [path.parent for path in trajectories]
    truths = [source.reference] if source.reference else list(_truths(source, found, roots, beside))
    reference = next((p for p in truths if p.is_file()), None)
    if folder is not None:
        return Site(folder, reference)
    return Site(None, reference, _problem(source, found))


def find_file(name: str, experiment: Experiment, folders: Iterable[Path]) -> Path | None:
    """A file by its path from the experiment's file or a data folder on."""
    candidates = (root / name for root in (experiment.file.parent, *folders))
    return next((path for path in candidates if path.is_file()), None)


def _places(root: Path, name: str) -> Iterator[Path]:
    """``tum/freiburg1_xyz`` as such, by its last part, and as the archives call it."""
    path = Path(name)
    for prefix in PREFIXES:
        yield root / path.with_name(prefix + path.name)
        yield root / (prefix + path.name)


def _associated(folder: Path) -> bool:
    return (folder / "associations.txt").is_file()


def _truths(
    source: SequenceSource, found: list[Path], roots: list[Path], beside: list[Path]
) -> Iterator[Path]:
    yield from (folder / TRUTH for folder in found)
    last = Path(source.folder).name
    names = dict.fromkeys([source.name, last, last.replace("freiburg", "fr")])
    for root in (*roots, *beside):
        yield from (root / f"{name}{mark}{TRUTH}" for name in names for mark in "-_")
    yield from (folder / TRUTH for folder in beside)


def _problem(source: SequenceSource, found: list[Path]) -> str:
    if found:
        return f"{found[0]}: holds no rgb.txt; restore it, or give the folder of the images"
    cure = f"{source.folder}: not found; give DIR by --data, where DIR/{source.folder} lies"
    if source.folder in read_catalogue():
        cure += f", or bmask-slam download {source.folder} --to DIR"
    return cure
