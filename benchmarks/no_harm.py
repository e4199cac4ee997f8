"""What the semantics cost where nothing moves, also when the masks are wrong.

    python benchmarks/no_harm.py SEQUENCE [SEQUENCE ...] [--repeats 8] [--hand-eye]

Each sequence is static. It is run without semantics and without the check of what moves
("nothing"), with the check alone ("geometry"), with the network's masks, with masks that are drawn
at random ("random": up to eight ellipses a keyframe, half of them people), and with the network's
masks under each other's names ("shuffled": what was a chair is a person to the system). Any change
of the keypoints moves an ATE by a tenth or more, so each is run several times, with keypoints
spread over a grid whose cells are a few pixels wider or narrower, and with other random masks and
names: the mean ATE, its range, and the mean of the logarithms of the runs' ratios to those with
nothing, as a change. Last the same over all sequences. Standard errors are of both sides' runs.
``--hand-eye``: the reference is of another body on the camera, as the red kitchen's is.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from zlib import crc32

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.report import table
from graph.camera import Camera
from graph.geometry import Array
from semantics.instances import Instance, certain, mask_box
from semantics.labels import LabelSet
from semantics.segmenter import Image, Segmenter
from semantics.segmenter_table import SegmenterOptions, make_segmenter
from slam.configuration import resolve
from slam.evaluation import evaluate
from slam.features import FeatureConfig
from slam.runner import RunOptions, run
from slam.system import SlamSystem
from slam.system_config import SystemConfig

VARIANTS = ("nothing", "geometry", "network", "random", "shuffled")
Job = tuple[Path, str, int, bool]
"""Sequence, one of VARIANTS, number of the repeat, whether the reference is of another body."""
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
    """The masks of another segmenter under each other's names."""

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
    """The setting of a grid that is a little finer or coarser than usual; 0: the usual one."""
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


def measured_mm(job: Job) -> float:
    """ATE of one run."""
    sequence, variant, repeat, with_body = job
    torch.set_num_threads(1)
    kind = "light" if variant in ("network", "random", "shuffled") else "none"
    segmenter = make_segmenter(SegmenterOptions(kind), sequence)
    if variant == "random":
        segmenter = RandomMasks(segmenter.labels, repeat)
    elif variant == "shuffled":
        segmenter = ShuffledLabels(segmenter, repeat)
    off = ["dynamics.labels=false", "dynamics.geometry=false"] if variant == "nothing" else []
    return 1e3 * ate_m(sequence, segmenter, [*off, other_keypoints(repeat)], with_body)


def change(ates_mm: Array, base_mm: Array) -> str:
    """By how much ATEs (sequences, repeats) are larger than others, and its standard error."""
    logs, base = np.log(ates_mm), np.log(base_mm)
    variance = (logs.var(axis=1, ddof=1) + base.var(axis=1, ddof=1)) / logs.shape[1]
    error = np.sqrt(variance.sum()) / len(logs)
    return f"{100 * np.expm1((logs - base).mean()):+.1f} ± {100 * error:.1f} %"


def report(names: Sequence[str], ates_mm: Array) -> str:
    """The table in Markdown, of ATEs (sequences, VARIANTS, repeats)."""
    rows = []
    for name, errors_mm in zip(names, ates_mm, strict=True):
        for variant, of_one in zip(VARIANTS, errors_mm, strict=True):
            span = f"{of_one.min():.2f} to {of_one.max():.2f}"
            by = change(of_one[None], errors_mm[:1]) if variant != VARIANTS[0] else ""
            rows.append((name, variant, f"{of_one.mean():.2f}", span, by))
    for k, variant in enumerate(VARIANTS[1:], 1):
        of_all = f"{ates_mm[:, k].size} runs"
        rows.append(("all", variant, "", of_all, change(ates_mm[:, k], ates_mm[:, 0])))
    return table(("sequence", "with", "ATE mm", "of which", "change"), rows)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--hand-eye", action="store_true")
    arguments = parser.parse_args()
    repeats, bodies = range(arguments.repeats), (arguments.hand_eye,)
    jobs = list(itertools.product(arguments.sequences, VARIANTS, repeats, bodies))
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        errors_mm = np.array(list(pool.map(measured_mm, jobs)))
    shape = (len(arguments.sequences), len(VARIANTS), arguments.repeats)
    print(report([path.name for path in arguments.sequences], errors_mm.reshape(shape)))


if __name__ == "__main__":
    main()
