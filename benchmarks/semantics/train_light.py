r"""Train the light network's weights that come with the project (data/weights/light.safetensors).

    python -m benchmarks.semantics.train_light --out runs/light [--steps 4000] [--weights F]
    python -m benchmarks.semantics.train_light --photographs --seed 1 --out runs/bench/masks-1
    python -m benchmarks.semantics.train_light --detected --seed 1 --out runs/bench/light-1 \
        --weights runs/bench/masks-1/weights.safetensors

Learns from the COCO excerpt, without the share that is held out for testing, and from rooms that
it renders to ``--rooms`` first. Goes on from its last checkpoint if it was stopped. --weights
starts from a network that was trained before; with --only boxes --crowd 0.5 its RPN and box head
alone go on, and see images with many objects more often. --photographs: the project's weights go
on with masks alone, on the excerpt alone, for use with another detector's boxes. --detected: the
MaskIoU head alone goes on, in the boxes and masks that come of YOLOX-Nano on the excerpt's
photographs.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from benchmarks.paths import ROOT, SHARED
from bmask_slam.cli import main as slam
from bmask_slam.runtime.progress import console_log, counting_bar
from bmask_slam.semantics.instances.coco_files import read_coco
from bmask_slam.semantics.segmenters.yolox import YoloxDetector
from bmask_slam.semantics.training.dataset import Dataset, split
from bmask_slam.semantics.training.detected import DetectedConfig, collect, train_maskiou
from bmask_slam.semantics.training.loop import WEIGHTS as WEIGHTS_NAME
from bmask_slam.semantics.training.run import Source, TrainingRun, run_training
from bmask_slam.semantics.weights.checkpoints import load_network, save_network

DATA = SHARED
WEIGHTS = ROOT / "data" / "weights" / "light.safetensors"
HELD_OUT = 0.28
SPLIT_SEED = 0
"""Always the same images are held out, since networks start from others that have seen the rest."""
ROOMS = range(32)
VIEWS = ("--fps", "0.5", "--people", "2", "--quiet")
STEPS, RATE = 4000, 1e-3
PHOTOGRAPHS_STEPS, PHOTOGRAPHS_RATE = 300, 5e-4
EDGES = tuple(f"backbone.body.features.{k}." for k in range(4))
"""The body's blocks up to stride 4 stay as ImageNet made them; on photographs alone all do."""


def rooms(folder: Path) -> list[Source]:
    """Sixteen views of each room, rendered where they are not there yet."""
    for seed in ROOMS:
        if not (folder / str(seed) / "annotations.json").is_file():
            slam(["render", "room", "--seed", str(seed), *VIEWS, "--out", str(folder / str(seed))])
    return [Source(folder / str(k) / "annotations.json", folder / str(k)) for k in ROOMS]


def training(arguments: argparse.Namespace) -> TrainingRun:
    """What the command line asks for."""
    alone = arguments.photographs
    steps, rate = (PHOTOGRAPHS_STEPS, PHOTOGRAPHS_RATE) if alone else (STEPS, RATE)
    weights = arguments.weights or (WEIGHTS if alone else None)
    excerpt = DATA / "coco_excerpt"
    coco = Source(excerpt / "instances.json", excerpt / "images", HELD_OUT, SPLIT_SEED)
    settings = {
        "steps": arguments.steps or steps,
        "rate": arguments.rate or rate,
        "seed": arguments.seed,
        "batch": 4,
        "body_rate": 0.4,
        "rois": "objects",
        "only": arguments.only or ("masks" if alone else ""),
        "crowd": arguments.crowd,
    }
    return TrainingRun(
        (coco,) if alone else (coco, *rooms(arguments.rooms)),
        arguments.out,
        weights,
        not alone,
        None if weights else DATA / "weights" / "mobilenet_v2_imagenet_folded.pth",
        "coco_paper",
        ("backbone.body",) if alone else EDGES,
        settings,
    )


def in_detected_boxes(arguments: argparse.Namespace, progress: Callable[[int, int], None]) -> Path:
    """The MaskIoU head's last stage; returns the weights file."""
    network = load_network(arguments.weights or WEIGHTS)
    head = network.model.eval().roi_heads.maskiou_head
    assert head is not None
    excerpt = DATA / "coco_excerpt"
    content, _ = split(read_coco(excerpt / "instances.json"), HELD_OUT, SPLIT_SEED)
    photographs = Dataset(content, excerpt / "images", network.labels)
    detector = YoloxDetector(DATA / "weights" / "yolox_nano.onnx")
    config = DetectedConfig(seed=arguments.seed)
    found = collect(
        network.model, photographs, lambda i: detector.detect(i, network.labels), config, progress
    )
    train_maskiou(head, found, config, progress)
    arguments.out.mkdir(parents=True, exist_ok=True)
    save_network(network, arguments.out / WEIGHTS_NAME)
    return arguments.out / WEIGHTS_NAME


def main() -> None:
    """Render, train."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rooms", type=Path, default=ROOT / "runs" / "bench" / "rooms")
    parser.add_argument(
        "--weights", type=Path, help="to start from, instead of ImageNet's MobileNetV2"
    )
    parser.add_argument("--steps", type=int)
    parser.add_argument("--rate", type=float)
    parser.add_argument("--seed", type=int, default=0, help="of batches and augmentation")
    parser.add_argument("--photographs", action="store_true")
    parser.add_argument("--only", default="", choices=("", "boxes", "masks", "maskiou"))
    parser.add_argument(
        "--crowd",
        type=float,
        default=0.0,
        help="power of an image's number of objects in its chance to be drawn",
    )
    parser.add_argument("--detected", action="store_true")
    arguments = parser.parse_args()
    with console_log(), counting_bar(False) as progress:
        if arguments.detected:
            print(in_detected_boxes(arguments, progress))
        else:
            print(run_training(training(arguments), progress))


if __name__ == "__main__":
    main()
