"""Train the heads of the light network, whose weights come with the project.

    python -m benchmarks.semantics.train_light --out runs/light

The detector is YOLOX-Nano as it was published; mask and MaskIoU head learn from the photographs of
the COCO excerpt that are not held out. The same seed gives the same weights on one kind of
processor. Goes on from its last checkpoint if it was stopped.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.paths import SHARED
from benchmarks.semantics.photographs import IMAGES, write_training
from bmask_slam.runtime.progress import console_log, counting_bar
from bmask_slam.semantics.training.run import Source, TrainingRun, run_training

DETECTOR = SHARED / "weights" / "yolox_nano.onnx"
STEPS, RATE, BATCH, CROWD = 2500, 1e-3, 4, 0.3


def main() -> None:
    """Train; print the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=0, help="of heads, batches and augmentation")
    arguments = parser.parse_args()
    data = arguments.out / "photographs.json"
    write_training(data)
    settings = {
        "steps": arguments.steps,
        "rate": RATE,
        "batch": BATCH,
        "crowd": CROWD,
        "seed": arguments.seed,
        "save_every": 50,
    }
    run = TrainingRun((Source(data, IMAGES),), arguments.out, backbone=DETECTOR, settings=settings)
    with console_log(), counting_bar(False) as progress:
        print(run_training(run, progress))


if __name__ == "__main__":
    main()
