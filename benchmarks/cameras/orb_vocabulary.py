"""A vocabulary of ORB descriptors for ORB-SLAM3, from photographs: its own is not on PyPI.

    python -m benchmarks.cameras.orb_vocabulary OUT.txt

As DBoW2's (Galvez-Lopez and Tardos 2012): a tree of ten branches and six levels by k-medians of
Hamming distances, words weighted by their inverse frequency in images; in the text format that
ORB-SLAM2 and 3 read. Made of all photographs of NYU Depth v2 and COCO in ``../shared``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks.paths import SHARED
from bmask_slam.graph.arrays import Bytes, Floats, Ints
from bmask_slam.graph.files.whole_file import whole_file

FOLDERS = ("nyuv2/images", "coco_excerpt/images")
BRANCHES, LEVELS, ROUNDS, SEED = 10, 6, 8, 1
FEATURES, SCALE, PYRAMID, THRESHOLD = 1000, 1.2, 8, 12
BYTES, AT_ONCE = 32, 50_000
L1_NORM, TF_IDF = 0, 0
"""Scoring and weighting, by their numbers in the file."""


def descriptors_of(files: list[Path]) -> tuple[Bytes, Ints]:
    """ORB descriptors (N, 32) of images, and the number (N,) of each one's image."""
    orb = cv2.ORB_create(FEATURES, SCALE, PYRAMID, fastThreshold=THRESHOLD)
    found, owners = [], []
    for number, file in enumerate(files):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None, f"{file}: no image"
        _, descriptors = orb.detectAndCompute(image, None)
        if descriptors is not None:
            found.append(descriptors)
            owners.append(np.full(len(descriptors), number))
    return np.concatenate(found), np.concatenate(owners)


def nearest(descriptors: Bytes, centres: Bytes) -> Ints:
    """The number (N,) of the nearest of centres (K, 32) for descriptors (N, 32)."""
    signs = _signs(centres).T
    parts = range(0, len(descriptors), AT_ONCE)
    return np.concatenate([
        (_signs(descriptors[k : k + AT_ONCE]) @ signs).argmax(axis=1) for k in parts
    ])  # fmt: skip


def _signs(descriptors: Bytes) -> Floats:
    """Bits (N, 256) as -1 and 1: products of two count what agrees."""
    return np.unpackbits(descriptors, axis=1).astype(np.float32) * 2 - 1


def clustered(descriptors: Bytes, rng: np.random.Generator) -> tuple[Bytes, Ints]:
    """Medians (K, 32) of at most BRANCHES clusters, and the cluster (N,) of each descriptor."""
    different = np.unique(descriptors, axis=0)
    if len(different) <= BRANCHES:
        return different, nearest(descriptors, different)
    centres = different[rng.choice(len(different), BRANCHES, replace=False)]
    cluster = nearest(descriptors, centres)
    for _ in range(ROUNDS):
        known = np.unique(cluster)
        bits = [np.unpackbits(descriptors[cluster == k], axis=1).mean(axis=0) > 0.5 for k in known]
        centres = np.packbits(np.array(bits), axis=1)
        before, cluster = cluster, nearest(descriptors, centres)
        if len(known) == BRANCHES and np.array_equal(before, cluster):
            break
    return centres, cluster


def lines_of(descriptors: Bytes, owners: Ints) -> Iterator[str]:
    """The lines of the file, parents before children: parent, is it a word, descriptor, weight."""
    yield f"{BRANCHES} {LEVELS} {L1_NORM} {TF_IDF}"
    rng, images = np.random.default_rng(SEED), owners.max() + 1
    level = [(0, np.arange(len(descriptors)))]
    made = 0
    for depth in range(1, LEVELS + 1):
        below = []
        for parent, rows in level:
            centres, cluster = clustered(descriptors[rows], rng)
            for k, centre in enumerate(centres):
                own = rows[cluster == k]
                made += 1
                is_word = depth == LEVELS or len(own) <= BRANCHES
                if not is_word:
                    below.append((made, own))
                seen = max(len(np.unique(owners[own])), 1)
                weight = np.log(images / seen) if is_word else 0.0
                values = " ".join(map(str, centre.tolist()))
                yield f"{parent} {int(is_word)} {values} {weight:.6g}"
        level = below


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    files = [file for folder in FOLDERS for file in sorted((SHARED / folder).iterdir())]
    descriptors, owners = descriptors_of(files)
    lines = list(lines_of(descriptors, owners))
    given.out.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(given.out) as temporary:  # no line end at the end: it would be read as a node
        temporary.write_text("\n".join(lines), encoding="ascii")
    print(f"{given.out}: {len(lines) - 1} nodes of {len(descriptors)} descriptors")


if __name__ == "__main__":
    main()
