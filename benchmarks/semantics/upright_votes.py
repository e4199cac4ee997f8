"""How surely, and after how many images, the side of the images that is up is found.

    python -m benchmarks.semantics.upright_votes [FOLDER ...] [--every 9]

Of each recording every ninth image, turned each way: beginning with any of them, the rule of
`semantics.segmenters.upright` is told what the light network finds, for a camera that is mounted
with each side up. Of NYU Depth v2, every third photograph.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.pages import table
from benchmarks.paths import SHARED
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import SIDES
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.segmenters.light_segmenter import LightSegmenter
from bmask_slam.semantics.segmenters.upright import UpVotes, sample, turned
from bmask_slam.semantics.weights.light_weights import SHIPPED, load_light
from bmask_slam.sequences.lists import colour_images

RECORDINGS = ("redkitchen", "bonn_crowd", "tum_fr1_rpy")
NYU, EVERY_PHOTOGRAPH = "nyuv2", 3
BLANK = np.zeros((1, 1, 3), np.uint8)


class Found:
    """Tells what was found before."""

    def __init__(self, evidence: Array) -> None:
        self._evidence = iter(np.ravel(evidence).tolist())

    def evidence(self, image: object) -> float:
        """What was found in the next image."""
        return float(next(self._evidence))


def evidence_of(files: list[Path], network: LightSegmenter) -> Array:
    """What the network finds (N, 4) in images, turned each way."""
    small = [sample(read_colour(file)) for file in files]
    ways = range(len(SIDES))
    return np.array([[network.evidence(turned(image, k)) for k in ways] for image in small])


def settled(evidence: Array) -> tuple[str, int]:
    """The side that images with this evidence (N, 4) settle, and after how many."""
    votes = UpVotes(Found(evidence))
    for number in range(1, len(evidence) + 1):
        if side := votes.add(BLANK):
            return side, number
    return "", len(evidence)


def row(name: str, evidence: Array) -> tuple[str, ...]:
    """A row: for each side, the share of right answers, of wrong ones, and median images."""
    cells = []
    for k, side in enumerate(SIDES):
        mounted = np.roll(evidence, k, axis=1)
        told = [settled(np.roll(mounted, -first, axis=0)) for first in range(len(evidence))]
        right, wrong = (np.mean([t in answers for t, _ in told]) for answers in (
            (side,), tuple({*SIDES} - {side}),
        ))  # fmt: skip
        cells.append(
            f"{100 * right:.0f} % ({100 * wrong:.0f}), {np.median([n for _, n in told]):.0f}"
        )
    return name, str(len(evidence)), *cells


def main() -> None:
    """Print a row for each recording."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    default = [SHARED / name for name in RECORDINGS]
    parser.add_argument("folders", type=Path, nargs="*", default=default)
    parser.add_argument("--every", type=int, default=9)
    given = parser.parse_args()
    network = LightSegmenter(load_light(data_path(*SHIPPED)))
    rows = [
        row(
            folder.name, evidence_of([f for _, f in colour_images(folder)][:: given.every], network)
        )
        for folder in given.folders
    ]
    photographs = sorted((SHARED / NYU / "images").glob("*.jpg"))[::EVERY_PHOTOGRAPH]
    rows.append(row(NYU, evidence_of(photographs, network)))
    heads = (f"{side} is up: right (wrong), images" for side in SIDES)
    print(table(("images of", "number", *heads), rows))


if __name__ == "__main__":
    main()
