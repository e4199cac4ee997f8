"""``bmask-slam map``: a dense, semantic map of a finished run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

TEXT = "make a dense map of a finished run: cloud, mesh, floor plan"
MORE = """\
Every keyframe's depth is fused with its neighbours' and becomes a submap in RUN/dense; keyframes
that are finished are not done again. With --masks the points get labels."""


def add_map(commands: _Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("map", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_map)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a finished run")
    parser.add_argument("--sequence", type=Path, metavar="DIR", help="its images, if they moved")
    parser.add_argument(
        "--voxel", type=float, default=0.01, metavar="M", help="a point a cube (default: 0.01)"
    )
    parser.add_argument("--mesh", action="store_true", help="also a mesh (mesh.ply)")
    parser.add_argument("--plan", action="store_true", help="also a floor plan (plan.png)")
    parser.add_argument(
        "--masks", metavar="F", help="labels: COCO file, folder of label PNGs, or truth"
    )
    parser.add_argument("--labels", metavar="F", help="label set of label PNGs")
    parser.add_argument(
        "--without", default="", metavar="A,B", help="classes left out, since they move"
    )
    parser.add_argument(
        "--depth-source",
        choices=("sensor", "both", "motion"),
        default="sensor",
        help="both: with a plane sweep between keyframes where the sensor has nothing; motion: "
        "the sweep alone",
    )
    parser.add_argument("--device", default="cpu", help="where depth is fused (default: cpu)")
    parser.add_argument("--quiet", action="store_true", help="print only the folder's path")


def _map(arguments: argparse.Namespace) -> int:
    from semantics.segmenter_table import SegmenterOptions
    from slam.dense_mapping import MapOptions
    from slam.dense_run import format_summary, map_run
    from slam.progress import console_log, counting_bar

    masks = None
    if arguments.masks == "truth":
        masks = SegmenterOptions("truth")
    elif arguments.masks:
        masks = SegmenterOptions(
            "precomputed", masks=Path(arguments.masks), labels=arguments.labels
        )
    options = MapOptions(
        arguments.run,
        arguments.sequence,
        masks,
        tuple(filter(None, arguments.without.split(","))),
        arguments.voxel,
        arguments.depth_source,
        arguments.device,
        arguments.mesh,
        arguments.plan,
    )
    with console_log(), counting_bar(arguments.quiet) as progress:
        summary = map_run(options, progress)
    print(summary.folder if arguments.quiet else format_summary(summary))
    return 0
