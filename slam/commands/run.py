"""``bmask-slam run``: a sequence through the system, from the start or from a checkpoint."""

from __future__ import annotations

import argparse
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from bmask_slam.commands.arguments import (
    ChosenConfig,
    Commands,
    add_camera_argument,
    add_config_arguments,
    add_mesh_voxel_argument,
    add_output_arguments,
    add_segmenter_arguments,
    add_topic_arguments,
    bag_topics,
    camera_lines,
    chosen_config,
    format_summary,
    print_result,
)
from bmask_slam.graph.errors import InputError

if TYPE_CHECKING:
    from bmask_slam.offline.runner import RunSummary

EPILOG = """\
long runs and known places:
  bmask-slam run hall --out h --checkpoint-every 300   one that may be killed
  bmask-slam run --resume h                            goes on from its last checkpoint
  bmask-slam run hall2 --continue h                    another recording of the place: one map
  bmask-slam run hall3 --localise h                    only where the camera was in that map
"""
OPTIONS = (
    "sequence",
    "out",
    "camera",
    "reference",
    "max_frames",
    "stride",
    "checkpoint_every",
    "map",
    "localise",
    "calibrate",
    "dense",
    "mesh_voxel_m",
    "parallel",
    "full_size",
)


def add_run(commands: Commands) -> None:
    """Add the command to the parser."""
    text = "run the system over a sequence and write a run folder"
    parser = commands.add_parser(
        "run",
        help=text,
        description=text,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(handler=_run)
    parser.add_argument(
        "sequence", type=Path, nargs="?", help="recording: TUM's or another layout, or ROS bag"
    )
    parser.add_argument("--out", type=Path, help="run folder (default: runs/<sequence>, numbered)")
    parser.add_argument("--overwrite", action="store_true", help="replace the run that --out holds")
    add_config_arguments(parser)
    parser.add_argument("--print-config", action="store_true", help="print it resolved, and end")
    add_camera_argument(parser)
    text = "find readout, depth delay and what covers the image; auto: use them (default: auto)"
    parser.add_argument("--calibrate", metavar="auto|off|report", help=text)
    parser.add_argument("--reference", type=Path, metavar="F", help="trajectory to compare to")
    parser.add_argument("--max-frames", type=int, metavar="N", help="stop after N frames")
    parser.add_argument("--stride", type=int, metavar="N", help="take every N-th frame")
    text = "map and masks in processes of their own: faster; repeats, with bytes of its own"
    parser.add_argument("--parallel", action="store_true", default=None, help=text)
    _add_map_arguments(parser)
    add_segmenter_arguments(parser, "light")
    add_topic_arguments(parser)
    add_output_arguments(parser, "the run folder's path")


def _add_map_arguments(parser: argparse.ArgumentParser) -> None:
    """Add checkpoints, the map to begin with, and what is written beside the usual files."""
    text = "write a checkpoint every N frames; 300 is a good number"
    parser.add_argument("--checkpoint-every", type=int, metavar="N", help=text)
    parser.add_argument("--resume", type=Path, metavar="RUN", help="go on with a killed run")
    parser.add_argument(
        "--continue", dest="map", type=Path, metavar="MAP", help="run or map file to go on with"
    )
    parser.add_argument(
        "--localise", type=Path, metavar="MAP", help="only find the frames in a map, unchanged"
    )
    text = "also a dense map, as by bmask-slam map"
    parser.add_argument("--map", dest="dense", action="store_true", default=None, help=text)
    add_mesh_voxel_argument(parser)
    parser.add_argument(
        "--covariances",
        dest="set",
        action="append_const",
        const="covariances=true",
        help="also write covariances.txt: how sure the graph is of each keyframe",
    )


def _load_ahead(arguments: argparse.Namespace) -> None:
    """Let what other processes of the run need be loaded meanwhile, where that is known by now."""
    from bmask_slam.parallel.loading_ahead import load_network, load_workers

    if arguments.parallel:
        load_workers()
        return
    given = [arguments.segmenter or "light", *arguments.set]
    is_light = given[0] == "light" and not any("segmenter" in text for text in given)
    if is_light and arguments.sequence and not (arguments.config or arguments.localise):
        load_network()


def _run(arguments: argparse.Namespace) -> int:
    if not arguments.print_config:
        _load_ahead(arguments)
    from bmask_slam.config.configuration import dump

    chosen = chosen_config(arguments)
    if arguments.print_config:
        print(dump(chosen.config), end="")
        return 0
    summary = _run_or_resume(arguments, chosen)
    if summary is None:
        path = arguments.resume
        told = {"folder": path, "finished": True, "metrics": []}
        print_result(arguments, path, lambda: f"{path} is finished already", told)
        return 0
    print_result(arguments, summary.folder, lambda: _summary(summary), _plain_summary(summary))
    return 128 + summary.stopped_by if summary.stopped_by else 0


def _run_or_resume(arguments: argparse.Namespace, chosen: ChosenConfig) -> RunSummary | None:
    """How the run ended; None if the one to be resumed is finished already."""
    from bmask_slam.offline.runner import RunOptions, resume, run

    given: dict[str, Any] = {"quiet": arguments.quiet}
    if arguments.sequence:
        arguments.sequence = bag_topics(arguments).of_path(arguments.sequence)
    given |= {name: v for name in OPTIONS if (v := getattr(arguments, name)) is not None}
    if arguments.resume:
        if not chosen.is_default:
            given["config"] = chosen.config
        if arguments.overwrite:
            raise InputError("--overwrite: would delete what --resume needs; give one of the two")
        return resume(arguments.resume, given)
    if not arguments.sequence:
        raise InputError("run: no sequence; give a recording, or --resume RUN")
    given |= {"config": chosen.config, "config_name": chosen.name}
    return run(RunOptions(**given, overwrite=arguments.overwrite))


def _plain_summary(summary: RunSummary) -> dict[str, Any]:
    """What --json prints."""
    stopped_by = summary.stopped_by.name if summary.stopped_by else None
    told = {"folder": summary.folder, "finished": not stopped_by, "stopped_by": stopped_by}
    names = ("frames", "skipped", "calibration", "warnings")
    told |= {name: getattr(summary, name) for name in names}
    return told | {"metrics": summary.rows}


def _summary(summary: RunSummary) -> str:
    lines = [format_summary(summary.rows), ""]
    lines += camera_lines(summary.calibration, summary.folder)
    lines += [f"Warning     {warning}" for warning in summary.warnings]
    if summary.skipped:
        lines.append(f"{summary.skipped} broken frames were skipped, see log.txt")
    if summary.stopped_by:
        name, frames = summary.stopped_by.name, summary.frames
        lines.append(f"Stopped by {name} after {frames} frames; all is saved")
    if summary.resumable:
        lines.append(f"Go on with  bmask-slam run --resume {quote(str(summary.folder))}")
    picture = summary.folder / "trajectory.png"
    return "\n".join([*lines, f"Run folder  {summary.folder}", f"Picture     {picture}"])
