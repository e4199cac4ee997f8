"""``bmask-slam segment``, ``train`` and ``evaluate-segmentation``: masks of images."""

from __future__ import annotations

import argparse
from pathlib import Path

from bmask_slam.commands.arguments import (
    Commands,
    add_output_arguments,
    add_segmenter_arguments,
    print_result,
    segmenter_options,
)

SEGMENT = "find the objects in a sequence's images and keep their masks"
SEGMENT_MORE = """\
--out gets annotations.json (COCO's format, masks as run lengths, both scores and the class
distribution of every instance), a file an image in images/, and pictures in overlays/. Images
that are done are not done again."""
EVALUATE = "compare a segmenter's masks with annotated images"
EVALUATE_MORE = """\
Box and mask AP as COCO defines them, masks ranked by class score and by class score x MaskIoU,
and how well the predicted mask IoU follows the true one."""
TRAIN = "train the segmentation network on images with masks"
TRAIN_MORE = """\
Starts from --weights, or as a light network with new heads. --out gets weights.safetensors,
losses.csv, losses.png and a checkpoint, from which the same command goes on."""


def add_segment(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("segment", help=SEGMENT, description=f"{SEGMENT}. {SEGMENT_MORE}")
    parser.set_defaults(handler=_segment)
    parser.add_argument("source", type=Path, metavar="INPUT", help="sequence, or folder of images")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for masks")
    add_segmenter_arguments(parser, "light")
    parser.add_argument(
        "--min-score", type=float, default=0.5, metavar="S", help="class score (default: 0.5)"
    )
    parser.add_argument("--no-overlays", action="store_true", help="masks only, no pictures")
    add_output_arguments(parser, "the file's path")


def _segment(arguments: argparse.Namespace) -> int:
    from bmask_slam.datasets.weights import find_weights
    from bmask_slam.labelling.upright_images import samples
    from bmask_slam.runtime.progress import counting_bar
    from bmask_slam.semantics.instances.image_files import read_colour
    from bmask_slam.semantics.segmenters.mask_cache import CacheOptions, cache_masks
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
    from bmask_slam.semantics.segmenters.upright import Upright
    from bmask_slam.sequences.lists import colour_images

    source: Path = arguments.source
    options = segmenter_options(arguments, SegmenterOptions(min_score=arguments.min_score))
    settings = {**options.described(), "source": str(source.resolve())}
    cache = CacheOptions(arguments.out, settings, not arguments.no_overlays)
    with counting_bar(arguments.quiet) as progress:
        files = colour_images(source)
        known = Upright(samples=samples(lambda k: read_colour(files[k][1]), len(files)))
        segmenter = make_segmenter(options, source, find_weights, known)
        result = cache_masks(segmenter, files, cache, progress)
    text = f"{result.instances} instances in {result.images} images, {result.reused} of them reused"
    text += f"\n{result.broken} broken images were left out" if result.broken else ""
    text += f"\nMasks       {result.file}"
    print_result(arguments, result.file, lambda: text, vars(result))
    return 0


def add_evaluate_segmentation(commands: Commands) -> None:
    """Add the command to the parser."""
    name = "evaluate-segmentation"
    parser = commands.add_parser(name, help=EVALUATE, description=f"{EVALUATE}. {EVALUATE_MORE}")
    parser.set_defaults(handler=_evaluate)
    parser.add_argument("--data", type=Path, required=True, metavar="F", help="COCO file")
    parser.add_argument("--images", type=Path, required=True, metavar="DIR", help="its images")
    add_segmenter_arguments(parser, "light")
    parser.add_argument(
        "--held-out", type=float, metavar="S", help="only the share that train --held-out S left"
    )
    parser.add_argument("--seed", type=int, default=0, help="of that split")
    parser.add_argument("--plot", type=Path, metavar="F", help="picture of precision and recall")
    parser.add_argument("--curves", type=Path, metavar="F", help="the same as a table (CSV)")
    parser.add_argument("--quiet", action="store_true", help="no bar")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def _evaluate(arguments: argparse.Namespace) -> int:
    from bmask_slam.datasets.weights import find_weights
    from bmask_slam.graph.files.whole_file import check_target
    from bmask_slam.runtime.progress import counting_bar
    from bmask_slam.semantics.instances.coco_files import read_coco
    from bmask_slam.semantics.segmenters.evaluation import (
        draw_precision_recall,
        evaluate_segmenter,
        format_segmentation,
        write_curves,
    )
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
    from bmask_slam.semantics.training.dataset import split

    for path in filter(None, (arguments.plot, arguments.curves)):
        check_target(path)
    options = segmenter_options(arguments, SegmenterOptions(min_score=0.0))
    with counting_bar(arguments.quiet) as progress:
        truth = read_coco(arguments.data)
        if arguments.held_out is not None:
            _, truth = split(truth, arguments.held_out, arguments.seed)
        segmenter = make_segmenter(options, arguments.images, find_weights)
        result = evaluate_segmenter(segmenter, truth, arguments.images, progress)
    if arguments.plot:
        draw_precision_recall(result, arguments.plot)
    if arguments.curves:
        write_curves(result, arguments.curves)
    text = format_segmentation(result)
    told = {k: v for k, v in vars(result).items() if k not in ("curves", "iou_pairs")}
    told["precision"] = [
        {k: v for k, v in vars(c).items() if k != "precision"} for c in result.curves
    ]
    print_result(arguments, text, lambda: text, told)
    return 0


def add_train(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("train", help=TRAIN, description=f"{TRAIN}. {TRAIN_MORE}")
    parser.set_defaults(handler=_train)
    parser.add_argument("--data", type=Path, required=True, action="append", metavar="F",
                        help="COCO file; may be repeated")  # fmt: skip
    parser.add_argument("--images", type=Path, required=True, action="append", metavar="DIR",
                        help="the file's images, one folder for each --data")  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to make")
    parser.add_argument("--weights", metavar="F", help="weights to start from, or torchvision:NAME")
    parser.add_argument(
        "--backbone", type=Path, metavar="F", help="ImageNet MobileNetV2 to start a network from"
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
    add_output_arguments(parser, "the weights' path")


def _train(arguments: argparse.Namespace) -> int:
    from bmask_slam.datasets.weights import find_weights
    from bmask_slam.graph.errors import InputError
    from bmask_slam.runtime.progress import counting_bar
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
    with counting_bar(arguments.quiet) as progress:
        made = run_training(run, progress)
    print_result(arguments, made, lambda: f"Weights     {made}", {"weights": made})
    return 0
