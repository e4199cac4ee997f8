"""Train the head that gives every pixel a class, whose weights come with the project.

    python -m benchmarks.semantics.train_stuff --out runs/stuff

The detector is the shipped one and stays as it is; the head learns from the official training
images of NYU Depth v2. The same seed gives the same weights on one kind of processor. Goes on from
its last checkpoint if it was stopped.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import torch

from benchmarks.semantics.nyuv2 import CLASSES, labelled, numbers
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.runtime.progress import console_log, counting_bar
from bmask_slam.semantics.labels import read_label_set
from bmask_slam.semantics.training.stuff import StuffTrainingConfig, train_stuff
from bmask_slam.semantics.weights.light_weights import SHIPPED, load_light
from bmask_slam.semantics.weights.stuff_weights import StuffNetwork, save_stuff

WEIGHTS = "stuff.safetensors"
BLOCK, EVERY, FIRST = 30, 300, 120
"""Of every EVERY image numbers, BLOCK are held out with --hold-out: neighbours show one room."""


def held_out(number: int) -> bool:
    """Whether a training image is held out to choose settings."""
    return FIRST <= number % EVERY < FIRST + BLOCK


def main() -> None:
    """Train; print the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=StuffTrainingConfig.steps)
    parser.add_argument("--seed", type=int, default=0, help="of head, batches and augmentation")
    parser.add_argument("--hold-out", action="store_true", help="leave a tenth of the rooms out")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    begin = time.perf_counter()
    chosen = [n for n in numbers("train") if not (arguments.hold_out and held_out(n))]
    images = list(labelled(chosen))
    config = StuffTrainingConfig(steps=arguments.steps, seed=arguments.seed)
    detector = load_light(data_path(*SHIPPED)).model.detector
    with console_log(), counting_bar(False) as progress:
        head = train_stuff(detector, images, CLASSES, arguments.out, config, progress)
    path = arguments.out / WEIGHTS
    save_stuff(StuffNetwork(head, read_label_set("nyu40")), path)
    minutes = (time.perf_counter() - begin) / 60
    print(
        f"{path}: {config.steps} steps of {config.batch} of {len(images)} official training images "
        f"of NYU Depth v2, seed {config.seed}, {minutes:.0f} minutes in one thread"
    )


if __name__ == "__main__":
    main()
