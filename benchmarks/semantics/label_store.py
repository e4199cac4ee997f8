"""Time of an update of the label store with a keyframe's votes on many landmarks.

    python -m benchmarks.semantics.label_store [--landmarks 1000] [--repeats 300]

With the light network's classes; every landmark has a vote of its own, with a weight of its own.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter


def update_ms(landmarks: int, classes: int, repeats: int) -> list[float]:
    """The times of updates of the same landmarks, each with other votes."""
    rng = np.random.default_rng(0)
    store, ids = LabelStore(classes, LabelStoreConfig()), np.arange(landmarks)
    times_ms = []
    for _ in range(repeats):
        votes = rng.dirichlet(np.ones(classes), landmarks).astype(np.float32)
        weights = rng.random(landmarks).astype(np.float32)
        start_s = time.perf_counter()
        store.update(ids, votes, weights)
        times_ms.append(1e3 * (time.perf_counter() - start_s))
    return times_ms


def main() -> None:
    """Print median and 95 % of the times."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--landmarks", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=300)
    arguments = parser.parse_args()
    classes = len(make_segmenter(SegmenterOptions("light"), Path()).labels)
    times_ms = update_ms(arguments.landmarks, classes, arguments.repeats)
    median, high = np.percentile(times_ms, (50, 95))
    what = f"{arguments.landmarks} landmarks, {classes} classes"
    print(f"{what}: median {median:.2f} ms, 95 % {high:.2f} ms")


if __name__ == "__main__":
    main()
