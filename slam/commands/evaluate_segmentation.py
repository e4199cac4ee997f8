"""``bmask-slam evaluate-segmentation``: COCO's figures for a segmenter."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

from bmask_slam.commands.segmenter_arguments import add_segmenter_arguments, segmenter_options

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

TEXT = "compare a segmenter's masks with annotated images"
MORE = """\
Box and mask AP as COCO defines them, masks ranked by class score and by class score x MaskIoU,
and how well the predicted mask IoU follows the true one."""


def add_evaluate_segmentation(commands: _Commands) -> None:
    """Add the command to the parser."""
    name = "evaluate-segmentation"
    parser = commands.add_parser(name, help=TEXT, description=f"{TEXT}. {MORE}")
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


def _evaluate(arguments: argparse.Namespace) -> int:
    from bmask_slam.datasets.weights import find_weights
    from bmask_slam.runtime.progress import console_log, counting_bar
    from bmask_slam.semantics.instances.coco_files import read_coco
    from bmask_slam.semantics.segmenters.evaluation import (
        draw_precision_recall,
        evaluate_segmenter,
        format_segmentation,
        write_curves,
    )
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
    from bmask_slam.semantics.training.dataset import split

    options = segmenter_options(arguments, SegmenterOptions(min_score=0.0))
    with console_log(), counting_bar(arguments.quiet) as progress:
        truth = read_coco(arguments.data)
        if arguments.held_out is not None:
            _, truth = split(truth, arguments.held_out, arguments.seed)
        segmenter = make_segmenter(options, arguments.images, find_weights)
        result = evaluate_segmenter(segmenter, truth, arguments.images, progress)
    if arguments.plot:
        draw_precision_recall(result, arguments.plot)
    if arguments.curves:
        write_curves(result, arguments.curves)
    print(format_segmentation(result))
    return 0
