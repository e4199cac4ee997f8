"""``bmask-slam train``: the segmentation network on a COCO data set."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

TEXT = "train the segmentation network on images with masks"
MORE = """\
Starts from --weights, or as a light network from --backbone. --out gets weights.safetensors,
losses.csv, losses.png and a checkpoint, from which the same command goes on."""


def add_train(commands: _Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("train", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_train)
    parser.add_argument("--data", type=Path, required=True, action="append", metavar="F",
                        help="COCO file; may be repeated")  # fmt: skip
    parser.add_argument("--images", type=Path, required=True, action="append", metavar="DIR",
                        help="the file's images, one folder for each --data")  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to make")
    parser.add_argument("--weights", metavar="F", help="weights to start from, or torchvision:NAME")
    parser.add_argument(
        "--backbone", type=Path, metavar="F", help="ImageNet MobileNetV2 to start a light one from"
    )
    parser.add_argument(
        "--labels", default="coco", metavar="F", help="classes to learn: file, or coco, paper"
    )
    parser.add_argument(
        "--held-out", type=float, default=0.0, metavar="S", help="share of images kept for testing"
    )
    parser.add_argument("--freeze", action="append", default=[], metavar="NAME",
                        help="parameters to keep, by the beginning of their names, such as "
                        "backbone.body; may be repeated")  # fmt: skip
    parser.add_argument(
        "--only", choices=("boxes", "masks", "maskiou"), default="",
        help="boxes: RPN and box head alone; masks: all but these; maskiou: this head alone",
    )  # fmt: skip
    parser.add_argument(
        "--rois",
        choices=("proposals", "objects"),
        default="proposals",
        help="where masks are learnt; objects: in boxes around the objects themselves",
    )
    parser.add_argument("--optimiser", choices=("adamw", "sgd"), default="adamw")
    parser.add_argument("--steps", type=int, default=2000, metavar="N", help="batches (2000)")
    parser.add_argument("--batch", type=int, default=2, metavar="N", help="images a batch (2)")
    parser.add_argument(
        "--rate", type=float, default=5e-4, metavar="R", help="learning rate (5e-4)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of split, batches and augmentation")
    parser.add_argument("--quiet", action="store_true", help="print only the weights' path")


def _train(arguments: argparse.Namespace) -> int:
    from bmask_slam.datasets.weights import find_weights
    from bmask_slam.graph.errors import InputError
    from bmask_slam.runtime.progress import console_log, counting_bar
    from bmask_slam.semantics.training.run import Source, TrainingRun, run_training

    if len(arguments.data) != len(arguments.images):
        raise InputError(
            f"--data is given {len(arguments.data)} times, --images {len(arguments.images)} times; "
            "give one folder of images for each file"
        )
    pairs = zip(arguments.data, arguments.images, strict=True)
    data = tuple(Source(file, images, arguments.held_out) for file, images in pairs)
    given = {name: getattr(arguments, name) for name in ("out", "backbone", "labels")}
    weights = find_weights(arguments.weights) if arguments.weights else None
    numbers = ("only", "rois", "optimiser", "steps", "batch", "rate", "seed")
    settings = {name: getattr(arguments, name) for name in numbers}
    run = TrainingRun(
        data, **given, weights=weights, freeze=tuple(arguments.freeze), settings=settings
    )
    with console_log(), counting_bar(arguments.quiet) as progress:
        made = run_training(run, progress)
    print(made if arguments.quiet else f"Weights     {made}")
    return 0
