"""``bmask-slam segment``: masks of a sequence's images, made once and kept."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

from bmask_slam.commands.segmenter_arguments import add_segmenter_arguments, segmenter_options

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

TEXT = "find the objects in a sequence's images and keep their masks"
MORE = """\
--out gets annotations.json (COCO's format, masks as run lengths, both scores and the class
distribution of every instance), a file an image in images/, and pictures in overlays/. Images
that are done are not done again."""


def add_segment(commands: _Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("segment", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_segment)
    parser.add_argument("source", type=Path, metavar="INPUT", help="sequence, or folder of images")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for masks")
    add_segmenter_arguments(parser, "light")
    parser.add_argument(
        "--min-score", type=float, default=0.5, metavar="S", help="class score (default: 0.5)"
    )
    parser.add_argument("--no-overlays", action="store_true", help="masks only, no pictures")
    parser.add_argument("--quiet", action="store_true", help="print only the file's path")


def _segment(arguments: argparse.Namespace) -> int:
    from bmask_slam.offline.segment_folder import segment_folder
    from bmask_slam.runtime.progress import console_log, counting_bar
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

    options = segmenter_options(arguments, SegmenterOptions(min_score=arguments.min_score))
    with console_log(), counting_bar(arguments.quiet) as progress:
        result = segment_folder(
            arguments.source, arguments.out, options, not arguments.no_overlays, progress
        )
    if arguments.quiet:
        print(result.file)
        return 0
    print(f"{result.instances} instances in {result.images} images, {result.reused} of them reused")
    if result.broken:
        print(f"{result.broken} broken images were left out")
    print(f"Masks       {result.file}")
    return 0
