"""What the semantics cost where nothing moves, also when the masks are wrong.

    python benchmarks/no_harm.py SEQUENCE [SEQUENCE ...] [--repeats 4]

Each sequence is static. It is run without semantics and without the check of what moves
("nothing"), with the check alone ("geometry"), with the network's masks, with masks that are drawn
at random ("random": up to eight ellipses a keyframe, half of them people), and with the network's
masks under each other's names ("shuffled": what was a chair is a person to the system). Any change
of the keypoints moves an ATE by a tenth or more, so each is run several times, with a keypoint or
two more or fewer and with other random masks and names: the mean ATE, its range, and how much
larger the mean is than with nothing. Last the change over all sequences: the mean of the logarithms
of all runs' ratios to the mean with nothing, and its standard error.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from zlib import crc32

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.report import table
from graph.camera import Camera
from semantics.instances import Instance, certain, mask_box
from semantics.labels import LabelSet
from semantics.segmenter import Image, NoSegmenter, Segmenter
from semantics.segmenter_table import SegmenterOptions, make_segmenter
from slam.configuration import resolve
from slam.features import FeatureConfig
from slam.runner import RunOptions, run
from slam.system import SlamSystem
from slam.system_config import SystemConfig

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


def keypoints(seed: int) -> str:
    """The setting of a few keypoints more or fewer than usual."""
    return (
        f"features.max_keypoints={FeatureConfig().max_keypoints + (seed + 1) // 2 * (-1) ** seed}"
    )


def ate_m(sequence: Path, segmenter: Segmenter, settings: list[str]) -> float:
    """The error of a run."""
    config = resolve(SystemConfig, None, settings)

    def make(camera: Camera, config: SystemConfig) -> SlamSystem:
        return SlamSystem(camera, config, segmenter)

    with TemporaryDirectory() as folder:
        summary = run(RunOptions(sequence, config, out=Path(folder) / "run", quiet=True), make)
    return {row["name"]: row["value"] for row in summary.rows}["ate_rmse"]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--repeats", type=int, default=4)
    arguments = parser.parse_args()
    network = make_segmenter(SegmenterOptions("light"), Path())
    off = ["dynamics.labels=false", "dynamics.geometry=false"]
    variants: dict[str, tuple[Callable[[int], Segmenter], list[str]]] = {
        "nothing": (lambda seed: NoSegmenter(), off),
        "geometry": (lambda seed: NoSegmenter(), []),
        "network": (lambda seed: network, []),
        "random": (lambda seed: RandomMasks(network.labels, seed), []),
        "shuffled": (lambda seed: ShuffledLabels(network, seed), []),
    }
    rows = []
    changes: dict[str, list[float]] = {name: [] for name in variants}
    for sequence in arguments.sequences:
        base_m = float("nan")
        for name, (segmenter, settings) in variants.items():
            errors_m = [
                ate_m(sequence, segmenter(seed), [*settings, keypoints(seed)])
                for seed in range(arguments.repeats)
            ]
            mean_m = float(np.mean(errors_m))
            base_m = mean_m if name == "nothing" else base_m
            changes[name] += np.log(np.array(errors_m) / base_m).tolist()
            change = f"{100 * (mean_m / base_m - 1):+.1f} %"
            span = f"{1e3 * min(errors_m):.2f} to {1e3 * max(errors_m):.2f}"
            rows.append((sequence.name, name, f"{1e3 * mean_m:.2f}", span, change))
    for name, logs in changes.items():
        error = np.std(logs, ddof=1) / np.sqrt(len(logs))
        change = f"{100 * np.expm1(np.mean(logs)):+.1f} +- {100 * error:.1f} %"
        rows.append(("all", name, "", f"{len(logs)} runs", change))
    print(table(("sequence", "with", "ATE mm", "of which", "change"), rows))


if __name__ == "__main__":
    main()
