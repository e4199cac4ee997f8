"""The effect of the semantics on accuracy in static scenes, also with wrong masks.

    python -m benchmarks.moving.no_harm [SEQUENCE ...] [--rooms 20-31] [--repeats 8] [--hand-eye]

Each sequence is static; ``--rooms`` are those of dynamic.py without people, of these seeds. Each is
run without semantics and without the check of what moves ("nothing"), as usual with the network's
masks ("network"), with masks that are drawn at random ("random": up to eight ellipses a keyframe,
half of them people), and with the network's masks with permuted classes ("shuffled": a chair may
be labelled as a person). Any change of the keypoints moves an ATE by a tenth or more, so
each is run several times, with keypoints spread over a grid whose cells are a few pixels wider or
narrower, and every run has random masks and names of its own: the mean ATE, its range, and the mean
of the logarithms of the runs' ratios to that with nothing on the same grid, as a change, with its
standard error. Last the same over all sequences, each of which counts alike.
``--hand-eye``: the reference is of another body on the camera, as the red kitchen's is.
"""

from __future__ import annotations

import argparse
import itertools
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from zlib import crc32

import cv2
import numpy as np
import torch

from benchmarks.moving.dynamic import rendered
from benchmarks.pages import table
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import evaluate
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

VARIANTS = ("nothing", "network", "random", "shuffled")
SEED = 1000
"""The first seed of random masks and names; not used in development."""
SCORES = (0.5, 0.95)
MOST, RADII_PX = 8, (20, 120)


class RandomMasks:
    """Ellipses of any class, half of them people; an image has the same ones each time."""

    def __init__(self, labels: LabelSet, seed: int) -> None:
        self.labels, self.seed = labels, seed

    def segment(self, image: Image, name: str) -> list[Instance]:
        """Up to eight."""
        rng = np.random.default_rng([self.seed, crc32(name.encode())])
        found = []
        height, width = image.shape[:2]
        for _ in range(int(rng.integers(0, MOST + 1))):
            mask = np.zeros((height, width), np.uint8)
            centre = (int(rng.integers(width)), int(rng.integers(height)))
            radii = rng.integers(*RADII_PX, 2).tolist()
            cv2.ellipse(mask, centre, radii, float(rng.uniform(0, 180)), 0, 360, 1, -1)
            person = rng.random() < 0.5
            label = self.labels.number("person") if person else rng.integers(1, len(self.labels))
            score = float(rng.uniform(*SCORES))
            distribution = certain(int(label), len(self.labels), score)
            shape = mask > 0
            found.append(
                Instance(shape, mask_box(shape), int(label), distribution, score, 0.8 * score)
            )
        return found


class ShuffledLabels:
    """The masks of another segmenter with permuted classes."""

    def __init__(self, inner: Segmenter, seed: int) -> None:
        self.inner, self.labels = inner, inner.labels
        shift = 1 + np.random.default_rng(seed).permutation(len(inner.labels) - 1)
        self._other = np.r_[0, shift]

    def segment(self, image: Image, name: str) -> list[Instance]:
        """As many as the other segmenter finds."""
        return [
            replace(
                found,
                label=int(self._other[found.label]),
                distribution=found.distribution[np.argsort(self._other)],
            )
            for found in self.inner.segment(image, name)
        ]


def other_keypoints(repeat: int) -> str:
    """The setting of a slightly finer or coarser keypoint grid; 0: the default."""
    return f"features.bucket_px={FeatureConfig().bucket_px + (repeat + 1) // 2 * (-1) ** repeat}"


def ate_m(
    sequence: Path, segmenter: Segmenter, settings: list[str], with_body: bool = False
) -> float:
    """The error of a run."""
    config = resolve(SystemConfig, None, settings)

    def make(camera: Camera, config: SystemConfig) -> SlamSystem:
        return SlamSystem(camera, config, segmenter)

    with TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        run(RunOptions(sequence, config, out=out, quiet=True), make)
        return evaluate(out, sequence, with_body=with_body).value("ate_rmse")


@dataclass(frozen=True)
class Job:
    """A run: one of VARIANTS, number of the repeat, seed of random masks and names."""

    sequence: Path
    variant: str
    repeat: int
    seed: int
    with_body: bool


def measured_mm(job: Job) -> float:
    """ATE of one run."""
    torch.set_num_threads(1)
    off = (
        ["moving_objects.labels=false", "moving_objects.geometry=false"]
        if job.variant == "nothing"
        else []
    )
    kind = "none" if job.variant == "nothing" else "light"
    segmenter = make_segmenter(SegmenterOptions(kind), job.sequence)
    if job.variant == "random":
        segmenter = RandomMasks(segmenter.labels, job.seed)
    elif job.variant == "shuffled":
        segmenter = ShuffledLabels(segmenter, job.seed)
    settings = [*off, other_keypoints(job.repeat)]
    return 1e3 * ate_m(job.sequence, segmenter, settings, job.with_body)


def change(ates_mm: Array, base_mm: Array) -> str:
    """By how much ATEs (sequences, repeats) are larger than others, and its standard error."""
    logs = np.log(ates_mm / base_mm)
    error = np.sqrt(logs.var(axis=1, ddof=1).sum() / logs.shape[1]) / len(logs)
    return f"{100 * np.expm1(logs.mean()):+.1f} ± {100 * error:.1f} %"


def report(groups: dict[str, Array]) -> str:
    """The table in Markdown, of ATEs (sequences, VARIANTS, repeats) by what they are of."""
    rows = []
    for name, ates_mm in groups.items():
        for k, variant in enumerate(VARIANTS):
            of_one = ates_mm[:, k]
            span = f"{of_one.min():.2f} to {of_one.max():.2f}"
            by = change(of_one, ates_mm[:, 0]) if k else ""
            rows.append((name, variant, f"{of_one.mean():.2f}", span, by))
    if len(groups) > 1:
        every = np.concatenate(list(groups.values()))
        for k, variant in enumerate(VARIANTS[1:], 1):
            of_all = f"{every[:, k].size} runs"
            rows.append(("all", variant, "", of_all, change(every[:, k], every[:, 0])))
    return table(("sequence", "with", "ATE mm", "of which", "change"), rows)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequences", type=Path, nargs="*")
    parser.add_argument("--rooms", help="seeds, as 20-31")
    parser.add_argument("--rendered", type=Path, default=Path("runs/bench"), help="where they lie")
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--hand-eye", action="store_true")
    arguments = parser.parse_args()
    hand_eye = arguments.hand_eye
    groups = {path.name: [path] for path in arguments.sequences}
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        if arguments.rooms:
            first, last = map(int, arguments.rooms.split("-"))
            seeds = range(first, last + 1)
            into = partial(rendered, arguments.rendered, "nobody")
            groups[f"{len(seeds)} rooms"] = list(pool.map(into, seeds))
        sequences = [path for paths in groups.values() for path in paths]
        places = itertools.product(range(len(sequences)), VARIANTS, range(arguments.repeats))
        jobs = [
            Job(sequences[k], variant, repeat, SEED + k + repeat * len(sequences), hand_eye)
            for k, variant, repeat in places
        ]
        errors_mm = np.array(list(pool.map(measured_mm, jobs)))
    by_sequence = errors_mm.reshape(len(sequences), len(VARIANTS), arguments.repeats)
    ends = np.cumsum([len(paths) for paths in groups.values()])[:-1]
    print(report(dict(zip(groups, np.split(by_sequence, ends), strict=True))))


if __name__ == "__main__":
    main()
