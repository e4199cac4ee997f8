"""``bmask-slam map`` and ``merge``: a dense map of a finished run; several runs as one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from bmask_slam.commands.arguments import (
    SEGMENTER_OPTIONS,
    Commands,
    add_mesh_voxel_argument,
    add_output_arguments,
    add_segmenter_arguments,
    print_result,
    segmenter_options,
)

if TYPE_CHECKING:
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

TEXT = "make a dense map of a finished run: cloud, mesh, floor plan"
MORE = """\
Every keyframe's depth is fused with its neighbours'; keyframes that are finished are not done
again. Then all tracked frames make one surface. Points get labels if the run had a segmenter, or
with --segmenter or --masks; what became of a label in the run's map shows here when called
again."""

MERGE = "make one run of several finished runs that have places in common"
MERGE_MORE = """\
Places that two runs have in common are found by their landmarks' looks and verified by their
geometry; keyframes, landmarks, labels and objects are joined, and everything is optimised once, in
the world frame of the first run. Refused, with how near it came: a run that has no place in common
with the others, or one that only looks alike. The result is a run folder like any other."""


def add_map(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("map", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_map)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a finished run")
    parser.add_argument("--sequence", type=Path, metavar="DIR", help="its images, if they moved")
    parser.add_argument(
        "--voxel", type=float, default=0.01, metavar="M", help="a point a cube (default: 0.01)"
    )
    add_mesh_voxel_argument(parser)
    parser.add_argument("--mesh", action="store_true", help="also a mesh (mesh.ply, mesh.glb)")
    parser.add_argument("--plan", action="store_true", help="also a floor plan (plan.png)")
    parser.add_argument("--pcd", action="store_true", help="clouds as PCD beside PLY")
    add_segmenter_arguments(parser, "the run's own")
    parser.add_argument(
        "--without", metavar="A,B", help="classes left out (default: people and animals)"
    )
    parser.add_argument(
        "--moving", action="store_true", help="keep what is left out in a cloud (moving.ply)"
    )
    parser.add_argument(
        "--depth-source",
        choices=("sensor", "both", "stereo", "motion"),
        default="sensor",
        help="stereo: rectified pairs, with the right images of right.txt; motion: a plane sweep "
        "between keyframes; both: the sensor, and where it has nothing the pair or else the sweep "
        "(default: sensor)",
    )
    parser.add_argument(
        "--keep-volume",
        action="store_true",
        help="keep the surface's volume (some hundred MB): the next map with it integrates only "
        "what moved since",
    )
    parser.add_argument("--device", default="cpu", help="where depth is fused (default: cpu)")
    add_output_arguments(parser, "the folder's path")


def _map(arguments: argparse.Namespace) -> int:
    from bmask_slam.dense.map_run import format_summary, map_run
    from bmask_slam.dense.options import MapOptions
    from bmask_slam.runtime.progress import counting_bar

    without = arguments.without
    options = MapOptions(
        run=arguments.run,
        sequence=arguments.sequence,
        masks=_masks(arguments),
        excluded=None if without is None else tuple(filter(None, without.split(","))),
        keep_excluded=arguments.moving,
        voxel_m=arguments.voxel,
        mesh_voxel_m=arguments.mesh_voxel_m,
        source=arguments.depth_source,
        device=arguments.device,
        mesh=arguments.mesh,
        plan=arguments.plan,
        pcd=arguments.pcd,
        keep_volume=arguments.keep_volume,
    )
    with counting_bar(arguments.quiet) as progress:
        summary = map_run(options, progress)
    counts, products = summary.counts, summary.products
    told = {"folder": summary.folder, "fused": counts.fused, "reused": counts.reused}
    told |= {"skipped": counts.skipped, "files": products.files, "points": products.points}
    told |= {"label_shares": products.label_shares}
    print_result(arguments, summary.folder, lambda: format_summary(summary), told)
    return 0


def _masks(arguments: argparse.Namespace) -> SegmenterOptions | None:
    """What was asked for; None if nothing was."""
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

    if arguments.segmenter is None:
        if all(getattr(arguments, name) is None for name in SEGMENTER_OPTIONS):
            return None
        arguments.segmenter = "light" if arguments.masks is None else "precomputed"
    return segmenter_options(arguments, SegmenterOptions())


def add_merge(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("merge", help=MERGE, description=f"{MERGE}. {MERGE_MORE}")
    parser.set_defaults(handler=_merge)
    text = "folders of finished runs, two or more"
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help=text)
    parser.add_argument("--out", type=Path, required=True, metavar="F", help="run folder to make")
    text = "replace the run that --out holds; never an input"
    parser.add_argument("--overwrite", action="store_true", help=text)
    add_output_arguments(parser, "the folder's path")


def _merge(arguments: argparse.Namespace) -> int:
    from bmask_slam.merging.merge import MergeOptions, merge_runs
    from bmask_slam.merging.report import format_merge

    options = MergeOptions(tuple(arguments.runs), arguments.out, arguments.overwrite)
    summary = merge_runs(options)
    told = {"folder": summary.folder, "found": summary.lines, "metrics": summary.rows}
    print_result(arguments, summary.folder, lambda: format_merge(summary), told)
    return 0
