"""The effect of the semantics on accuracy in static scenes, also with wrong masks.

    python -m benchmarks.moving.no_harm [SEQUENCE ...] [--rooms 20-31] [--repeats 8] [--hand-eye]
        [--variants nothing network random shuffled none moments people] [--max-frames N]

Each sequence is static; ``--rooms`` are those of dynamic.py without people, of these seeds. Each is
run without semantics and without the check of what moves ("nothing"), as usual with the network's
masks ("network"), with masks that are drawn at random ("random": up to eight ellipses a keyframe,
half of them people), and with the network's masks with permuted classes ("shuffled": a chair may
be labelled as a person). If asked for, also without semantics ("none") and with what the network
finds in other frames, a random one for each image: of the sequence ("moments") or of Bonn's crowd,
where most masks are people ("people"). Any change of the keypoints moves an ATE by a tenth or more,
so each is run several times, with keypoints spread over a grid whose cells are a few pixels wider
or narrower, and every run has random masks and names of its own: the mean ATE, its range, and the
mean of the logarithms of the runs' ratios to the first variant on the same grid, as a change, with
its standard error. Last the same over all sequences, each of which counts alike.
``--hand-eye``: the reference is of another body on the camera, as the red kitchen's is.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Sequence
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
from benchmarks.paths import SHARED
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import evaluate
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.sequences.lists import colour_images
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

USUAL = ("nothing", "network", "random", "shuffled")
MOMENTS = {"moments": None, "people": SHARED / "bonn_crowd"}
"""Of which recording's frames masks are; None: the same."""
VARIANTS = (*USUAL, "none", *MOMENTS)
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


class OtherMoments:
    """The masks that another segmenter finds in random images of a recording, by an image's name.

    What all pixels are is that of the other image too.
    """

    def __init__(self, inner: Segmenter, folder: Path, seed: int) -> None:
        self.inner, self.labels, self.seed = inner, inner.labels, seed
        self.measured = getattr(inner, "measured", "")
        self._images = colour_images(folder)

    def segment(self, image: Image, name: str) -> list[Instance]:
        """Those of one of the recording's images."""
        rng = np.random.default_rng([self.seed, crc32(name.encode())])
        other, path = self._images[int(rng.integers(len(self._images)))]
        return self.inner.segment(read_colour(path), other)


def other_keypoints(repeat: int) -> str:
    """The setting of a slightly finer or coarser keypoint grid; 0: the default."""
    return f"features.bucket_px={FeatureConfig().bucket_px + (repeat + 1) // 2 * (-1) ** repeat}"


def ate_m(
    sequence: Path,
    segmenter: Segmenter,
    settings: list[str],
    with_body: bool = False,
    max_frames: int | None = None,
) -> float:
    """The error of a run."""
    config = resolve(SystemConfig, None, settings)

    def make(camera: Camera, config: SystemConfig) -> SlamSystem:
        return SlamSystem(camera, config, segmenter)

    with TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        options = RunOptions(sequence, config, out=out, quiet=True, max_frames=max_frames)
        run(options, make)
        return evaluate(out, sequence, with_body=with_body).value("ate_rmse")


@dataclass(frozen=True)
class Job:
    """A run: one of VARIANTS, number of the repeat, seed of random masks and names."""

    sequence: Path
    variant: str
    repeat: int
    seed: int
    with_body: bool
    max_frames: int | None


def measured_mm(job: Job) -> float:
    """ATE of one run."""
    torch.set_num_threads(1)
    off = (
        ["moving_objects.labels=false", "moving_objects.geometry=false"]
        if job.variant == "nothing"
        else []
    )
    usual = SystemConfig().semantics.segmenter
    options = SegmenterOptions("none") if job.variant in ("nothing", "none") else usual
    segmenter = make_segmenter(options, job.sequence)
    if job.variant == "random":
        segmenter = RandomMasks(segmenter.labels, job.seed)
    elif job.variant == "shuffled":
        segmenter = ShuffledLabels(segmenter, job.seed)
    elif job.variant in MOMENTS:
        folder = MOMENTS[job.variant] or job.sequence
        segmenter = OtherMoments(segmenter, folder, job.seed)
    settings = [*off, other_keypoints(job.repeat)]
    return 1e3 * ate_m(job.sequence, segmenter, settings, job.with_body, job.max_frames)


def change(ates_mm: Array, base_mm: Array) -> str:
    """By how much ATEs (sequences, repeats) are larger than others, and its standard error."""
    logs = np.log(ates_mm / base_mm)
    error = np.sqrt(logs.var(axis=1, ddof=1).sum() / logs.shape[1]) / len(logs)
    return f"{100 * np.expm1(logs.mean()):+.1f} ± {100 * error:.1f} %"


def report(groups: dict[str, Array], variants: Sequence[str]) -> str:
    """The table in Markdown, of ATEs (sequences, variants, repeats) by what they are of."""
    rows = []
    for name, ates_mm in groups.items():
        for k, variant in enumerate(variants):
            of_one = ates_mm[:, k]
            span = f"{of_one.min():.2f} to {of_one.max():.2f}"
            by = change(of_one, ates_mm[:, 0]) if k else ""
            rows.append((name, variant, f"{of_one.mean():.2f}", span, by))
    if len(groups) > 1:
        every = np.concatenate(list(groups.values()))
        for k, variant in enumerate(variants[1:], 1):
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
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=USUAL)
    parser.add_argument("--max-frames", type=int)
    arguments = parser.parse_args()
    variants, of_all = arguments.variants, (arguments.hand_eye, arguments.max_frames)
    groups = {path.name: [path] for path in arguments.sequences}
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        if arguments.rooms:
            first, last = map(int, arguments.rooms.split("-"))
            seeds = range(first, last + 1)
            into = partial(rendered, arguments.rendered, "nobody")
            groups[f"{len(seeds)} rooms"] = list(pool.map(into, seeds))
        sequences = [path for paths in groups.values() for path in paths]
        places = itertools.product(range(len(sequences)), variants, range(arguments.repeats))
        jobs = [
            Job(sequences[k], variant, repeat, SEED + k + repeat * len(sequences), *of_all)
            for k, variant, repeat in places
        ]
        errors_mm = np.array(list(pool.map(measured_mm, jobs)))
    by_sequence = errors_mm.reshape(len(sequences), len(variants), arguments.repeats)
    ends = np.cumsum([len(paths) for paths in groups.values()])[:-1]
    print(report(dict(zip(groups, np.split(by_sequence, ends), strict=True)), variants))


if __name__ == "__main__":
    main()
