"""The arguments that choose a segmenter, the same for every command that segments."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

SEGMENTERS = "light, mask-scoring-rcnn, precomputed, truth or none"


def add_segmenter_arguments(parser: argparse.ArgumentParser, default: str) -> None:
    """Add --segmenter and what the segmenters need; ``default`` is for the help alone."""
    parser.add_argument("--segmenter", metavar="NAME", help=f"{SEGMENTERS} (default: {default})")
    parser.add_argument("--weights", metavar="F", help="weights file, or torchvision:NAME")
    parser.add_argument(
        "--proposals", type=Path, metavar="F", help="YOLOX network in ONNX that finds the boxes"
    )
    parser.add_argument(
        "--masks", type=Path, metavar="F", help="of precomputed: COCO file or folder of label PNGs"
    )
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="segment on a Ray cluster: host:port, auto or local"
    )
    parser.add_argument("--labels", metavar="F", help="label set: file, or coco, coco91, paper")


def segmenter_options(arguments: argparse.Namespace, base: SegmenterOptions) -> SegmenterOptions:
    """The options with what was given on the command line; files by their absolute paths.

    Where a run's segmenter is not configured and --proposals is given, weak detections do not vote
    on labels: a detector of photographs is too often wrong there. In the red kitchen its weak books
    became the table.
    """
    from bmask_slam.labelling.config import SemanticsConfig

    given = {name: getattr(arguments, name) for name in ("weights", "labels", "ray")}
    given["name"] = arguments.segmenter
    for name in ("proposals", "masks"):
        path = getattr(arguments, name)
        given[name] = path.absolute() if path else None
    if arguments.proposals and base == SemanticsConfig().segmenter:
        given["min_score"] = SemanticsConfig.object_score
    if arguments.weights and Path(arguments.weights).is_file():
        given["weights"] = str(Path(arguments.weights).absolute())
    return replace(base, **{name: value for name, value in given.items() if value is not None})
